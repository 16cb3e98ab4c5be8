"""Compare depths of single images, taken from landmarks of a map, with depths of
the stereo pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import topoloc.demo
from topoloc import open_sequence
from topoloc.lifelong.session_content import MapPointLocator
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.mapping_frames import extract_mapping_image, select_posed_frames
from topoloc.points.metric_points import locate_points


def test_a_feature_lies_at_the_depth_of_the_landmarks_beside_it():
    lap = open_sequence(Path(topoloc.demo.__file__).with_name("lab") / "map_lap1")
    topomap = build_map(lap[0:8:2], BuildConfig(other_kinds=()))
    frame = select_posed_frames(lap[3:4], session_id=1)[0]
    single, kind = frame.view(with_depth=False), topomap.kind
    image = extract_mapping_image(frame, single, topomap.config)
    for learnt, least in ((set(), 0), ({frame.index}, 0.6)):
        located = MapPointLocator([frame], topomap, learnt).locate(frame, single, image)[0][kind]
        assert located.valid.mean() >= least
        assert located.valid.any() == bool(learnt)
    true = locate_points(image.features[kind], frame.view())
    rows = located.valid & true.valid
    off = np.abs(located.points_cam[rows, 2] / true.points_cam[rows, 2] - 1.0)
    assert np.median(off) < 0.02
    assert np.mean(off < 0.1) > 0.9
