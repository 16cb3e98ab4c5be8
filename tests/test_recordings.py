"""Test the whole pipeline on real recordings. benchmarks/real_recordings.py prints
the full figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from topoloc.evaluation.metrics import summarize
from topoloc.evaluation.query_localization import localize_out_of_map, localize_queries
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.mapping.build import BuildConfig, build_node_map
from topoloc.mapping.nodes import NodeConfig
from topoloc.recordings.frame import sequence_subset
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def lab(shared: Path) -> Localizer:
    return Localizer(
        build_node_map(
            open_sequence(shared / "data/zed_lab/session1@0::2"),
            BuildConfig(nodes=NodeConfig(d_thresh=0.5)),
        )
    )


def test_another_session_in_the_lab(lab: Localizer, shared: Path):
    matrix = json.loads((shared / "data/zed_lab/session1_from_session2.json").read_text())[
        "session1_from_session2"
    ]
    queries = open_sequence(shared / "data/zed_lab/session2@0:99:4")
    summary = summarize(localize_queries(lab, queries, Rigid3.from_matrix(np.array(matrix))))
    assert summary["num_localized"] == summary["num_queries"] == 25
    assert summary["median_translation_m"] < 0.009
    assert summary["median_rotation_deg"] < 0.3
    assert summary["false_accepts"] == 0


def test_a_street_is_not_the_lab(lab: Localizer, shared: Path):
    answers = localize_out_of_map(lab, open_sequence(shared / "data/kitti/sequences/street1@0::5"))
    assert summarize(answers)["false_accepts"] == 0


def test_the_odd_frames_of_a_street_in_the_map_of_the_even_ones(shared: Path):
    localizer = Localizer(
        build_node_map(open_sequence(shared / "data/kitti/sequences/street1@0:30:2"))
    )
    summary = summarize(
        localize_queries(localizer, open_sequence(shared / "data/kitti/sequences/street1@1:29:2"))
    )
    assert summary["num_localized"] == summary["num_queries"] == 14
    assert summary["median_translation_m"] < 0.03
    assert summary["median_rotation_deg"] < 0.06


def test_a_kitchen_by_depth_camera(shared: Path):
    kitchen = open_sequence(shared / "data/seven_scenes/kitchen")
    mapping = sequence_subset(kitchen, [i for i in range(120) if i % 20 < 12])
    localizer = Localizer(build_node_map(mapping, BuildConfig(nodes=NodeConfig(d_thresh=0.5))))
    summary = summarize(
        localize_queries(localizer, sequence_subset(kitchen, list(range(16, 120, 20))))
    )
    assert summary["num_localized"] == summary["num_queries"]
    assert summary["median_translation_m"] < 0.016
    assert summary["median_rotation_deg"] < 0.6
