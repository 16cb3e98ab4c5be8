"""The command line: `topoloc COMMAND`. A command's module is imported when it is called.

Other distributions add commands with an entry point of the group `topoloc.commands`: a dictionary
like `COMMANDS`; and settings with one of `topoloc.settings`, like `TABLES` of settings_file.py."""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import sys
import warnings
from collections.abc import Iterable
from datetime import UTC, datetime
from io import TextIOWrapper
from os import PathLike
from typing import Any, TextIO

# NumPy reads this when imported. Threads of BLAS cost more than they gain, and change last digits.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_GROUPS = {
    "map a place": {
        "mapping.build": "build a map file from stereo or RGB-D recordings",
        "mapping.map": "build a map while its recording is written or replayed",
        "mapping.slam": "compute the trajectory of a stereo or RGB-D recording",
        "mapping.record": "record a ZED, CARLA, a webcam or a stream to a folder",
        "maps.update": "add recordings to a map: other light, changes, new parts",
        "maps.merge": "merge two overlapping maps",
        "maps.atlas": "create, extend and inspect an atlas of many maps",
    },
    "localize images": {
        "queries.localize": "compute 6-DoF poses of images, folders or recordings",
        "queries.follow": "track a webcam, a stream or a recording, one line for each image",
        "queries.serve": "run an HTTP service that localizes images in maps",
    },
    "know what to expect": {
        "queries.evaluate": "localize a recording with known truth and measure the errors",
        "maps.certify": "measure how often answers are wrong, with a bound at 95 % confidence",
        "queries.explain": "explain the result of an image and give advice",
        "maps.info": "print the contents of a map file",
        "maps.route": "print the shortest way along the nodes from one place to another",
        "maps.view": "show a map and results in 3-D in the browser",
    },
    "care for maps": {
        "maps.prune": "remove outdated and redundant parts of a map, to a size",
        "maps.history": "print the edits of a map",
        "maps.undo": "undo the last edit of a map, byte-identical",
        "maps.georeference": "set the position of a map on earth, for OGC GeoPoses",
        "maps.scale": "set the scale of a map of images, by a distance or a tag",
        "maps.level": "make a map's world level: z up, floor at 0, as in a robot's plan",
        "queries.calibrate": "find the mountings of a rig's cameras by their images in a map",
        "maps.export": "export to COLMAP, nerfstudio, PLY, GeoJSON, MCAP, TUM, KITTI",
    },
    "try and set up": {
        "demo": "map and localize the built-in lab by day, at night and with another camera",
        "doctor": "print what is installed where, and test that it works",
        "weights": "list, fetch or convert networks of local features",
        "config": "print all other settings as a TOML file",
    },
}
EXAMPLES = {
    "map a place": (
        "build office/ office.topo",
        "slam office/ office.tum",
        "update office.topo evening/",
    ),
    "localize images": (
        "localize office.topo photo.jpg --camera 525,525,320,240",
        "localize office.topo photos/ --camera unknown --json poses.jsonl",
        "serve maps/",
    ),
    "know what to expect": (
        "evaluate office.topo walk/ --report report.html",
        "certify office.topo --walk walk/ --out-of-map garage/",
        "explain office.topo photo.jpg --camera map",
    ),
    "care for maps": (
        "prune office.topo --max-mb 20",
        "undo office.topo",
        "export office.topo office-colmap/ --format colmap",
    ),
    "try and set up": ("demo --out topoloc-demo", "doctor", "config build"),
}
# name -> module with a dataclass `Command` of the arguments and its method `run`; line of the help
COMMANDS = {
    name.rpartition(".")[2]: (f"topoloc.apps.cli.{name}", summary)
    for group in _GROUPS.values()
    for name, summary in group.items()
}
PLUGIN_PACKAGES = {
    "simulate": "topoloc-worlds",
    "train": "topoloc-training",
    "benchmark": "topoloc-paper",
}
_BROKEN_PLUGINS: set[str] = set()
_DISK_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
MIN_ADDRESS_SPACE = 1_600_000_000


def main(args: list[str] | None = None) -> int:
    """Run one command. Return the exit status: 0 done, 1 a known failure (one line on stderr), 2
    wrong usage."""
    _open_closed_streams()
    _drop_unreadable_date()
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # code pages lack letters of file names
    try:
        try:
            return _dispatch(sys.argv[1:] if args is None else args)
        # buffered output fails here and not at exit
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output has closed it
        discard_output(sys.stdout)
    except OSError as error:
        if error.errno not in _DISK_ERRNOS:
            raise
        discard_output(sys.stdout)
        _print_error(f"cannot write the output: {error.strerror}")
    return 1


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that the caller closed. A file must not get its
    number, here or in a child."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _drop_unreadable_date() -> None:
    """Remove a SOURCE_DATE_EPOCH that is no time. NumPy raises an error for it when imported."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "").strip()
    try:
        datetime.fromtimestamp(int(epoch or 0), UTC)
    except (ValueError, OverflowError, OSError):
        _print_line(f"warning: SOURCE_DATE_EPOCH {epoch!r} is not in seconds: today's date is used")
        epoch = ""
    if not epoch:
        os.environ.pop("SOURCE_DATE_EPOCH", None)


def _dispatch(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help"):
        print(_help())
        return 0 if args else 2
    if args[0] == "help":
        return _dispatch([args[1], "--help"] if len(args) > 1 else ["--help"])
    if args[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(version("topoloc"))
        return 0
    if args[0] == "--completion":
        from topoloc.apps.cli.completion import print_completion

        return print_completion(args[1:])
    name, *rest = args
    commands = COMMANDS if name in COMMANDS else all_commands()
    if name in commands:
        return _run(name, *commands[name], rest)
    if name in PLUGIN_PACKAGES:
        _print_error(f"`topoloc {name}` needs {PLUGIN_PACKAGES[name]}, which is not installed")
    else:
        from topoloc.apps.core_names import suggest_name

        hint = suggest_name(name, commands) or f"; commands: {', '.join(commands)}"
        _print_error(f"unknown command {name!r}{hint}")
    return 2


def all_commands() -> dict[str, tuple[str, str]]:
    """Return the commands of all distributions. Plug-ins cannot replace commands of topoloc."""
    return COMMANDS | load_plugins("topoloc.commands") | COMMANDS


def load_plugins(group: str) -> dict[str, Any]:
    """Return the entries of all other distributions' entry points of a group, in one dictionary.

    A distribution whose entry point cannot be loaded is left out, with one warning on stderr.
    """
    from importlib.metadata import entry_points

    found: dict[str, Any] = {}
    for entry_point in entry_points(group=group):
        try:
            found |= dict(entry_point.load())
        except Exception as error:  # a fault of another distribution must not stop topoloc
            _warn_broken_plugin(entry_point.value.partition(":")[0], error)
    return found


def _warn_broken_plugin(module: str, error: Exception) -> None:
    """Print one line; nothing if it was printed already in this process."""
    if module not in _BROKEN_PLUGINS:
        _BROKEN_PLUGINS.add(module)
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        _print_line(f"warning: the plug-in {module} cannot be loaded and is left out ({reason})")


def _run(name: str, module_name: str, summary: str, args: list[str]) -> int:
    from topoloc import TopolocError
    from topoloc.apps.core_names import collect_written_paths

    written = collect_written_paths()
    try:
        _check_address_space()
        import tyro

        # tyro keeps line breaks of the source; a later one without this name is left as it is
        if strings := vars(tyro).get("_strings"):
            strings.remove_single_line_breaks = _join_lines
        from topoloc.apps.cli.output import UsageError, interruptible

        with interruptible():  # too little memory to load the libraries is reported too
            module = importlib.import_module(module_name)
        command = tyro.cli(
            module.Command,
            args=args,
            prog=f"topoloc {name}",
            description=summary[0].upper() + summary[1:],
        )
        try:
            with warnings.catch_warnings(), interruptible():
                warnings.showwarning = _print_warning
                return command.run()
        except UsageError as error:
            _print_error(f"{error}; see `topoloc {name} --help`")
            return 2
    except TopolocError as error:
        _print_error(_with_written_files(str(error), args, written))
    except ImportError as error:  # of a library that is missing or broken
        _print_error(f"{error}; see `topoloc doctor`")
    except OSError as error:
        if error.errno not in (errno.EMFILE, errno.ENFILE):
            raise
        where = f"cannot open {error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror}; raise the limit (ulimit -n)"
        _print_error(_with_written_files(text, args, written))
    except MemoryError:
        _print_error("out of memory; no file is incomplete")
    except KeyboardInterrupt:
        _print_error("interrupted; no file is incomplete")
    return 1


def _join_lines(text: str) -> str:
    """Return a text with its paragraphs in one line each."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n")).strip()


def _with_written_files(text: str, args: list[str], written: Iterable[PathLike[str]]) -> str:
    """Return the text of a failure with the files, of those that the arguments name, that were
    written before it. An atlas is written with its manifest."""
    paths = [os.path.realpath(path) for path in written if os.path.exists(path)]
    found = {path.removesuffix(f"{os.sep}atlas.json") for path in paths}
    named = [arg.rpartition("=")[2] for arg in args]
    names = [arg for arg in named if os.path.realpath(arg) in found and arg not in text]
    return f"{text} (already written: {', '.join(names)})" if names else text


def _check_address_space() -> None:
    """Check the limit of memory. Below it OpenBLAS, FAISS and LLVM abort the process silently."""
    from topoloc import TopolocError

    try:
        import resource
    except ImportError:  # Windows
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= limit < MIN_ADDRESS_SPACE:
        raise TopolocError(
            f"too little memory: ulimit -v allows {limit // 10**6} MB of address space, at least"
            f" {MIN_ADDRESS_SPACE // 10**6} are needed"
        )


def _print_warning(message: Warning | str, *_place: object, **_line: object) -> None:
    _print_line("warning: " + " ".join(str(message).split()))


def _print_error(text: str) -> None:
    _print_line("error: " + " ".join(text.split()))


def printable(text: str) -> str:
    """Return a text with escapes instead of control characters. So a text from a file neither
    controls the terminal nor begins a line."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _print_line(line: str) -> None:
    try:
        print(printable(line), file=sys.stderr)
    except OSError:  # only the exit status remains
        discard_output(sys.stderr)


def discard_output(stream: TextIO) -> None:
    """Discard the buffered output of `stream`, so that it raises no error at exit."""
    with contextlib.suppress(OSError):  # a stream without a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _help() -> str:
    listed = all_commands()
    width, parts = max(map(len, listed)), list[str]()
    for title, group in _GROUPS.items():
        names = [name.rpartition(".")[2] for name in group]
        lines = [f"  {name:<{width}}  {listed.pop(name)[1]}" for name in names]
        examples = [f"      topoloc {example}" for example in EXAMPLES[title]]
        parts.append("\n".join([f"{title}:", *lines, *examples]))
    if listed:
        lines = [f"  {name:<{width}}  {text}" for name, (_, text) in listed.items()]
        parts.append("\n".join(["of other distributions:", *lines]))
    return (
        "usage: topoloc COMMAND ...\n\nMap a place with a stereo or RGB-D camera, then localize"
        " single images of it with 6-DoF poses.\n\n"
        + "\n\n".join(parts)
        + "\n\n`topoloc help COMMAND` describes a command, `topoloc -V` prints the version,\n"
        "`topoloc --completion bash` (or zsh, fish) a script for the Tab key."
    )
