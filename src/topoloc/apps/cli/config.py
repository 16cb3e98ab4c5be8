"""topoloc config [COMMAND]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc.apps.cli.output import UsageError
from topoloc.apps.cli.settings_file import all_tables, settings_text

_HEADER = """\
# The settings of topoloc {version} that are no options of its commands, with their defaults.
# Keep the lines that you change, and give the file to a command: --config FILE. Behind a value: what it may be.
# `# key =` is not set (None)."""  # noqa: E501


@dataclass(frozen=True)
class Command:
    """What `topoloc config` takes."""

    command: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(metavar="COMMAND", help_behavior_hint="(default: all)"),
    ] = None
    """Only what this command reads: build, slam, localize, evaluate, explain or train."""

    def run(self) -> int:
        from topoloc import __version__

        tables = [
            name
            for name, (_, _, commands) in all_tables().items()
            if self.command is None or self.command in commands
        ]
        if not tables:
            known = dict.fromkeys(
                command for _, _, commands in all_tables().values() for command in commands
            )
            raise UsageError(
                f"{self.command} has no settings beside its options; {', '.join(known)} have"
            )
        print(_HEADER.format(version=__version__) + "\n\n" + settings_text(tables), end="")
        return 0
