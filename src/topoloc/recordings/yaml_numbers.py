"""Read numbers from calibration files in YAML, as written by EuRoC, Kalibr, OpenCV and ROS.

The files come with or without OpenCV's header and in several styles of YAML. So only words and
numbers after the needed keys are read. Tags and aliases are ignored.
"""

from __future__ import annotations

import re
from pathlib import Path

from topoloc.errors import CalibrationError
from topoloc.recordings.text_files import read_text

_MAX_CHARS = 1_000_000
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def read_yaml(path: Path) -> str:
    """Return the text of a calibration without comments. Raises CalibrationError with the file
    name."""
    text = read_text(path, CalibrationError, "no calibration here")
    if len(text) > _MAX_CHARS:
        raise CalibrationError(f"{path}: {len(text)} characters are no calibration")
    return re.sub(r"#.*", "", text)


def yaml_word(text: str, key: str, default: str) -> str:
    """Return the word after a key, or `default`."""
    found = re.search(rf"^\s*{key}:\s*[\"']?([\w-]+)", text, re.MULTILINE)
    return found[1] if found else default


def yaml_numbers(text: str, *keys: str) -> list[float]:
    """Return all numbers after the first existing key, up to the next key other than `cols`,
    `rows`, `dt` or `data`."""
    for key in keys:
        found = re.search(
            rf"^[ \t]*{key}:(.*?)(?=^[ \t]*(?!(?:cols|rows|dt|data)\b)[A-Za-z_]\w*:|\Z)",
            text,
            re.MULTILINE | re.DOTALL,
        )
        if found:
            return [
                float(number)
                for number in _NUMBER.findall(re.sub(r"\b(?:cols|rows|dt):.*", "", found[1]))
            ]
    return []


def require_numbers(path: Path, text: str, count: int, *keys: str) -> list[float]:
    """Return the first `count` numbers after one of these keys. Raises CalibrationError with the
    file name."""
    numbers = yaml_numbers(text, *keys)
    if len(numbers) < count:
        raise CalibrationError(f"{path}: {' or '.join(keys[:3])} with {count} numbers is missing")
    return numbers[:count]
