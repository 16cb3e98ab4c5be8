"""Settings as TOML, printed by `topoloc config` and read by `--config FILE`."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from topoloc import ConfigError
from topoloc.apps.cli import PLUGIN_PACKAGES, all_commands, load_plugins
from topoloc.apps.cli.output import UsageError
from topoloc.apps.core_names import describe_ranges, parse_tables, suggest_name
from topoloc.plugin import with_setting

T = TypeVar("T")

# table of the file -> module and class of its configuration, and the commands that read it
_QUERY_COMMANDS = ("localize", "evaluate", "explain", "serve", "follow")
TABLES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "build": ("topoloc.mapping.build", "BuildConfig", ("build", "map")),
    "localize": (
        "topoloc.localization.localizer",
        "LocalizerConfig",
        (*_QUERY_COMMANDS, "certify", "update", "merge"),
    ),
    "atlas": (
        "topoloc.atlas.config",
        "AtlasConfig",
        ("localize", "evaluate", "explain", "serve", "follow", "update"),
    ),
    "track": ("topoloc.tracking.config", "TrackerConfig", ("localize", "serve", "follow")),
    "robot": ("topoloc.apps.robots.config", "RobotConfig", ("follow",)),
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
    """The configurations of a file, and the defaults of all others."""

    def __init__(self, configs: dict[type, Any]) -> None:
        self._configs = configs

    def get(self, kind: type[T]) -> T:
        """Return the configuration of this class."""
        return self._configs[kind] if kind in self._configs else kind()


def read_settings(path: str | None) -> Settings:
    """Read the TOML file of `--config`, with the tables of all commands. None is an empty file.
    Raises ConfigError: the file is missing or not TOML, or a key is unknown or has an invalid
    value. The text names file and key."""
    if path is None:
        return Settings({})
    with ConfigError.at(path):
        configs = parse_tables(_parse_file(path), _find_class, f"{path}: ")
    return Settings({type(config): config for config in configs})


def _find_class(table: str) -> type:
    if table in all_tables():
        return config_class(table)
    if table in PLUGIN_PACKAGES and table not in all_commands():
        raise ConfigError(f"needs {PLUGIN_PACKAGES[table]}, which is not installed")
    raise ConfigError(f"no such table{suggest_name(table, all_tables())}")


def all_tables() -> dict[str, tuple[str, str, tuple[str, ...]]]:
    """Return the tables of all distributions. Plug-ins cannot replace tables of topoloc."""
    return TABLES | load_plugins("topoloc.settings") | TABLES


def config_class(table: str) -> type:
    """Return the class of a table's configuration."""
    module, name, _ = all_tables()[table]
    return getattr(importlib.import_module(module), name)


def with_option(config: T, key: str, value: Any, option: str) -> T:
    """Return the configuration with the value of a command line option, if it is not None. `key`:
    path of the setting, such as "nodes.d_thresh". Raises UsageError: the value is out of bounds.
    The text names the option."""
    if value is None:
        return config
    with UsageError.at(option, ConfigError):
        return with_setting(config, key, value)


def settings_text(tables: Sequence[str]) -> str:
    """Return the TOML of these tables: every setting with its default, meaning and bounds."""
    return "\n".join("\n".join(_format_table(config_class(table)(), table)) for table in tables)


def _format_table(config: Any, key: str, note: str = "") -> Iterator[str]:
    """Yield the lines of a table and its nested tables."""
    ranges, notes = describe_ranges(type(config)), read_field_docs(type(config))
    nested = [name for name in ranges if is_dataclass(getattr(config, name))]
    summary = (inspect.getdoc(type(config)) or "").partition("\n\n")[0]
    yield from _format_comment(f"{' '.join(summary.split())} {note}")
    yield f"[{key}]"
    for name, limits in ranges.items():
        if name not in nested:
            value = getattr(config, name)
            yield from _format_comment(notes.get(name, ""))
            line = f"# {name} =" if value is None else f"{name} = {_to_toml(value)}"
            yield f"{line}  # {limits}" if limits else line
    yield ""
    for name in nested:
        yield from _format_table(getattr(config, name), f"{key}.{name}", notes.get(name, ""))


def _format_comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def _to_toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_to_toml, value))}]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return repr(value)


@cache
def read_field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields, each in one line."""
    if not is_dataclass(kind):
        return {}
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    meanings = dict[str, str]()
    for base in kind.__bases__:
        meanings |= read_field_docs(base)
    for item, after in pairwise(body.body):
        match item, after:
            case ast.AnnAssign(target), ast.Expr(ast.Constant(text)):
                meanings[ast.unparse(target)] = " ".join(str(text).split())
    return meanings


def _parse_file(path: str) -> dict[str, Any]:
    try:
        with Path(path).open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(error.strerror or "cannot be read") from None
    if len(content) > _MAX_FILE_BYTES:
        raise ConfigError(f"larger than {_MAX_FILE_BYTES} bytes, too large for settings")
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:  # also invalid UTF-8 and numbers too long
        raise ConfigError(f"not TOML ({error})") from None
