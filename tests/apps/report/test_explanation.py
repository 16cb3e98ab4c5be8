"""Test the explanation of a localized or refused image."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec import structs

from built_room import unseen_views, write_pictures
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.apps.report.explanation import explain
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def localizer(room_map: Path) -> Localizer:
    return Localizer(TopoMetricMap.load(room_map))


def test_a_reported_pose_is_among_the_tried_ones(localizer: Localizer, queries: Path):
    frame = open_sequence(queries)[0]
    explanation = explain(localizer, frame.image, frame.camera)
    assert explanation.result.localized
    assert [pose.verdict for pose in explanation.poses].count("the answer") >= 1
    best = explanation.best
    assert best is not None
    assert best.verdict == "the answer"
    assert explanation.num_features["surf"] == len(best.tried.fit.features)


def test_proposals_of_an_earlier_pose_are_marked(localizer: Localizer):
    """If no evidence suffices, each similar place is tried and leads to the same pose."""
    weights = load_fitted_weights("surf")
    weights = replace(weights, evidence=structs.replace(weights.evidence, clear_log_odds=1e9))
    never_clear = Localizer(localizer.topomap, weights=weights)
    verdicts = [
        pose.verdict
        for picture, _ in unseen_views()
        for pose in explain(never_clear, picture, CAMERA).poses
    ]
    assert "the same as an earlier pose" in verdicts
    assert verdicts.count("the answer") == len(unseen_views())


def test_a_dark_blank_image_is_described(localizer: Localizer, queries: Path):
    frame = open_sequence(queries)[0]
    assert frame.camera is not None
    dark = np.random.default_rng(0).integers(0, 4, frame.image.shape, dtype=np.uint8)
    dark[100:110, 100:110] = 30
    explanation = explain(localizer, dark, frame.camera)
    assert not explanation.result.localized
    assert any("darker than any session" in line for line in explanation.advice)


def test_a_wrong_calibration_is_reported(localizer: Localizer, queries: Path):
    frame = open_sequence(queries)[0]
    assert frame.camera is not None
    wrong = type(frame.camera).pinhole(
        320, 240, 1.12 * frame.camera.fx, 1.12 * frame.camera.fy, frame.camera.cx, frame.camera.cy
    )
    assert any(
        "the picture says f = 2" in line for line in explain(localizer, frame.image, wrong).advice
    )


def test_the_command_prints_and_writes_a_page(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    page, facts = tmp_path / "why.html", tmp_path / "why.json"
    assert (
        main(["explain", str(room_map), f"{queries}@0", "--out", str(page), "--json", str(facts)])
        == 0
    )
    assert "the answer" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "data:image/jpeg;base64," in text
    assert json.loads(facts.read_text())["tried"][0]["source"] == "retrieval"
    elsewhere = write_pictures(tmp_path / "elsewhere", unseen_views(seed=5, step=6.0))
    assert main(["explain", str(room_map), f"{elsewhere}@0"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("Not localized")
    assert "- " in out


def test_names_of_pictures_are_no_html(room_map: Path, queries: Path, tmp_path: Path):
    picture = tmp_path / "<script>alert(1)<img>.png"
    assert cv2.imwrite(str(picture), open_sequence(queries)[0].image)
    page = tmp_path / "why.html"
    assert (
        main(["explain", str(room_map), str(picture), "--camera", "map", "--out", str(page)]) == 0
    )
    assert "<script>" not in page.read_text(encoding="utf-8")


def test_many_pictures_are_too_many(
    room_map: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["explain", str(room_map), str(queries)]) == 2
    assert "@0 is its first" in capsys.readouterr().err


def test_a_damaged_node_image_is_named(room_map: Path, queries: Path, tmp_path: Path):
    with TopoMetricMap.load(room_map) as topomap:
        nodes = [replace(node, template=b"none") for node in topomap.nodes]
        topomap.with_first_layer(nodes=nodes).save(tmp_path / "damaged.topo")
    page, frame = tmp_path / "why.html", f"{queries}@0"
    assert main(["explain", str(tmp_path / "damaged.topo"), frame, "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert re.search(r"left the image, node \d+ is damaged: its image: not a picture", text)
    assert "Images of nodes that are missing or damaged" in text
