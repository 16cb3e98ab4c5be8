"""Test the peers on the tiny room: right poses, expected failures, and sizes on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc_paper.installed_size import installed_bytes
from topoloc_paper.peer_answers import PeerAnswer, rows_of, summarize_peer
from topoloc_paper.peer_colmap import Colmap
from topoloc_paper.peer_paper_step import PaperStep, solved
from topoloc_paper.peer_retrieval import Retrieval


@pytest.fixture(scope="module")
def frames() -> list[StereoFrame]:
    return [
        StereoFrame(f"view{i}", i, image, CAMERA, world_from_cam=pose)
        for i, (image, pose) in enumerate(unseen_views())
    ]


def _blank() -> StereoFrame:
    return StereoFrame("blank", 0, np.full((CAMERA.height, CAMERA.width), 128, np.uint8), CAMERA)


def test_the_papers_step_finds_the_room_and_refuses_a_blank_image(
    tiny_recording: Path, frames: list[StereoFrame]
):
    peer = PaperStep(built_room(tiny_recording), [open_sequence(tiny_recording)])
    answers = peer.localize([*frames, _blank()])
    assert answers[-1].world_from_cam is None
    found = summarize_peer(rows_of(frames, answers[:-1], Rigid3.identity()))
    assert found["num_localized"] >= 7
    assert found["median_translation_m"] < 0.05
    assert peer.map_bytes > 100_000
    assert peer.feature_name in ("OpenCV SURF", "OpenCV SIFT")


def test_retrieval_gives_a_nodes_pose_for_any_image(
    tiny_recording: Path, frames: list[StereoFrame]
):
    topomap = built_room(tiny_recording)
    answers = Retrieval(topomap).localize([*frames, _blank()])
    places = np.array([summary.world_from_cam.translation for summary in topomap.summaries])
    for answer in answers:
        assert answer.world_from_cam is not None
        assert np.linalg.norm(places - answer.world_from_cam.translation, axis=1).min() < 1e-9
    found = summarize_peer(rows_of(frames, answers[:-1], Rigid3.identity()))
    assert 0.0 < found["median_translation_m"] < 0.5


def test_pycolmap_finds_the_room(tiny_recording: Path, frames: list[StereoFrame], tmp_path: Path):
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    peer = Colmap(built_room(tiny_recording), [open_sequence(tiny_recording)], 10, tmp_path)
    answers = peer.localize([*frames[:4], _blank()])
    assert answers[-1].world_from_cam is None
    found = summarize_peer(rows_of(frames[:4], answers[:-1], Rigid3.identity()))
    assert found["num_localized"] >= 3
    assert found["median_translation_m"] < 0.05
    assert list(tmp_path.iterdir()) == []


def test_opencvs_default_pnp_solves_valid_matches():
    rng = np.random.default_rng(1)
    cam_from_world = Rigid3(exp_so3(np.array([0.1, -0.2, 0.05])), np.array([0.2, -0.1, 0.3]))
    points = rng.uniform([-2.0, -1.0, 3.0], [2.0, 1.0, 6.0], (40, 3))
    pixels = CAMERA.img_from_cam(cam_from_world.apply(points))
    found = solved(points, pixels, CAMERA)
    assert found is not None
    assert np.allclose(found.translation, cam_from_world.translation, atol=1e-3)
    assert solved(points[:3], pixels[:3], CAMERA) is None


def test_far_poses_and_poses_of_out_of_map_images_are_counted():
    truth, far = Rigid3.identity(), Rigid3(np.eye(3), np.array([0.6, 0.0, 0.0]))
    here = StereoFrame("a", 0, np.zeros((2, 2), np.uint8), CAMERA, world_from_cam=truth)
    stranger = StereoFrame("b", 0, np.zeros((2, 2), np.uint8), CAMERA)
    answers = [
        PeerAnswer(far, 3.0),
        PeerAnswer(truth, 1.0),
        PeerAnswer(None, 2.0),
        PeerAnswer(far, 9.0),
        PeerAnswer(None, 9.0),
    ]
    found = summarize_peer(
        rows_of([here, here, here, stranger, stranger], answers, Rigid3.identity())
    )
    assert (found["num_queries"], found["num_localized"], found["far_off"]) == (3, 2, 1)
    assert (found["num_elsewhere"], found["accepted"], found["ms"]) == (2, 1, 2.0)
    assert found["median_translation_m"] == pytest.approx(0.3)


def test_installed_size_counts_dependencies():
    numpy_alone = installed_bytes(["numpy"])
    assert numpy_alone is not None
    assert numpy_alone > 10_000_000
    with_needs = installed_bytes(["matplotlib"])
    assert with_needs is not None
    assert with_needs > numpy_alone
    assert installed_bytes(["no-such-distribution-anywhere"]) is None
