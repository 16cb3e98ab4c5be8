"""Check that frames written one by one can be read as a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import assert_same_pose, pose
from topoloc.apps.formats.recording_writer import RecordingWriter
from topoloc.errors import RecordingError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import DepthImage, StereoFrame, StereoSequence
from topoloc.recordings.open import open_sequence

CAMERA = Camera.pinhole(32, 24, 40.0, 41.0, 15.5, 11.5)
DISTORTED = Camera("OPENCV", 32, 24, (40.0, 41.0, 15.0, 11.0, -0.1, 0.01, 0.001, 0.002))
RIGS = {
    "rectified": StereoRig.rectified(CAMERA, 0.12),
    "distorted": StereoRig(
        DISTORTED,
        CAMERA,
        Rigid3(exp_so3(np.array([0.0, 0.02, 0.0])), np.array([-0.12, 0.001, 0.0])),
    ),
}


def frame(
    index: int, rig: StereoRig | None = None, with_depth: bool = False, with_pose: bool = True
) -> StereoFrame:
    rng = np.random.default_rng(index)
    left, right = (rng.integers(0, 256, (24, 32, 3), dtype=np.uint8) for _ in range(2))
    camera = CAMERA if rig is None else rig.left
    depth = rng.uniform(0.5, 90.0, (24, 32)).astype(np.float32)
    depth[0, 0] = np.nan
    its = StereoFrame(str(index), 1_700_000_000_000_000_001 + 33_333_333 * index, left, camera)
    if rig is not None:
        its = replace(its, right=right, rig=rig)
    its = replace(its, depth=DepthImage(depth, camera)) if with_depth else its
    return replace(its, world_from_cam=pose(index)) if with_pose else its


def write(folder: Path, frames: list[StereoFrame], jpeg: int | None = None) -> None:
    with RecordingWriter(folder, jpeg) as writer:
        for one in frames:
            writer.write(one)


def list_of(sequence: StereoSequence) -> list[StereoFrame]:
    return [sequence[index] for index in range(len(sequence))]


@pytest.mark.parametrize("rig", RIGS)
def test_stereo_comes_back(tmp_path: Path, rig: str):
    frames = [frame(index, RIGS[rig]) for index in range(3)]
    write(tmp_path / "out", frames)
    read = open_sequence(tmp_path / "out")
    assert read.t_ns == [one.t_ns for one in frames]
    for one, its in zip(frames, list_of(read), strict=True):
        np.testing.assert_array_equal(its.image, one.image)
        assert its.right is not None
        assert one.right is not None
        np.testing.assert_array_equal(its.right, one.right)
        assert its.rig is not None
        assert its.rig.left == RIGS[rig].left
        assert its.rig.right == RIGS[rig].right
        assert_same_pose(its.rig.right_from_left, RIGS[rig].right_from_left)
        assert_same_pose(its.world_from_cam, one.world_from_cam)


def test_depth_comes_back(tmp_path: Path):
    frames = [frame(index, with_depth=True, with_pose=False) for index in range(2)]
    write(tmp_path / "out", frames)
    for one, its in zip(frames, list_of(open_sequence(tmp_path / "out")), strict=True):
        assert its.depth is not None
        assert one.depth is not None
        np.testing.assert_allclose(
            its.depth.depth, one.depth.depth, atol=0.0021
        )  # half a step, NaN if unknown
        assert its.world_from_cam is None


def test_depth_of_a_pair_lies_beside_it(tmp_path: Path):
    write(tmp_path / "out", [frame(0, RIGS["rectified"], with_depth=True)])
    assert (tmp_path / "out/depth/000000.png").is_file()
    assert open_sequence(tmp_path / "out")[0].right is not None


def test_readable_after_each_frame(tmp_path: Path):
    with RecordingWriter(tmp_path / "out") as writer:
        for index in range(4):
            writer.write(frame(index, RIGS["rectified"]))
            assert len(open_sequence(tmp_path / "out")) == index + 1


def test_existing_files_are_never_overwritten(tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/thesis.tex").write_text("x")
    with pytest.raises(TopolocError, match=r"is not empty and has thesis\.tex"):
        RecordingWriter(tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]
    with pytest.raises(TopolocError, match="cannot write"):
        RecordingWriter(tmp_path / "no/such/folder")


def test_a_frame_that_fails_leaves_nothing_of_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from topoloc.apps.formats import recording_writer

    written, write_bytes = [], recording_writer.write_bytes

    def until_the_disk_is_full(path: Path, data: bytes) -> None:
        if len(written) == 3:
            raise TopolocError(f"cannot write {path}: No space left on device")
        written.append(path)
        write_bytes(path, data)

    monkeypatch.setattr(recording_writer, "write_bytes", until_the_disk_is_full)
    frames = [frame(index, RIGS["rectified"]) for index in range(3)]
    with pytest.raises(TopolocError, match="No space left"):
        write(tmp_path / "out", frames)
    assert len(open_sequence(tmp_path / "out")) == 1


def test_frames_of_one_kind(tmp_path: Path):
    with pytest.raises(RecordingError, match="another kind"):
        write(tmp_path / "out", [frame(0, RIGS["rectified"]), frame(1)])
    assert len(open_sequence(tmp_path / "out")) == 1


def test_nothing_written_leaves_no_folder(tmp_path: Path):
    write(tmp_path / "out", [])
    assert not (tmp_path / "out").exists()
