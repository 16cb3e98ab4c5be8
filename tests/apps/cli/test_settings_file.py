"""Test settings in TOML: how a configuration is printed and read, and the errors of
an invalid file."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from topoloc.apps.cli import settings_file
from topoloc.apps.cli.settings_file import (
    TABLES,
    all_tables,
    config_class,
    read_settings,
    with_option,
)
from topoloc.bounds import Above, Between, check_bounds, parse_settings
from topoloc.errors import ConfigError
from topoloc.localization.localizer import LocalizerConfig
from topoloc.mapping.build import BuildConfig
from topoloc.tracking.config import TrackerConfig

FileOf = Callable[[str | bytes], str]


@dataclass(frozen=True)
class Wheel:
    """A wheel.

    More of it.
    """

    radius: Annotated[float, Above(0)] = 1e-5
    """Metres."""


@dataclass(frozen=True)
class Cart:
    """A cart."""

    front: Wheel = field(default_factory=lambda: Wheel(0.5))
    """The wheel at the front."""
    name: str | None = None
    """Painted on its side."""
    kind: Literal["hay", "milk"] = "hay"
    """What is carried,
    mostly."""
    loads: Annotated[tuple[tuple[float, float], ...], Between(0, 9)] = ((1.0, 2.0),)
    """From, to."""
    is_red: bool = True
    """Red."""


CART = """\
# A cart.
[cart]
# Painted on its side.
# name =
# What is carried, mostly.
kind = "hay"  # one of "hay", "milk"
# From, to.
loads = [[1.0, 2.0]]  # from 0 to 9
# Red.
is_red = true

# A wheel. The wheel at the front.
[cart.front]
# Metres.
radius = 0.5  # above 0
"""


@pytest.fixture
def cart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLES, "cart", (__name__, "Cart", ("draw",)))


@pytest.mark.usefixtures("cart")
def test_a_table_is_printed_with_its_meanings_and_bounds():
    assert settings_file.settings_text(["cart"]) == CART


@pytest.mark.usefixtures("cart")
def test_a_part_of_a_table_changes_that_part_alone(file_of: FileOf):
    read = read_settings(
        file_of('[cart]\nname = "Ox"\nloads = [[0, 1], [2, 3.5]]\nfront = {radius = 2}')
    )
    assert read.get(Cart) == Cart(Wheel(2.0), "Ox", loads=((0.0, 1.0), (2.0, 3.5)))
    assert isinstance(read.get(Cart).front.radius, float)
    assert read_settings(file_of("[cart]\nfront = {}")).get(Cart).front == Wheel(0.5)
    assert read.get(Wheel) == read_settings(None).get(Wheel) == Wheel()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[cart]\nnmae = 'Ox'", "cart.nmae: no such setting; did you mean cart.name?"),
        ("[cart]\nradius = 1", "cart.radius: no such setting; did you mean cart.front.radius?"),
        ("[cart]\nfront = 1", "cart.front: a table is expected, [cart.front]"),
        ("cart = []", "cart: a table is expected, [cart]"),
        ("[[cart]]", "cart: a table is expected, [cart]"),
        ("[carts]", "carts: no such table; did you mean cart?"),
        ("[cart]\nname = 3", "cart.name: a text is expected, not 3"),
        ("[cart]\nis_red = 1", "cart.is_red: true or false is expected, not 1"),
        ("[cart]\nkind = 'coal'", "cart.kind: one of hay, milk is expected, not 'coal'"),
        ("[cart.front]\nradius = true", "cart.front.radius: a number is expected, not True"),
        ("[cart.front]\nradius = nan", "cart.front.radius: must be a finite number, not nan"),
        ("[cart.front]\nradius = inf", "cart.front.radius: must be a finite number, not inf"),
        ("[cart.front]\nradius = 0", "cart.front.radius: must be above 0, not 0.0"),
        (f"[cart.front]\nradius = 1{'0' * 400}", "cart.front.radius: must be a finite number"),
        (
            "[cart]\nloads = [[1, 2], [3]]",
            "cart.loads: a list of values is expected, not ((1.0, 2.0), (3.0,))",
        ),
        ("[cart]\nloads = [[1, 10]]", "cart.loads: must be from 0 to 9, not 10.0"),
        (
            "[cart]\nloads = 2024-01-01",
            "cart.loads: a list of values is expected, not datetime.date",
        ),
        ("[cart]\n'a\nb' = 1", "not TOML ("),
        ('[cart]\n"a\\nb" = 1', 'cart."a\\nb": no such setting'),
        ("[cart", "not TOML ("),
        ("x = " + "[" * 5000, "not TOML ("),
        ("x = 1" + "0" * 5000, "not TOML ("),
        (b"\xff\xfe", "not TOML ("),
        (b"#" * 1_000_001, "larger than 1000000 bytes"),
    ],
    ids=lambda value: str(value)[:30],
)
@pytest.mark.usefixtures("cart")
def test_errors_name_file_and_key(content: str | bytes, said: str, file_of: FileOf):
    path = file_of(content)
    with pytest.raises(ConfigError) as raised:
        read_settings(path)
    assert str(raised.value).startswith(f"{path}: {said}")


def test_files_that_cannot_be_read(tmp_path: Path):
    for path in (tmp_path, tmp_path / "none.toml"):
        with pytest.raises(ConfigError, match=re.escape(str(path))):
            read_settings(str(path))


def _keys(config: Any) -> list[str]:
    names = list(config.__dataclass_fields__)
    nested = [getattr(config, name) for name in names if is_dataclass(getattr(config, name))]
    return names + [key for inner in nested for key in _keys(inner)]


_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["surf", "exact", "motion"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)


@functools.cache
def _trees(name: str) -> st.SearchStrategy[Any]:
    keys = st.sampled_from(_keys(config_class(name)())) | st.text(max_size=8)
    return st.recursive(
        _VALUES, lambda inner: st.dictionaries(keys, inner, max_size=4), max_leaves=12
    )


def _refusal(read: Callable[[], Any]) -> str | None:
    """Return the text of a ConfigError, or None. Any other exception is passed on."""
    try:
        read()
    except ConfigError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", all_tables())
@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_any_table_is_read_or_refused_by_its_key(name: str, data: st.DataObject):
    before, table = config_class(name)(), data.draw(_trees(name))
    said = _refusal(lambda: check_bounds(parse_settings(type(before), table, name, before)))
    assert said is None or said.startswith(name)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.binary(max_size=60)
    | st.text(max_size=60).map(str.encode)
    | st.sampled_from([f"[{name}]\nx = 1".encode() for name in all_tables()])
)
def test_any_file_is_read_or_refused(tmp_path: Path, content: bytes):
    path = tmp_path / "fuzz.toml"
    path.write_bytes(content)
    said = _refusal(lambda: read_settings(str(path)))
    assert said is None or said.startswith(f"{path}: ")


def test_options_are_checked_as_the_file_is():
    assert with_option(BuildConfig(), "nodes.d_thresh", None, "--d-thresh") == BuildConfig()
    assert with_option(BuildConfig(), "nodes.d_thresh", 2.0, "--d-thresh").nodes.d_thresh == 2.0
    assert with_option(LocalizerConfig(), "coarse", "cnn-fc", "--coarse").coarse == "cnn-fc"
    with pytest.raises(settings_file.UsageError, match=r"^--max-jump: must be above 0, not 0\.0$"):
        with_option(TrackerConfig(), "max_jump", 0.0, "--max-jump")
