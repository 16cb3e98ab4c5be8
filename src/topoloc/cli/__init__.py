"""The command line: `topoloc COMMAND`. Each command is a module of this package, imported only when it is called."""

from __future__ import annotations

import importlib
import os
import sys

# name -> what `topoloc --help` says of it; the module of the same name holds a dataclass of the settings, `Command`, with `run`
COMMANDS = {
    "demo": "the whole pipeline on the built-in lab: mapped by day, asked by day, by night and with another camera",
    "simulate": "render a recording of a built-in world (lab, corridor, street) with exact truth",
    "slam": "where did the camera go? a stereo or RGB-D recording becomes a trajectory",
    "build": "map a place: a stereo or RGB-D recording becomes one map file",
    "train": "add a learned coarse localizer to a map, or train it anew",
    "localize": "where were these images taken? 6-DoF poses of images, folders, recordings",
    "evaluate": "localize a recording with known truth and judge the poses",
    "benchmark": "the paper's tables and figures, ours and others' beside them",
    "info": "what a map file holds",
}


def main(args: list[str] | None = None) -> int:
    """Run one command. Returns the exit status: 0 done, 1 a known failure (one line on stderr), 2 wrong usage."""
    args = sys.argv[1:] if args is None else args
    if not args or args[0] in ("-h", "--help"):
        print(_help())
        return 0 if args else 2
    if args[0] == "--version":
        from importlib.metadata import version

        print(version("topoloc"))
        return 0
    name, *rest = args
    if name not in COMMANDS:
        print(f"error: unknown command {name!r}; commands: {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    return _run(name, rest)


def _run(name: str, args: list[str]) -> int:
    from topoloc.errors import TopolocError

    try:
        import tyro

        from topoloc.cli.output import UsageError, interruptible

        module = importlib.import_module(f"topoloc.cli.{name}")
        summary = COMMANDS[name]
        command = tyro.cli(module.Command, args=args, prog=f"topoloc {name}", description=summary[0].upper() + summary[1:])
        try:
            with interruptible():
                return command.run()
        except UsageError as error:
            _print_error(f"{error}; `topoloc {name} --help` says more")
            return 2
    except TopolocError as error:
        _print_error(str(error))
    except KeyboardInterrupt:
        _print_error("interrupted; every file is as it was or whole")
    except BrokenPipeError:  # the reader of our output went away; what is still buffered must not complain at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _print_error(text: str) -> None:
    print("error: " + " ".join(text.split()), file=sys.stderr)


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items())
    return (
        "usage: topoloc COMMAND ...\n\n"
        "Walk through a place once with a stereo or RGB-D camera; afterwards any single image of it gets a 6-DoF pose.\n\n"
        f"commands:\n{commands}\n\n"
        "`topoloc COMMAND --help` says everything about one; `topoloc --version` prints the version."
    )
