"""Check data against the published schema of results and the rules of OGC GeoPose."""

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


_NUMBER = {"type": "number"}


def strict_object(**members: Any) -> dict[str, Any]:
    """Return the schema of an object with exactly these members."""
    names = {"required": list(members), "properties": members}
    return {"type": "object", "additionalProperties": False} | names


def _between(least: float, most: float) -> dict[str, Any]:
    return _NUMBER | {"minimum": least, "maximum": most}


# The rules of OGC 21-056r11 in words of our own: Basic-Quaternion, strict, and Basic-YPR.
_POSITION = strict_object(lat=_between(-90, 90), lon=_between(-180, 180), h=_NUMBER)
_QUATERNION = strict_object(**dict.fromkeys("xyzw", _between(-1, 1)))
GEOPOSE = strict_object(position=_POSITION, quaternion=_QUATERNION)
GEOPOSE_YPR = strict_object(
    position=_POSITION, angles=strict_object(**dict.fromkeys(("yaw", "pitch", "roll"), _NUMBER))
)


def check_geopose(data: Any) -> None:
    """Check a Basic-Quaternion GeoPose in strict form, with unit length."""
    Draft202012Validator(GEOPOSE).validate(data)
    length = sum(value**2 for value in data["quaternion"].values()) ** 0.5
    assert abs(length - 1.0) < 1e-6


def check_result(line: dict[str, Any]) -> None:
    """Check that a line follows the schema and has no unknown key."""
    Draft202012Validator(SCHEMA).validate(line)
    for one in (line, *line.get("alternatives", ())):
        if "geopose" in one:
            check_geopose(one["geopose"])
    of_its_kind = SCHEMA["then" if line["localized"] else "else"]["properties"]
    assert set(line) <= set(SCHEMA["properties"]) | set(of_its_kind), (
        "a key that the schema does not know"
    )
