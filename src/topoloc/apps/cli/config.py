"""topoloc config [COMMAND]."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from itertools import chain
from typing import Annotated

import tyro

from topoloc.apps.cli.output import UsageError, option
from topoloc.apps.cli.settings_file import all_tables, settings_text

_HEADER = """\
# Settings of topoloc {version} beside the options of its commands, with their defaults and bounds.
# Keep the lines that you change, and use the file with a command: --config FILE.
# `# key =` is not set (None)."""


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc config`."""

    command: Annotated[tyro.conf.Positional[str | None], option("COMMAND", "all")] = None
    """Only the settings of this command: build, slam, localize, evaluate, explain or train."""

    def run(self) -> int:
        commands_of = {name: commands for name, (_, _, commands) in all_tables().items()}
        is_all = self.command is None
        tables = [name for name, used in commands_of.items() if is_all or self.command in used]
        if not tables:
            known = ", ".join(dict.fromkeys(chain(*commands_of.values())))
            raise UsageError(f"{self.command} has no settings beside its options; {known} have")
        print(_HEADER.format(version=version("topoloc")) + "\n\n" + settings_text(tables), end="")
        return 0
