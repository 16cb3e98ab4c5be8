"""The command line: `topoloc COMMAND`. Each command is a module, imported only when it is called.

Other distributions add commands by an entry point of the group `topoloc.commands`: a dictionary
like `COMMANDS`; and settings by one of `topoloc.settings`, like `TABLES` of settings_file.py.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import sys
import warnings
from typing import Any, TextIO

# Before NumPy is loaded, which reads it then. BLAS's own threads wait for each other by spinning:
# that takes more of the processors than the products here are worth, and with as many threads as
# there are processors the last digits
# would depend on the machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# name -> the module, which holds a dataclass of the settings, `Command`, with `run`; and what
# `topoloc --help` says of it
COMMANDS = {
    "demo": (
        "topoloc.apps.cli.demo",
        (
            "the whole pipeline on the built-in lab: mapped by day, asked by day, by night and with"
            " another camera"
        ),
    ),
    "slam": (
        "topoloc.apps.cli.mapping.slam",
        "where did the camera go? a stereo or RGB-D recording becomes a trajectory",
    ),
    "build": (
        "topoloc.apps.cli.mapping.build",
        "map a place: a stereo or RGB-D recording becomes one map file",
    ),
    "localize": (
        "topoloc.apps.cli.queries.localize",
        "where were these images taken? 6-DoF poses of images, folders, recordings",
    ),
    "evaluate": (
        "topoloc.apps.cli.queries.evaluate",
        "localize a recording with known truth and judge the poses",
    ),
    "explain": (
        "topoloc.apps.cli.queries.explain",
        "why a picture got its answer, or none, and what would help",
    ),
    "info": ("topoloc.apps.cli.maps.info", "what a map file holds"),
    "atlas": (
        "topoloc.apps.cli.maps.atlas",
        "many maps asked as one: an atlas made, added to, looked into",
    ),
    "update": (
        "topoloc.apps.cli.maps.update",
        "a new recording joins a map: another light, a changed room, new parts",
    ),
    "merge": ("topoloc.apps.cli.maps.merge", "one map of two that were made apart and overlap"),
    "prune": (
        "topoloc.apps.cli.maps.prune",
        "drop from a map what is gone, and what adds least, to a size",
    ),
    "history": (
        "topoloc.apps.cli.maps.history",
        "how a map came to be what it is: its edits, and which can be taken back",
    ),
    "undo": ("topoloc.apps.cli.maps.undo", "take the last edit of a map back, to the byte"),
    "record": (
        "topoloc.apps.cli.mapping.record",
        (
            "a recording made: a ZED, CARLA, a webcam or a stream becomes a folder that every"
            " command reads"
        ),
    ),
    "export": (
        "topoloc.apps.cli.maps.export",
        "a map or results for other programs: COLMAP, nerfstudio, PLY, GeoJSON, MCAP, TUM, KITTI",
    ),
    "view": ("topoloc.apps.cli.maps.view", "a map and what was found in it, in 3-D in the browser"),
    "georeference": (
        "topoloc.apps.cli.maps.georeference",
        "where on earth a map lies; its results then carry OGC GeoPoses",
    ),
    "serve": ("topoloc.apps.cli.queries.serve", "an HTTP service that localizes pictures in maps"),
    "follow": (
        "topoloc.apps.cli.queries.follow",
        "where is this camera now? a line for each picture of a webcam, a stream, a recording",
    ),
    "weights": (
        "topoloc.apps.cli.weights",
        "networks of local features: which are known and here, and how to get others",
    ),
    "config": (
        "topoloc.apps.cli.config",
        "all other settings as a TOML file, with defaults and meanings",
    ),
}
PLUGIN_PACKAGES = {
    "simulate": "topoloc-worlds",
    "train": "topoloc-training",
    "benchmark": "topoloc-paper",
}
_BROKEN_PLUGINS: set[str] = set()
_DISK_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
_HELP_ORDER = (
    "demo",
    "simulate",
    "slam",
    "build",
    "train",
    "localize",
    "evaluate",
    "explain",
    "benchmark",
    "info",
)
_HELP_ORDER += ("atlas", "update", "merge", "prune", "history", "undo", "view", "record", "export")
_HELP_ORDER += ("georeference", "serve", "follow", "weights", "config")
MIN_ADDRESS_SPACE = 1_600_000_000


def main(args: list[str] | None = None) -> int:
    """Run one command. Returns the exit status: 0 done, 1 a known failure (one line on stderr), 2
    wrong usage."""
    if (
        sys.stdout is None
    ):  # closed by the caller, who wants no output; its number must not go to a file that we open
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    try:
        try:
            return _dispatch(sys.argv[1:] if args is None else args)
        # what is buffered fails here and not at exit, where nobody can tell of it any more
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output went away
        _discard_output(sys.stdout)
    except OSError as error:
        if error.errno not in _DISK_ERRNOS:
            raise
        _discard_output(sys.stdout)
        _print_error(f"cannot write the output: {error.strerror}")
    return 1


def _dispatch(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help"):
        print(_help())
        return 0 if args else 2
    if args[0] == "--version":
        from importlib.metadata import version

        print(version("topoloc"))
        return 0
    name, *rest = args
    commands = COMMANDS if name in COMMANDS else all_commands()
    if name in commands:
        return _run(name, *commands[name], rest)
    known = f"unknown command {name!r}; commands: {', '.join(commands)}"
    _print_error(
        f"`topoloc {name}` comes with {PLUGIN_PACKAGES[name]}, which is not installed"
        if name in PLUGIN_PACKAGES
        else known
    )
    return 2


def all_commands() -> dict[str, tuple[str, str]]:
    """Our commands and those that other distributions bring, as `COMMANDS`; a name of ours is
    ours."""
    return load_plugins("topoloc.commands") | COMMANDS


def load_plugins(group: str) -> dict[str, Any]:
    """Return the entries of all other distributions' entry points of a group, in one dictionary.

    A distribution whose entry point cannot be loaded is left out, with one warning on stderr.
    """
    from importlib.metadata import entry_points

    found: dict[str, Any] = {}
    for entry_point in entry_points(group=group):
        try:
            found |= dict(entry_point.load())
        except Exception as error:  # any fault of another distribution: our commands go on
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

    try:
        _check_address_space()
        import tyro

        from topoloc.apps.cli.output import UsageError, interruptible

        with interruptible():  # also says so where there is too little memory for the libraries
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
            _print_error(f"{error}; `topoloc {name} --help` says more")
            return 2
    except TopolocError as error:
        _print_error(str(error))
    except MemoryError:
        _print_error("out of memory; every file is as it was or whole")
    except KeyboardInterrupt:
        _print_error("interrupted; every file is as it was or whole")
    return 1


def _check_address_space() -> None:
    """Below this OpenBLAS, FAISS and LLVM end the process from within while they are loaded, with
    no word of their own."""
    from topoloc import TopolocError

    try:
        import resource
    except ImportError:  # Windows
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= limit < MIN_ADDRESS_SPACE:
        least = MIN_ADDRESS_SPACE // 10**6
        raise TopolocError(
            f"too little memory: ulimit -v leaves {limit // 10**6} MB of address space, at least"
            f" {least} are needed"
        )


def _print_warning(message: Warning | str, *_place: object, **_line: object) -> None:
    _print_line(f"warning: {message}")


def _print_error(text: str) -> None:
    _print_line("error: " + " ".join(text.split()))


def _print_line(line: str) -> None:
    try:
        print(line, file=sys.stderr)
    except OSError:  # the exit status says it
        _discard_output(sys.stderr)


def _discard_output(stream: TextIO) -> None:
    """What `stream` still holds goes nowhere, so that it does not complain at exit."""
    with contextlib.suppress(OSError):  # a stream of its caller's without a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _help_position(name: str) -> int:
    return _HELP_ORDER.index(name) if name in _HELP_ORDER else len(_HELP_ORDER)


def _help() -> str:
    listed = all_commands()
    width = max(map(len, listed))
    commands = "\n".join(
        f"  {name:<{width}}  {listed[name][1]}" for name in sorted(listed, key=_help_position)
    )
    return (
        "usage: topoloc COMMAND ...\n\nWalk through a place once with a stereo or RGB-D camera;"
        " afterwards any single image of it gets a 6-DoF"
        f" pose.\n\ncommands:\n{commands}\n\n`topoloc COMMAND --help` says everything about one;"
        " `topoloc --version` prints the version."
    )
