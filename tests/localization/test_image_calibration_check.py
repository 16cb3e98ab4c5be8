"""Check that a wrong calibration is named and lowers the odds."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.localization import decision
from topoloc.localization.exact.pixel_evidence import weigh_pixels
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


def with_focal(camera: Camera, scale: float) -> Camera:
    return replace(camera, params=(scale * camera.fx, scale * camera.fy, camera.cx, camera.cy))


@pytest.fixture(scope="module")
def localizer(room_map: Path) -> Localizer:
    return Localizer(TopoMetricMap.load(room_map))


def test_right_calibrations_pass(localizer: Localizer, queries: Path):
    for frame in open_sequence(queries):
        result = localizer.localize(frame.image, frame.camera)
        assert not isinstance(result, Localization) or result.calibration_doubt is None


def test_rolling_shutter_is_no_calibration_fault(localizer: Localizer, queries: Path):
    for frame in open_sequence(queries):
        assert frame.camera is not None
        assert frame.world_from_cam is not None
        image, camera = frame.image, frame.camera
        x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        turn = np.deg2rad(1.5) * ((y + 0.5) / camera.height - 0.5)
        u = np.tan(np.arctan((x - camera.cx) / camera.fx) + turn) * camera.fx + camera.cx
        read = cv2.remap(image, u.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        result = localizer.localize(read, camera)
        assert isinstance(result, Localization)
        assert result.calibration_doubt is None
        assert result.frame_rotation_deg == pytest.approx(1.5, abs=0.4)
        assert Localization.from_json(result.to_json("a")).frame_rotation_deg is not None
        error = frame.world_from_cam.inverse() @ result.world_from_cam
        assert np.rad2deg(error.angle()) < 0.5


def test_a_refusal_names_a_focal_length_that_is_far_off(localizer: Localizer, queries: Path):
    details = list[str]()
    for frame in open_sequence(queries):
        assert frame.camera is not None
        result = localizer.localize(frame.image, with_focal(frame.camera, 2.0))
        if isinstance(result, NotLocalized):
            details.append(result.detail)
        else:
            assert result.calibration_doubt is not None
    faults = ("the image asks for a focal length shorter than 520 px", "the picture says f = ")
    assert details
    assert all(any(fault in detail for fault in faults) for detail in details)


def test_pixels_do_not_excuse_a_wrong_focal_length(
    localizer: Localizer, queries: Path, monkeypatch: pytest.MonkeyPatch
):
    def likely_wrong() -> int:
        wrong = 0
        for frame in open_sequence(queries):
            assert frame.camera is not None
            assert frame.world_from_cam is not None
            found = localizer.localize(frame.image, with_focal(frame.camera, 2.0))
            if isinstance(found, Localization):
                error = frame.world_from_cam.inverse() @ found.world_from_cam
                wrong += bool(np.linalg.norm(error.translation) > 0.25 and found.probability > 0.5)
        return wrong

    by_all = likely_wrong()
    without_pixels = tuple(one for one in decision.CHECKS if one is not weigh_pixels)
    monkeypatch.setattr(decision, "CHECKS", without_pixels)
    assert by_all <= likely_wrong()


@pytest.mark.parametrize("scale", [0.93, 1.08])
def test_a_wrong_focal_length_is_named(localizer: Localizer, queries: Path, scale: float):
    num_named = 0
    for frame in open_sequence(queries):
        assert frame.camera is not None
        assert frame.world_from_cam is not None
        result = localizer.localize(frame.image, with_focal(frame.camera, scale))
        if not isinstance(result, Localization):
            num_named += "the picture says f" in result.detail
        elif result.calibration_doubt is not None:
            num_named += 1
            doubt = result.calibration_doubt
            assert "focal_length" in doubt.of
            assert doubt.focal_length_px == pytest.approx(frame.camera.fx, rel=0.02)
            assert result.to_json("a")["calibration_doubt"]["detail"] == str(doubt)
            way = np.linalg.norm(
                result.world_from_cam.translation - frame.world_from_cam.translation
            )
            assert way < 3.0 * np.sqrt(np.trace(result.camera_covariance[:3, :3]))
            assert way < 0.25, "the pose is by the camera that the image shows"
    assert num_named >= 0.8 * len(open_sequence(queries))


def test_distortion_that_the_calibration_leaves_out_is_named(localizer: Localizer, queries: Path):
    num_named, results = 0, list[Localization | NotLocalized]()
    for frame in open_sequence(queries):
        assert frame.camera is not None
        assert frame.world_from_cam is not None
        f, cx, cy = frame.camera.fx, frame.camera.cx, frame.camera.cy
        y, x = np.mgrid[: frame.camera.height, : frame.camera.width]
        u, v = (x - cx) / f, (y - cy) / f
        bent = 1.0 + 0.35 * (u**2 + v**2)
        map_x, map_y = (
            (u * bent * f + cx).astype(np.float32),
            (v * bent * f + cy).astype(np.float32),
        )
        distorted = cv2.remap(frame.image, map_x, map_y, cv2.INTER_LINEAR)
        result = localizer.localize(distorted, frame.camera)
        results.append(result)
        if not isinstance(result, Localization):
            num_named += "its lens distorts" in result.detail
            continue
        error = frame.world_from_cam.inverse() @ result.world_from_cam
        assert np.linalg.norm(error.translation) < 0.25 or result.probability < 0.5
        if result.calibration_doubt is not None:
            num_named += "distortion" in result.calibration_doubt.of
    assert num_named >= 0.8 * len(open_sequence(queries))
    (together,) = check_camera_calibrations(results)
    assert "their lens distorts more than the calibration states" in str(together)
