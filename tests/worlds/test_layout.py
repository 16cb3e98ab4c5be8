from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import RecordingError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings import atomic
from topoloc.recordings.open import open_sequence
from topoloc.recordings.trajectory import Trajectory
from topoloc_worlds.layout import Layout, missing_frames, prepare, write_shot
from topoloc_worlds.shots import Shot

CAMERA = Camera.pinhole(24, 16, 20.0, 20.0, 11.5, 7.5)
POSES = [Rigid3.exp(np.array([0.1 * i, 0.2, 0.0, 0.0, 0.02 * i, 0.0])) for i in range(3)]
TRAJECTORY = Trajectory(POSES, [0, 100_000_000, 200_000_001])
SETTINGS: dict[str, object] = {"world": "box", "route": {"laps": 1.0, "seed": 0}}


def shot(index: int, stereo: bool) -> Shot:
    rng = np.random.default_rng(index)
    left, right = (
        np.repeat(rng.integers(40, 200, (1, 1, 3)), 16 * 24, axis=0)
        .reshape(16, 24, 3)
        .astype(np.uint8)
        for _ in range(2)
    )
    depth = np.full((16, 24), 1.25 + index, np.float32)
    depth[0, 0], depth[0, 1] = np.nan, 400.0
    return Shot(left, right if stereo else None, depth)


def write(layout: Layout, frames: tuple[int, ...] = (0, 1, 2), overwrite: bool = False) -> None:
    prepare(layout, SETTINGS, TRAJECTORY, overwrite)
    for index in frames:
        write_shot(layout, index, shot(index, layout.baseline is not None))


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("jpeg", [None, 95])
@pytest.mark.parametrize("depth_factor", [None, 1000.0])
@pytest.mark.parametrize("baseline", [None, 0.12])
def test_every_layout_opens_as_what_it_is(
    tmp_path: Path, baseline: float | None, depth_factor: float | None, jpeg: int | None, grey: bool
):
    write(Layout(tmp_path, CAMERA, baseline, grey, jpeg, depth_factor))
    sequence = open_sequence(tmp_path)
    frame, taken = sequence[1], shot(1, baseline is not None)
    assert len(sequence) == 3
    assert sequence.t_ns == TRAJECTORY.t_ns
    assert frame.camera == CAMERA
    assert frame.world_from_cam is not None
    np.testing.assert_allclose(frame.world_from_cam.matrix(), POSES[1].matrix(), atol=1e-9)
    assert frame.image.ndim == (2 if grey else 3)
    if not grey:
        np.testing.assert_allclose(
            frame.image.astype(int), taken.left, atol=0 if jpeg is None else 6
        )
    if baseline is not None:
        assert frame.rig is not None
        assert frame.rig.baseline == pytest.approx(baseline)
        assert taken.right is not None
        assert frame.right is not None
        if not grey:
            np.testing.assert_allclose(
                frame.right.astype(int), taken.right, atol=0 if jpeg is None else 6
            )
    elif depth_factor is not None:
        assert frame.depth is not None
        assert np.isnan(frame.depth.depth[0, :2]).all(), "sky, and beyond 16 bits"
        np.testing.assert_allclose(frame.depth.depth[1:], 2.25, atol=1e-3)
    else:
        assert frame.depth is None
        assert frame.right is None


def test_a_recording_in_the_making_does_not_open_as_a_whole_one(tmp_path: Path):
    layout = Layout(tmp_path, CAMERA, 0.12)
    write(layout, frames=(0, 2))
    assert missing_frames(layout, 3) == [1]
    notes: list[str] = []
    assert open_sequence(tmp_path, warn=notes.append, whole_only=True).t_ns == TRAJECTORY.t_ns[::2]
    assert "1 of 3 frames left out: image missing" in notes[-1]
    next(iter(layout.pictures(0).values())).unlink()
    assert missing_frames(layout, 3) == [0, 1]
    with pytest.raises(RecordingError, match="2 of 3 frames have a missing"):
        open_sequence(tmp_path, whole_only=True)


def test_other_settings_are_named_and_nothing_is_touched(tmp_path: Path):
    layout = Layout(tmp_path, CAMERA, 0.12)
    write(layout)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(
        TopolocError, match=r"other settings \(route\.seed was 0, now 4\); .*--overwrite"
    ):
        prepare(
            layout, {"world": "box", "route": {"laps": 1.0, "seed": 4}}, TRAJECTORY, overwrite=False
        )
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_overwrite_removes_the_recording_and_no_other_file(tmp_path: Path):
    write(Layout(tmp_path, CAMERA, 0.12))
    (tmp_path / "notes.txt").write_text("mine")
    write(Layout(tmp_path, CAMERA, None), frames=(0,), overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "camera.json", "images", "notes.txt", "times.txt", "truth.tum", "world.json",
    ]  # fmt: skip


@pytest.mark.parametrize("overwrite", [False, True])
def test_folders_of_others_are_left_alone(tmp_path: Path, overwrite: bool):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(TopolocError, match="holds other files"):
        write(Layout(tmp_path, CAMERA, 0.12), overwrite=overwrite)
    (tmp_path / "world.json").write_text('{"made_by": "a game"}')
    with pytest.raises(TopolocError, match="not written by topoloc simulate"):
        write(Layout(tmp_path, CAMERA, 0.12), overwrite=overwrite)
    with pytest.raises(TopolocError, match="it is a file"):
        write(Layout(tmp_path / "thesis.tex", CAMERA, 0.12), overwrite=overwrite)
    with pytest.raises(TopolocError, match="Not a directory"):
        write(Layout(tmp_path / "thesis.tex" / "out", CAMERA, 0.12), overwrite=overwrite)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_full_disk_leaves_no_half_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    layout = Layout(tmp_path, CAMERA, 0.12)
    write(layout, frames=(0,))

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(atomic.Path, "write_bytes", full)
    with pytest.raises(TopolocError, match=r"cannot write .*000001\.png: No space left on device"):
        write_shot(layout, 1, shot(1, stereo=True))
    monkeypatch.undo()
    assert missing_frames(layout, 3) == [1, 2]
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]


def test_partial_files_of_a_killed_run_are_removed(tmp_path: Path):
    layout = Layout(tmp_path, CAMERA, 0.12)
    write(layout, frames=(0,))
    half = tmp_path / layout.left / ".000001.png.77.part"
    half.write_bytes(b"half")
    write(layout)
    assert not half.exists()
