"""Kinds of options that several commands have."""

from __future__ import annotations

from typing import Annotated

import tyro

# Given or not: no `--no-...`, and no "(default: False)" in the help.
Flag = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")]
# A path that may be left out.
File = Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
# The format of the recordings.
Format = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: recognised)")]
