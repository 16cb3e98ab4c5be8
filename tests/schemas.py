"""The published schema of results, and results held against it."""

from __future__ import annotations

import importlib.resources
import json
from typing import Any

from jsonschema import Draft202012Validator

SCHEMA = json.loads(
    (importlib.resources.files("topoloc") / "localization" / "result.schema.json").read_text(
        encoding="utf-8"
    )
)


def check_result(line: dict[str, Any]) -> None:
    """A line that the schema allows for, and that has no key that it does not know."""
    Draft202012Validator(SCHEMA).validate(line)
    of_its_kind = SCHEMA["then" if line["localized"] else "else"]["properties"]
    assert set(line) <= set(SCHEMA["properties"]) | set(of_its_kind), (
        "a key that the schema does not know"
    )
