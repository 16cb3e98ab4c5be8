"""Test map building (section III-A of the paper) end to end on a rendered room."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

import tiny_world
import topoloc
from topoloc.errors import EmptyMapError, RecordingError, TrajectoryError, UnreadableImageError
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.build import BuildConfig, build_node_map
from topoloc.mapping.node_drafts import finish_node
from topoloc.mapping.nodes import NodeConfig, NodePoses, node_distances
from topoloc.mapping.topomap import Edge, TopoMetricMap, TopoNode
from topoloc.recordings.recording import read_left_frame

ALONE = BuildConfig(nodes=NodeConfig(d_thresh=0.35, lambda_rot=1.0), other_kinds=())


@pytest.fixture
def own_recording(tiny_recording: Path, tmp_path: Path) -> Path:
    """Return a copy of the recording that a test may damage."""
    return Path(shutil.copytree(tiny_recording, tmp_path / "own"))


def depth_errors(node: TopoNode) -> np.ndarray:
    """Return measured minus exact depth of a node's points, in metres."""
    _, depth = tiny_world.render(tiny_world.room(), node.summary.world_from_cam, node.camera)
    columns, rows = np.rint(node.features.points_img).astype(int).T
    return node.points_cam[:, 2] - depth[rows, columns]


def test_nodes_follow_eq_1_and_every_image_belongs_to_the_nearest(tiny_map: TopoMetricMap):
    config = tiny_map.config
    poses = NodePoses.from_poses([summary.world_from_cam for summary in tiny_map.summaries])
    assert 2 <= len(tiny_map.nodes) <= len(tiny_map.place_images) == tiny_world.NUM_FRAMES // 2
    for image in tiny_map.place_images:
        distances = node_distances(image.world_from_cam, poses, config.lambda_rot)
        assert image.node_id == distances.argmin()
        assert distances.min() <= config.d_thresh
    assert [node.summary.node_id for node in tiny_map.nodes] == list(range(len(tiny_map.nodes)))


def test_a_build_with_data_on_disk_gives_the_same_map(
    tiny_recording: Path, tiny_map: TopoMetricMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    replace(tiny_map.with_first_layer(shared_errors=None), repetitions=None).save(
        tmp_path / "memory.topo"
    )
    monkeypatch.setattr("topoloc.disk_list.DEFAULT_MAX_BYTES", 0)
    build_node_map(topoloc.open_sequence(f"{tiny_recording}@0::2"), tiny_map.config).save(
        tmp_path / "disk.topo"
    )
    assert (tmp_path / "disk.topo").read_bytes() == (tmp_path / "memory.topo").read_bytes()


def test_points_are_right_and_refined_better_than_measured(
    tiny_recording: Path, tiny_map: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("topoloc.mapping.build.observe_draft", lambda *_: {})
    unrefined = build_node_map(topoloc.open_sequence(f"{tiny_recording}@0::2"), tiny_map.config)
    errors, errors_before = (
        np.concatenate([depth_errors(node) for node in m.nodes]) for m in (tiny_map, unrefined)
    )
    assert abs(np.nanmedian(errors)) < 0.01
    assert np.nanmedian(np.abs(errors)) < 0.02
    assert np.nanmedian(np.abs(errors)) <= 1.02 * np.nanmedian(np.abs(errors_before))
    sigma_z, sigma_z_before = (
        np.mean([np.median(node.point_sqrt_covs[:, 5]) for node in m.nodes])
        for m in (tiny_map, unrefined)
    )
    assert sigma_z < 0.9 * sigma_z_before


def test_a_node_has_the_contents_of_the_paper(tiny_map: TopoMetricMap):
    node = tiny_map.nodes[1]
    assert (
        len(node.features)
        == len(node.points_cam)
        == len(node.point_sqrt_covs)
        == node.summary.num_points
    )
    assert (np.diff(node.features.responses) <= 0).all()  # strongest first
    np.testing.assert_allclose(np.linalg.norm(node.features.descriptors, axis=1), 1.0, atol=1e-3)
    assert cv2.imdecode(
        np.frombuffer(node.template_image, np.uint8), cv2.IMREAD_GRAYSCALE
    ).shape == (240, 320)
    truth = tiny_world.path_pose(
        2.0 * [image.name for image in tiny_map.place_images].index(node.summary.name)
    )
    np.testing.assert_allclose(node.summary.world_from_cam.matrix(), truth.matrix(), atol=1e-6)


def test_limits_on_points_are_kept(tiny_recording: Path, monkeypatch: pytest.MonkeyPatch):
    few_points = partial(finish_node, max_points=50)
    monkeypatch.setattr("topoloc.mapping.build.finish_node", few_points)
    few = build_node_map(topoloc.open_sequence(f"{tiny_recording}@0:4"), ALONE)
    assert {summary.num_points for summary in few.summaries} == {50}


def test_points_of_a_lidar_are_as_exact_as_they_state(tmp_path: Path):
    """Lidar dots are interpolated to an eighth of the image, with 1 % of noise and smeared
    edges. Images farther away refine the points, although the nearest three nodes of each
    image are others."""
    folder = tiny_world.write_depth_recording(tmp_path / "rgbd", indices=[*np.arange(0.0, 9.0)])
    for seed, file in enumerate(sorted((folder / "depth").iterdir())):
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float32)
        dots = cv2.resize(depth, (20, 15), interpolation=cv2.INTER_AREA)
        dots *= 1.0 + 0.01 * np.random.default_rng(seed).standard_normal(dots.shape)
        coarse = cv2.resize(dots, (40, 30), interpolation=cv2.INTER_LINEAR)
        cv2.imwrite(str(file), np.rint(coarse).astype(np.uint16))
    every_image = replace(ALONE, nodes=NodeConfig(d_thresh=0.02, lambda_rot=1.0))
    nodes = build_node_map(topoloc.open_sequence(folder), every_image).nodes
    sigmas = np.concatenate([np.linalg.norm(n.point_sqrt_covs[:, 3:], axis=1) for n in nodes])
    depths = np.concatenate([node.points_cam[:, 2] for node in nodes])
    errors = np.abs(np.concatenate([depth_errors(node) for node in nodes]))
    assert np.nanmedian(errors / depths) < 0.015
    assert (errors < 2.0 * sigmas)[np.isfinite(errors)].mean() > 0.9


def test_depth_pictures_without_a_known_depth(tmp_path: Path):
    folder = tiny_world.write_depth_recording(tmp_path / "rgbd", indices=[0.0, 2.0])
    for file in (folder / "depth").iterdir():
        cv2.imwrite(str(file), np.zeros((30, 40), np.uint16))
    for config in (ALONE, replace(ALONE, nodes=NodeConfig())):
        with pytest.raises(EmptyMapError, match=r"rgbd: no .*; depth is unknown .0. in all of"):
            build_node_map(topoloc.open_sequence(folder), config)


def test_depth_pictures_make_a_map_too(tmp_path: Path):
    folder = tiny_world.write_depth_recording(tmp_path / "rgbd", indices=[0.0, 2.0, 4.0])
    topomap = build_node_map(topoloc.open_sequence(folder), ALONE)
    errors = np.concatenate([depth_errors(node) for node in topomap.nodes])
    assert np.nanmedian(np.abs(errors)) < 0.005


def test_two_recordings_make_one_map_without_an_edge_between_them(tiny_recording: Path):
    parts = [topoloc.open_sequence(f"{tiny_recording}@{part}") for part in ("0:4", "9:13")]
    topomap = build_node_map(parts, ALONE)
    last = topomap.place_images[3].node_id
    first = topomap.place_images[4].node_id
    assert first != last
    assert Edge(last, first) not in topomap.edges
    assert {edge.target_id for edge in topomap.edges} == set(range(len(topomap.nodes))) - {0, first}
    straight = tiny_world.path_pose(3).translation - tiny_world.path_pose(0).translation
    assert np.linalg.norm(straight) < topomap.length_m < 2.5 * np.linalg.norm(straight)


def test_two_builds_give_the_same_bytes(tiny_recording: Path, tmp_path: Path):
    for name in ("one", "two"):
        topoloc.build_map(topoloc.open_sequence(f"{tiny_recording}@0::2")).save(
            tmp_path / f"{name}.topo"
        )
    assert (tmp_path / "one.topo").read_bytes() == (tmp_path / "two.topo").read_bytes()


def test_the_number_of_threads_changes_no_byte(
    tiny_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for number in (1, 3):
        monkeypatch.setattr("topoloc.compiled._configured", [number])
        topoloc.build_map(topoloc.open_sequence(f"{tiny_recording}@0::2")).save(
            tmp_path / f"{number}.topo"
        )
    assert (tmp_path / "1.topo").read_bytes() == (tmp_path / "3.topo").read_bytes()


def test_two_builds_of_a_real_recording_give_the_same_bytes(shared: Path, tmp_path: Path):
    for name in ("one", "two"):
        build_node_map(topoloc.open_sequence(f"{shared}/data/zed_lab/session1@0:24:8")).save(
            tmp_path / name
        )
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_progress_is_reported(tiny_recording: Path):
    told: list[tuple[str, int, int]] = []
    build_node_map(
        topoloc.open_sequence(f"{tiny_recording}@0:3"), ALONE, lambda *step: told.append(step)
    )
    assert [step for step in told if step[0] == "images"] == [("images", k, 3) for k in (1, 2, 3)]
    assert [step[1] for step in told if step[0] == "nodes"][-1] == [
        step[2] for step in told if step[0] == "nodes"
    ][-1]


class CountedReads:
    """Count the reads of each frame of a recording."""

    def __init__(self, base: topoloc.StereoSequence) -> None:
        self.name, self.names, self.t_ns, self.poses = base.name, base.names, base.t_ns, base.poses
        self.base, self.reads = base, [0] * len(base)

    def __len__(self) -> int:
        return len(self.base)

    def __getitem__(self, index: int) -> topoloc.StereoFrame:
        self.reads[index] += 1
        return self.base[index]


def test_each_picture_is_read_once(tiny_recording: Path):
    recording = CountedReads(topoloc.open_sequence(f"{tiny_recording}@0:5"))
    build_node_map(recording, ALONE)
    assert recording.reads == [1] * 5


class CountedHalves(CountedReads):
    """Support reads of left images alone, and count them separately."""

    def __init__(self, base: topoloc.StereoSequence) -> None:
        super().__init__(base)
        self.halves = [0] * len(base)

    def read_left_frame(self, index: int) -> topoloc.StereoFrame:
        self.halves[index] += 1
        return read_left_frame(self.base, index)


def test_right_images_of_other_frames_than_nodes_are_not_read(tiny_recording: Path):
    recording = CountedHalves(topoloc.open_sequence(f"{tiny_recording}@0:5"))
    names = {node.summary.name for node in build_node_map(recording, ALONE).nodes}
    assert 0 < len(names) < 5
    assert [name in names for name in recording.names] == [bool(reads) for reads in recording.reads]
    assert [
        reads + halves for reads, halves in zip(recording.reads, recording.halves, strict=True)
    ] == [1] * 5


def test_an_unreadable_picture_is_named(own_recording: Path):
    (own_recording / "image_0" / "000003.png").write_bytes(b"\x89PNG")
    with pytest.raises(UnreadableImageError, match=r"000003\.png"):
        build_node_map(topoloc.open_sequence(own_recording), ALONE)


def test_nan_in_a_trajectory_is_refused(own_recording: Path):
    lines = (own_recording / "truth.tum").read_text().splitlines()
    lines[2] = lines[2].replace(lines[2].split()[3], "nan")
    (own_recording / "truth.tum").write_text("\n".join(lines))
    with pytest.raises(TrajectoryError, match=r"truth\.tum, line 3"):
        build_node_map(topoloc.open_sequence(own_recording))


def test_recordings_without_poses_or_depth_are_refused(own_recording: Path):
    (own_recording / "truth.tum").rename(own_recording / "hidden.tum")
    with pytest.raises(TrajectoryError, match="no frame has a pose"):
        build_node_map(topoloc.open_sequence(own_recording))
    shutil.rmtree(own_recording / "image_1")
    with pytest.raises(RecordingError, match="single pictures only"):
        topoloc.build_map(topoloc.open_sequence(own_recording))


def test_blank_pictures_become_no_node(own_recording: Path):
    for side in ("image_0", "image_1"):
        cv2.imwrite(str(own_recording / side / "000000.png"), np.full((240, 320), 90, np.uint8))
    topomap = build_node_map(topoloc.open_sequence(f"{own_recording}@0:6"), ALONE)
    assert "image_0/000000.png" not in [summary.name for summary in topomap.summaries]
    assert len(topomap.place_images) == 6
    with pytest.raises(EmptyMapError):
        build_node_map(topoloc.open_sequence(f"{own_recording}@0:1"), ALONE)
    with pytest.raises(EmptyMapError):
        build_node_map(topoloc.open_sequence(f"{own_recording}@0:1"))


def test_a_pose_that_jumps_makes_a_node_of_its_own(tiny_recording: Path):
    sequence = topoloc.open_sequence(f"{tiny_recording}@0:3")
    poses = list(sequence.poses)
    poses[1] = Rigid3(np.eye(3), np.array([500.0, 0.0, 0.0]))
    topomap = build_node_map(replace(sequence, poses=poses), ALONE)
    assert [image.node_id for image in topomap.place_images][1] == 1
