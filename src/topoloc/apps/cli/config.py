"""topoloc config [COMMAND]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from topoloc.apps.cli.output import UsageError
from topoloc.apps.cli.settings_file import all_tables, settings_text

_HEADER = """\
# Settings of topoloc {version} beside the options of its commands, with their defaults and bounds.
# Keep the lines that you change, and use the file with a command: --config FILE.
# `# key =` is not set (None)."""


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc config`."""

    command: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(metavar="COMMAND", help_behavior_hint="(default: all)"),
    ] = None
    """Only the settings of this command: build, slam, localize, evaluate, explain or train."""

    def run(self) -> int:
        from topoloc import __version__

        commands_of = {name: commands for name, (_, _, commands) in all_tables().items()}
        tables = [
            name
            for name, commands in commands_of.items()
            if self.command is None or self.command in commands
        ]
        if not tables:
            known = ", ".join(
                dict.fromkeys(c for commands in commands_of.values() for c in commands)
            )
            raise UsageError(f"{self.command} has no settings beside its options; {known} have")
        print(_HEADER.format(version=__version__) + "\n\n" + settings_text(tables), end="")
        return 0
