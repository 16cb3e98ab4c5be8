from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_world import BOX_WORLD, RAINY_WORLD

from topoloc.errors import CalibrationError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.mapping.build import build_node_map
from topoloc.recordings.open import open_sequence
from topoloc_worlds.conditions import CONDITIONS
from topoloc_worlds.recorder import RecordConfig, record
from topoloc_worlds.rendering.renderer import RenderConfig
from topoloc_worlds.sensor import SensorConfig

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

DAY = CONDITIONS["day"]
SMALL = Camera.pinhole(64, 40, 38.0, 38.0, 31.5, 19.5)
CONFIG = RecordConfig(
    route=replace(BOX_WORLD.route(), num_frames=4, start=2.0),
    camera=SMALL,
    baseline=0.12,
    render=RenderConfig.draft(),
    depth=True,
)


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of the test room. Read-only."""
    out = tmp_path_factory.mktemp("recorded") / "box"
    result = record(BOX_WORLD, DAY, out, CONFIG)
    assert (result.num_frames, result.num_rendered) == (4, 4)
    return out


def test_a_recording_is_complete_with_its_settings(recorded: Path):
    assert len(files(recorded)) == 3 * 4 + 4
    sequence = open_sequence(recorded)
    assert len(sequence) == 4
    frame = sequence[0]
    assert frame.right is not None
    assert 20 < frame.image.mean() < 220
    assert np.abs(frame.image.astype(int) - frame.right).mean() > 1
    settings = json.loads((recorded / "world.json").read_text())
    assert (settings["world"], settings["condition"], settings["num_frames"]) == ("box", "day", 4)
    assert {"seed", "arrangement", "route", "camera", "render", "topoloc", "variant"} <= set(
        settings
    )


def test_another_run_gives_the_same_bytes_with_any_number_of_processes(
    recorded: Path, tmp_path: Path
):
    record(BOX_WORLD, DAY, tmp_path / "box", CONFIG, processes=2)
    assert files(tmp_path / "box") == files(recorded)


def test_interrupted_it_goes_on_where_it_stopped(recorded: Path, tmp_path: Path):
    out = tmp_path / "box"

    def stop_at_two(stage: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(BOX_WORLD, DAY, out, CONFIG, stop_at_two)
    left = files(out)
    assert sum(name.startswith("image_2/") for name in left) == 2
    assert {name: files(recorded)[name] for name in left} == left, "every file there is whole"
    notes: list[str] = []
    assert len(open_sequence(out, warn=notes.append, whole_only=True)) == 2
    assert "2 of 4 frames left out: image missing" in notes[-1]
    seen: list[int] = []
    result = record(BOX_WORLD, DAY, out, CONFIG, lambda stage, done, total: seen.append(done))
    assert (result.num_frames, result.num_rendered) == (4, 2)
    assert seen == [2, 3, 4]
    assert files(out) == files(recorded)


def test_a_whole_recording_is_not_rendered_again(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out = Path(shutil.copytree(recorded, tmp_path / "box"))
    monkeypatch.setattr("topoloc_worlds.recorder.shoot", None)
    assert record(BOX_WORLD, DAY, out, CONFIG).num_rendered == 0
    assert files(out) == files(recorded)


def test_other_settings_need_another_folder(recorded: Path, tmp_path: Path):
    out = Path(shutil.copytree(recorded, tmp_path / "box"))
    with pytest.raises(TopolocError, match=r'condition was "day", now "night"'):
        record(BOX_WORLD, CONDITIONS["night"], out, CONFIG)
    with pytest.raises(TopolocError, match=r"seed was 0, now 3"):
        record(BOX_WORLD, DAY, out, replace(CONFIG, seed=3))
    assert files(out) == files(recorded)


def test_truth_agrees_with_the_rendered_geometry(recorded: Path):
    """Points of one frame's depth, moved by truth.tum, match another frame's depth to a
    tenth of a pixel."""
    poses = open_sequence(recorded).poses
    depths = [
        cv2.imread(str(recorded / "depth_2" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED) / 5000.0
        for i in range(4)
    ]
    grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([SMALL.normalized_from_img(grid), np.ones(len(grid))])
    first, last = poses[0], poses[3]
    assert first is not None
    assert last is not None
    last_from_first = last.inverse() @ first
    assert np.linalg.norm(last_from_first.translation) > 0.15
    in_last = last_from_first.apply(rays * depths[0].reshape(-1, 1))
    at = SMALL.img_from_cam(in_last)
    seen = cv2.remap(
        1.0 / depths[3], at[:, 0].astype(np.float32), at[:, 1].astype(np.float32), cv2.INTER_LINEAR
    ).ravel()
    inside = np.all((at > 1) & (at < [62, 38]), axis=1)
    assert inside.mean() > 0.5
    surface = in_last[inside] / (seen * in_last[:, 2])[inside, None]
    back = SMALL.img_from_cam(last_from_first.inverse().apply(surface))
    assert np.median(np.linalg.norm(back - grid[inside], axis=1)) < 0.1


def test_depth_predicts_the_point_in_the_right_image(tmp_path: Path):
    camera = Camera.pinhole(160, 100, 95.0, 95.0, 79.5, 49.5)
    quiet = SensorConfig(full_well=1e9, read_noise=0.0)
    fine = replace(
        RenderConfig(), bake=CONFIG.render.bake
    )  # of the light that other tests have traced
    config = replace(
        CONFIG, camera=camera, sensor=quiet, render=fine, route=replace(CONFIG.route, num_frames=1)
    )
    record(BOX_WORLD, DAY, tmp_path / "box", replace(config, grey=True))
    frame = open_sequence(tmp_path / "box")[0]
    depth = (
        cv2.imread(str(tmp_path / "box" / "depth_0" / "000000.png"), cv2.IMREAD_UNCHANGED) / 5000.0
    )
    assert frame.right is not None
    points = cv2.goodFeaturesToTrack(frame.image, 300, 0.02, 4)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        frame.image, frame.right, points, points.copy(), winSize=(13, 13)
    )
    start, end = points[status.ravel() == 1, 0], found[status.ravel() == 1, 0]
    assert len(start) > 40
    there = depth[np.rint(start[:, 1]).astype(int), np.rint(start[:, 0]).astype(int)]
    off = end - start + np.column_stack([camera.fx * 0.12 / there, np.zeros(len(start))])
    assert np.all(np.abs(np.median(off, axis=0)) < 0.1)
    assert np.median(np.linalg.norm(off, axis=1)) < 0.2, "the trackers' own error in it"


def test_a_recording_can_be_mapped(tmp_path: Path):
    camera = Camera.pinhole(160, 100, 95.0, 95.0, 79.5, 49.5)
    route = replace(CONFIG.route, num_frames=3, spacing=0.4)
    record(
        BOX_WORLD,
        DAY,
        tmp_path / "box",
        replace(CONFIG, camera=camera, route=route, depth=False, jpeg=90),
    )
    topomap = build_node_map([open_sequence(tmp_path / "box")])
    assert len(topomap.summaries) >= 2
    assert sum(summary.num_points for summary in topomap.summaries) > 30


def test_night_is_darker_than_day_and_rain_falls(recorded: Path, tmp_path: Path):
    one = replace(
        CONFIG, route=replace(CONFIG.route, num_frames=1), sensor=SensorConfig(max_gain=1.0)
    )
    brightness = {}
    for name in ("day", "night"):
        record(BOX_WORLD, CONDITIONS[name], tmp_path / name, one)
        brightness[name] = open_sequence(tmp_path / name)[0].image.mean()
    assert 0 < brightness["night"] < brightness["day"]
    for world, out in ((BOX_WORLD, "dry"), (RAINY_WORLD, "wet")):
        record(world, CONDITIONS["rain"], tmp_path / out, one)
    assert not np.array_equal(*(open_sequence(tmp_path / out)[0].image for out in ("dry", "wet")))


@pytest.mark.parametrize(
    "change",
    [{"baseline": 0.0}, {"camera": Camera("RADIAL", 64, 40, (38.0, 31.5, 19.5, 0.1, 0.0))}],
)
def test_cameras_that_cannot_be_rendered(change: dict[str, object]):
    with pytest.raises(CalibrationError):
        replace(CONFIG, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [{"jpeg": 0}, {"num_renderings": 0}, {"lens_drops": -1}])
def test_impossible_settings_are_refused(change: dict[str, int]):
    with pytest.raises(TopolocError):
        replace(CONFIG, **change)  # type: ignore[arg-type]
