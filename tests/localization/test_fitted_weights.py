"""Check that files of fitted weights are read strictly, and that a feature type without
weights is reported."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from topoloc.errors import FeatureTypeError
from topoloc.features.feature_types import find_feature_type
from topoloc.localization.fitted_weights import WEIGHTS_FOLDER, load_fitted_weights, read_weights


@pytest.mark.parametrize("path", sorted(WEIGHTS_FOLDER.iterdir()), ids=lambda path: path.name)
def test_each_shipped_file_has_a_feature_type_and_a_source(path: Path):
    weights = load_fitted_weights(path.stem)
    assert weights.kind == path.stem
    assert find_feature_type(weights.kind).name == weights.kind
    assert weights.calibration_error is not None
    assert 0.0 < weights.calibration_error < 0.1
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", weights.date)
    assert weights.corpus
    assert weights.command


def test_written_weights_are_read_again(tmp_path: Path):
    path = tmp_path / "surf.json"
    path.write_text(json.dumps(load_fitted_weights("surf").to_json()))
    assert read_weights(path) == load_fitted_weights("surf")


def test_a_type_without_a_file_uses_surfs_weights_and_is_not_calibrated():
    stand_in = load_fitted_weights("no such kind")
    assert not stand_in.is_calibrated
    assert stand_in.evidence == load_fitted_weights("surf").evidence


def _changed(change: Callable[[dict[str, Any]], Any]) -> str:
    read = load_fitted_weights("surf").to_json()
    change(read)
    return json.dumps(read)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "Expecting value"),
        ("[" * 100_000, "recursion"),
        ("[]", "Expected `object`, got `array`"),
        (_changed(lambda read: read.pop("date")), "missing required field `date`"),
        (_changed(lambda read: read.update(note="x")), "unknown field `note`"),
        (_changed(lambda read: read.update(corpus=3)), "corpus: Expected `str`, got `int`"),
        (
            _changed(lambda read: read["weights"].pop("walls")),
            "weights: Object missing required field `walls`",
        ),
        (
            _changed(lambda read: read["weights"].update(rivals=[])),
            "weights.rivals: Expected `object`, got `array`",
        ),
        (
            _changed(lambda read: read["weights"]["evidence"].pop("bias")),
            "weights.evidence: Object missing required field `bias`",
        ),
        (
            _changed(lambda read: read["weights"]["evidence"].update(bais=1.0)),
            "weights.evidence: Object contains unknown field `bais`",
        ),
        (
            _changed(lambda read: read["weights"]["evidence"].update(bias="7.6")),
            "weights.evidence.bias: Expected `float`, got `str`",
        ),
        (
            _changed(lambda read: read["weights"]["evidence"].update(bias=float("nan"))),
            "weights.evidence.bias: a finite number is expected",
        ),
        (
            _changed(lambda read: read["weights"]["shared_errors"].update(factor=True)),
            "weights.shared_errors.factor: Expected `float`, got `bool`",
        ),
    ],
)
def test_a_damaged_file_is_one_line(text: str, said: str, tmp_path: Path):
    path = tmp_path / "surf.json"
    path.write_text(text)
    with pytest.raises(FeatureTypeError, match=re.escape(said)) as raised:
        read_weights(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
