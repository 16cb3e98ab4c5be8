"""What a search tried, for who wants to know why an image was answered so, or not at all: `Localizer.localize(..., trace=Trace())`."""

from __future__ import annotations

from dataclasses import dataclass, field

from topoloc.localization.belief import Hypothesis
from topoloc.localization.pose_fit import PoseFit


@dataclass(frozen=True, eq=False)
class Tried:
    """A first pose and what became of it.

    `refined` is the pose found around the first one (None: the first was not followed up), `hypothesis` that with its evidence (None:
    too little was found for any), `milliseconds` the time since the query began.
    """

    source: str
    first: PoseFit
    refined: PoseFit | None
    hypothesis: Hypothesis | None
    milliseconds: float


@dataclass(eq=False)
class Trace:
    """All first poses that were tried, in order."""

    tried: list[Tried] = field(default_factory=list)
