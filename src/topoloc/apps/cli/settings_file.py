"""Settings as TOML: what `topoloc config` prints and `--config FILE` reads, both from the
configurations as they are declared."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from topoloc import ConfigError
from topoloc.apps.cli import PLUGIN_PACKAGES, all_commands, load_plugins
from topoloc.apps.cli.output import UsageError
from topoloc.plugin import (
    describe_range,
    drop_removed_settings,
    field_annotations,
    find_violation,
    parse_settings,
    quote_key,
    suggest_name,
)

T = TypeVar("T")

# table of the file: module and class of its configuration, and the commands that it is for; more
# come with other distributions
_QUERY_COMMANDS = ("localize", "evaluate", "explain", "serve", "follow")
TABLES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "build": ("topoloc.mapping.build", "BuildConfig", ("build",)),
    "localize": (
        "topoloc.localization.localizer",
        "LocalizerConfig",
        (*_QUERY_COMMANDS, "update", "merge"),
    ),
    "atlas": (
        "topoloc.atlas.config",
        "AtlasConfig",
        ("localize", "evaluate", "explain", "serve", "follow", "update"),
    ),
    "track": ("topoloc.tracking.config", "TrackerConfig", ("localize", "serve", "follow")),
    "serve": ("topoloc.apps.service.config", "ServiceConfig", ("serve",)),
    "cluster": (
        "topoloc.apps.cluster.config",
        "ClusterConfig",
        ("build", "atlas", "update", "evaluate"),
    ),
    "replicas": ("topoloc.apps.cluster.config", "ReplicasConfig", ("serve",)),
}
_WIDTH = 110
_MAX_FILE_BYTES = 1_000_000


class Settings:
    """The configurations that a file sets; of all others the defaults."""

    def __init__(self, configs: dict[type, Any]) -> None:
        self._configs = configs

    def of(self, kind: type[T]) -> T:
        """The configuration of this class."""
        return self._configs[kind] if kind in self._configs else kind()


def read_settings(path: str | None) -> Settings:
    """What the TOML file of `--config` says; None says nothing. Tables of other commands are read,
    too, and left aside.

    Raises:
        ConfigError: no such file, not TOML, or a key that is unknown, of the wrong type or out of
            its bounds; file and key are named.
    """
    if path is None:
        return Settings({})
    try:
        configs = []
        for name, table in drop_removed_settings(_parse_file(path), source=f"{path}: ").items():
            if name not in all_tables():
                is_missing = name in PLUGIN_PACKAGES and name not in all_commands()
                unknown = f"no such table{suggest_name(name, all_tables())}"
                raise ConfigError(
                    f"{quote_key(name)}:"
                    f" {f'comes with {PLUGIN_PACKAGES[name]}, which is not installed' if is_missing else unknown}"  # noqa: E501
                )
            kind = config_class(name)
            configs.append(parse_settings(kind, table, name, default=kind()))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Settings({type(config): config for config in configs})


def all_tables() -> dict[str, tuple[str, str, tuple[str, ...]]]:
    """Our tables and those that other distributions bring, as `TABLES`; a name of ours is ours."""
    return TABLES | load_plugins("topoloc.settings") | TABLES


def config_class(table: str) -> type:
    """The configuration that a table of the file sets."""
    module, name, _ = all_tables()[table]
    return getattr(importlib.import_module(module), name)


def with_option(config: T, key: str, value: Any, option: str) -> T:
    """The configuration with an option of the command line at `key` ("nodes.d_thresh"), unless that
    is None: was not given.

    Raises:
        UsageError: out of bounds; names the option.
    """
    if value is None:
        return config
    name, _, rest = key.partition(".")
    if rest:
        return replace(config, **{name: with_option(getattr(config, name), rest, value, option)})  # pyright: ignore[reportArgumentType]
    if wrong := find_violation(value, field_annotations(type(config))[name]):
        raise UsageError(f"{option}: {wrong}")
    return replace(config, **{name: value})  # pyright: ignore[reportArgumentType]


def settings_text(tables: Sequence[str]) -> str:
    """The TOML of these tables: every setting with its default, what it means and its bounds."""
    return "\n".join("\n".join(_format_table(config_class(table)(), table)) for table in tables)


def _format_table(config: Any, key: str, note: str = "") -> Iterator[str]:
    """A table and those in it."""
    kinds, notes = field_annotations(type(config)), read_field_docs(type(config))
    nested = [name for name in kinds if is_dataclass(getattr(config, name))]
    yield from _format_comment(" ".join(filter(None, (_class_summary(type(config)), note))))
    yield f"[{key}]"
    for name, kind in kinds.items():
        if name not in nested:
            value = getattr(config, name)
            yield from _format_comment(notes.get(name, ""))
            line = f"# {name} =" if value is None else f"{name} = {_to_toml(value)}"
            limits = describe_range(kind)
            yield f"{line}  # {limits}" if limits else line
    yield ""
    for name in nested:
        yield from _format_table(getattr(config, name), f"{key}.{name}", notes.get(name, ""))


def _format_comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def _class_summary(kind: type) -> str:
    """The first paragraph of a class's docstring."""
    return " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split())


def _to_toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_to_toml, value))}]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return repr(value)


@cache
def read_field_docs(kind: type) -> dict[str, str]:
    """The docstrings of a dataclass's fields, each in one line."""
    if not is_dataclass(kind):
        return {}
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    meanings = {
        name: text for base in kind.__bases__ for name, text in read_field_docs(base).items()
    }
    for item, after in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(item, ast.AnnAssign)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            meanings[ast.unparse(item.target)] = " ".join(str(after.value.value).split())
    return meanings


def _parse_file(path: str) -> dict[str, Any]:
    try:
        with Path(path).open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(error.strerror or "cannot be read") from None
    if len(content) > _MAX_FILE_BYTES:
        raise ConfigError(f"larger than {_MAX_FILE_BYTES} bytes, no file of settings")
    try:
        return tomllib.loads(content.decode())
    except (
        ValueError,
        RecursionError,
        # tomllib's own error is a ValueError, as are those of bad UTF-8 and of numbers too long
    ) as error:
        raise ConfigError(f"not TOML ({error})") from None
