"""Compute the size of an installation: a distribution with its requirements, from the files that
pip recorded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution

_NAME = re.compile(r"^[A-Za-z0-9][\w.-]*")


def installed_bytes(names: Sequence[str]) -> int | None:
    """Return the bytes of these distributions and their requirements without extras; None if one of
    them is not installed."""
    found: dict[str, Distribution] = {}
    for name in names:
        try:
            _add(name, found)
        except PackageNotFoundError:
            return None
    return sum(_bytes(one) for one in found.values())


def _add(name: str, found: dict[str, Distribution]) -> None:
    key = re.sub(r"[-_.]+", "-", name).lower()
    if key in found:
        return
    found[key] = distribution(name)
    for line in found[key].requires or []:
        requirement, _, marker = line.partition(";")
        match = _NAME.match(requirement.strip())
        if match and "extra" not in marker:
            try:
                _add(match.group(), found)
            except PackageNotFoundError:  # of another platform or Python: markers are not evaluated
                continue


def _bytes(one: Distribution) -> int:
    sizes = 0
    for file in one.files or []:
        try:
            sizes += file.locate().stat().st_size  # pyright: ignore[reportAttributeAccessIssue]
        except OSError:
            continue
    return sizes
