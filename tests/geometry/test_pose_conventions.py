"""Check that each convention undoes the change that it names."""

import numpy as np
import pytest

from topoloc.errors import TrajectoryError
from topoloc.geometry.pose_conventions import (
    AXES,
    CONVENTION_DESCRIPTIONS,
    ROTATIONS,
    UNITS,
    PoseConventions,
    describe_conventions,
)
from topoloc.geometry.rigid import Rigid3, exp_so3

POSE = Rigid3(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([1.0, 2.0, -3.0]))
BODY_FROM_CAM = Rigid3(exp_so3(np.array([-1.2, 0.1, 0.3])), np.array([0.3, -0.1, 0.05]))


def assert_same(a: Rigid3, b: Rigid3) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-9)


def with_axes(pose: Rigid3, right: list[float], down: list[float], forward: list[float]) -> Rigid3:
    """Return the pose of a body whose axes point to these directions of the camera."""
    return Rigid3(pose.rotation @ np.column_stack([right, down, forward]).T, pose.translation)


def test_camera_axes_are_turned():
    assert_same(
        PoseConventions(("opengl",)).undo_conventions(
            with_axes(POSE, [1, 0, 0], [0, -1, 0], [0, 0, -1])
        ),
        POSE,
    )
    assert_same(
        PoseConventions(("flu",)).undo_conventions(
            with_axes(POSE, [0, -1, 0], [0, 0, -1], [1, 0, 0])
        ),
        POSE,
    )
    assert_same(
        PoseConventions(("frd",)).undo_conventions(
            with_axes(POSE, [0, 1, 0], [0, 0, 1], [1, 0, 0])
        ),
        POSE,
    )


def test_left_handed_worlds_are_mirrored():
    mirror = np.diag([1.0, -1.0, 1.0])

    def mirrored(pose: Rigid3) -> Rigid3:
        return Rigid3(mirror @ pose.rotation @ mirror, mirror @ pose.translation)

    assert_same(PoseConventions(("unity",)).undo_conventions(mirrored(POSE)), POSE)
    body = mirrored(with_axes(POSE, [0, -1, 0], [0, 0, -1], [1, 0, 0]))
    assert_same(
        PoseConventions(
            (
                "unreal",
                "cm",
            )
        ).undo_conventions(Rigid3(body.rotation, 100.0 * body.translation)),
        POSE,
    )


def test_a_quaternion_read_in_the_wrong_order():
    w, x, y, z = POSE.quat_wxyz()
    as_read = Rigid3.from_quat_wxyz(
        np.array([z, w, x, y]), POSE.translation
    )  # "w x y z" taken for x, y, z, w
    assert_same(PoseConventions(("wxyz",)).undo_conventions(as_read), POSE)


def test_units_bodies_and_combinations():
    assert_same(
        PoseConventions(("mm",)).undo_conventions(Rigid3(POSE.rotation, 1000.0 * POSE.translation)),
        POSE,
    )
    assert_same(
        PoseConventions(("scale=0.42",)).undo_conventions(
            Rigid3(POSE.rotation, POSE.translation / 0.42)
        ),
        POSE,
    )
    w, x, y, z = BODY_FROM_CAM.quat_wxyz()
    text = "inverse,body=" + ",".join(
        str(number) for number in (*BODY_FROM_CAM.translation, x, y, z, w)
    )
    assert_same(
        PoseConventions.parse(text).undo_conventions((POSE @ BODY_FROM_CAM.inverse()).inverse()),
        POSE,
    )


def test_the_option_is_parsed():
    assert PoseConventions.parse("wxyz, shift=-0.25,clock=1e6") == PoseConventions(
        ("wxyz",), 1e6, -0.25
    )
    assert PoseConventions.parse(None) == PoseConventions.parse("") == PoseConventions()
    assert set(ROTATIONS) | set(UNITS) | set(AXES) <= set(CONVENTION_DESCRIPTIONS)
    assert "millimetres" in describe_conventions(["opengl", "mm"])


@pytest.mark.parametrize(
    "text",
    [
        "upside",
        "scale",
        "scale=0",
        "scale=a",
        "mm=3",
        "body=1,2",
        "shift=nan",
        "clock=-1",
        "body=0,0,0,0,0,0,0",
    ],
)
def test_invalid_options_are_refused(text: str):
    with pytest.raises(TrajectoryError):
        PoseConventions.parse(text)
