"""Test the bounds of settings: accepted values, error messages, and that each setting has a
description and bounds."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pytest
from hypothesis import given, strategies as st

import topoloc
from built_room import built_room
from topoloc.apps.cli.settings_file import all_tables, config_class, read_field_docs
from topoloc.bounds import (
    Above,
    AtLeast,
    Between,
    check_bounds,
    field_annotations,
    field_bounds,
    find_violation,
    parse_settings,
)
from topoloc.errors import ConfigError
from topoloc.mapping.nodes import NodeConfig
from topoloc.tracking.config import HypothesesConfig
from topoloc.tracking.motion import MotionConfig


@dataclass(frozen=True)
class Inner:
    share: Annotated[float, Between(0, 1)] = 0.5
    pairs: Annotated[tuple[tuple[float, float], ...], AtLeast(0)] = ((1.0, 2.0),)


@dataclass(frozen=True)
class Outer:
    length: Annotated[float | None, Above(0)] = None
    number: Annotated[int, AtLeast(1)] = 1
    kind: Literal["a", "b"] = "a"
    is_on: bool = False
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    "change",
    [
        {"length": 3},
        {"length": np.float32(0.1)},
        {"number": np.int64(7)},
        {"inner": Inner(1.0, ())},
    ],
)
def test_values_within_the_bounds_pass(change: dict[str, Any]):
    check_bounds(replace(Outer(), **change))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"length": 0.0}, "Outer.length: must be above 0, not 0.0"),
        ({"length": math.nan}, "Outer.length: must be a finite number, not nan"),
        ({"length": math.inf}, "Outer.length: must be a finite number, not inf"),
        ({"length": 10**400}, "Outer.length: must be a finite number, not 1000"),
        ({"number": 0}, "Outer.number: must be at least 1, not 0"),
        ({"number": 1.5}, "Outer.number: a whole number is expected, not 1.5"),
        ({"number": 2**31}, "Outer.number: must be at most 2147483647"),
        ({"number": True}, "Outer.number: a whole number is expected, not True"),
        ({"number": None}, "Outer.number: a whole number is expected, not None"),
        ({"length": "far"}, "Outer.length: a number is expected, not 'far'"),
        ({"kind": "c"}, "Outer.kind: one of a, b is expected, not 'c'"),
        ({"is_on": 1}, "Outer.is_on: true or false is expected, not 1"),
        ({"inner": {"share": 0.5}}, "Outer.inner: a Inner is expected, not {'share': 0.5}"),
        ({"inner": Inner(share=1.01)}, "Outer.inner.share: must be from 0 to 1, not 1.01"),
        ({"inner": Inner(pairs=((1.0, -2.0),))}, "Outer.inner.pairs: must be at least 0, not -2.0"),
        (
            {"inner": Inner(pairs=((1.0, math.nan),))},
            "Outer.inner.pairs: must be a finite number, not nan",
        ),
        ({"inner": Inner(pairs=((1.0,),))}, "Outer.inner.pairs: a list of values is expected"),  # type: ignore[arg-type]
    ],
)
def test_errors_name_the_key(change: dict[str, Any], said: str):
    with pytest.raises(ConfigError) as raised:
        check_bounds(replace(Outer(), **change))
    assert str(raised.value).startswith(said)


@given(st.sampled_from([Above(0), AtLeast(-2), Between(0, 1)]), st.floats() | st.integers())
def test_no_number_that_is_not_one_passes(bound: Any, number: float):
    kind = Annotated[float, bound]
    if find_violation(number, kind) is None:
        assert math.isfinite(number)
        assert bound.is_satisfied(number)


def _settings_of(kind: type, key: str) -> list[tuple[str, type, str, Any, Any]]:
    """Return key, class, name, annotation and default of each field, nested
    configurations included."""
    config = kind()
    found: list[tuple[str, type, str, Any, Any]] = []
    for name, declared in field_annotations(kind).items():
        default = getattr(config, name)
        found += _settings_of(type(default), f"{key}.{name}") if is_dataclass(default) else []
        found.append((f"{key}.{name}", kind, name, declared, default))
    return found


def _is_of_numbers(declared: Any) -> bool:
    return declared in (int, float) or any(map(_is_of_numbers, get_args(declared)))


@pytest.mark.parametrize("table", all_tables())
def test_every_setting_has_a_meaning_and_every_number_bounds(table: str):
    settings = _settings_of(config_class(table), table)
    assert settings
    for key, kind, name, declared, default in settings:
        if is_dataclass(default):
            about = type(default).__doc__ or ""
            assert about, key
            assert not about.startswith(f"{type(default).__name__}("), (
                f"{key}: what a dataclass without a docstring is given"
            )
        else:
            assert read_field_docs(kind).get(name), (
                f"{key} has no docstring that says what it means"
            )
        if _is_of_numbers(declared):
            assert field_bounds(declared), f"{key} has no bounds"


@pytest.mark.parametrize("table", all_tables())
def test_defaults_are_within_their_bounds(table: str):
    check_bounds(config_class(table)())


def test_python_callers_get_the_same_errors(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    nodes = NodeConfig(d_thresh=-1.0)
    with pytest.raises(
        ConfigError, match=r"^MapConfig\.nodes\.d_thresh: must be above 0, not -1\.0$"
    ):
        topoloc.build_map([], topoloc.BuildConfig(nodes=nodes))
    with pytest.raises(ConfigError, match=r"^LocalizerConfig\.num_candidates: must be from 1"):
        topoloc.Localizer(topomap, topoloc.LocalizerConfig(num_candidates=0))
    unknown = HypothesesConfig(motion=MotionConfig(sigma_acceleration=math.nan))
    with pytest.raises(
        ConfigError,
        match=r"^TrackerConfig\.hypotheses\.motion\.sigma_acceleration: must be a finite number",
    ):
        topoloc.Tracker(topoloc.Localizer(topomap), topoloc.TrackerConfig(hypotheses=unknown))


@dataclass(frozen=True)
class Stored:
    name: str
    t_ns: int | None = None
    inner: Inner | None = None


def test_plain_data_becomes_the_dataclass_again():
    data = json.loads(json.dumps(asdict(Stored("a", 10**18, Inner(1, ((0.0, 3.0),))))))
    assert parse_settings(Stored, data, "a") == Stored("a", 10**18, Inner(1.0, ((0.0, 3.0),)))
    assert parse_settings(Stored, {"name": "a", "inner": None}, "a") == Stored("a")
    assert parse_settings(
        Stored, {"name": "a", "later": {}, "inner": {"later": 1}}, "a", is_strict=False
    ) == Stored("a", inner=Inner())


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ([], "a: a table is expected, [a]"),
        ({}, "a.name: is missing"),
        ({"name": 1}, "a.name: a text is expected, not 1"),
        ({"name": "b", "t_ns": 0.5}, "a.t_ns: a whole number is expected, not 0.5"),
        ({"name": "b", "inner": 1}, "a.inner: a table is expected, [a.inner]"),
        ({"name": "b", "inner": {"share": 2}}, "a.inner.share: must be from 0 to 1, not 2.0"),
        (
            {"name": "b", "inner": {"chare": 1}},
            "a.inner.chare: no such setting; did you mean a.inner.share?",
        ),
    ],
)
def test_invalid_plain_data_is_named_by_its_key(data: Any, said: str):
    with pytest.raises(ConfigError) as raised:
        parse_settings(Stored, data, "a")
    assert str(raised.value) == said
