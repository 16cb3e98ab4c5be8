"""Check that topics are guessed from the names that drivers use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from topoloc.apps.formats.bags.bag import Bag, Topic
from topoloc.apps.formats.bags.topics import Roles, is_rectified, parse_topics, select_topics
from topoloc.errors import RecordingError

IMAGE, COMPRESSED, INFO = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
)
ODOMETRY, POSE, TF = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
)


def bag(**kinds: list[str]) -> Bag:
    types = {
        "image": IMAGE,
        "compressed": COMPRESSED,
        "info": INFO,
        "odometry": ODOMETRY,
        "pose": POSE,
        "tf": TF,
        "imu": "sensor_msgs/msg/Imu",
    }
    made = Bag(Path("walk"), [])
    made.topics.update(
        {name: Topic(name, types[kind], "cdr") for kind, names in kinds.items() for name in names}
    )
    return made


def roles_of(its: Bag) -> dict[str, Any]:
    roles = select_topics(its, {})
    return {name: value for name, value in vars(roles).items() if value}


ZED = "/zed/zed_node"
CASES = {
    "ZED": (
        bag(
            image=[
                f"{ZED}/{name}"
                for name in (
                    "left_raw/image_raw_color",
                    "left/image_rect_color",
                    "right/image_rect_color",
                )
            ]
            + [
                f"{ZED}/depth/depth_registered",
                f"{ZED}/disparity/disparity_image",
                f"{ZED}/confidence/confidence_map",
            ],
            info=[f"{ZED}/{name}/camera_info" for name in ("left", "right", "depth", "left_raw")],
            odometry=[f"{ZED}/odom"],
            tf=["/tf", "/tf_static"],
        ),
        {
            "left": f"{ZED}/left/image_rect_color",
            "right": f"{ZED}/right/image_rect_color",
            "poses": ("tf", f"{ZED}/odom"),
        }
        | {"left_info": f"{ZED}/left/camera_info", "right_info": f"{ZED}/right/camera_info"},
    ),
    "RealSense": (
        bag(
            image=[
                "/camera/color/image_raw",
                "/camera/aligned_depth_to_color/image_raw",
                "/camera/depth/image_rect_raw",
            ],
            info=[
                f"/camera/{name}/camera_info"
                for name in ("color", "aligned_depth_to_color", "depth")
            ],
            tf=["/tf_static"],
            imu=["/camera/imu"],
        ),
        {"left": "/camera/color/image_raw", "depth": "/camera/aligned_depth_to_color/image_raw"}
        | {
            "left_info": "/camera/color/camera_info",
            "depth_info": "/camera/aligned_depth_to_color/camera_info",
        },
    ),
    "librealsense": (
        bag(
            image=[
                f"/device_0/sensor_{sensor}/image/data" for sensor in ("0/Depth_0", "1/Color_0")
            ],
            info=[
                f"/device_0/sensor_{sensor}/info/camera_info"
                for sensor in ("0/Depth_0", "1/Color_0")
            ],
        ),
        {
            "left": "/device_0/sensor_1/Color_0/image/data",
            "depth": "/device_0/sensor_0/Depth_0/image/data",
        }
        | {
            "left_info": "/device_0/sensor_1/Color_0/info/camera_info",
            "depth_info": "/device_0/sensor_0/Depth_0/info/camera_info",
        },
    ),
    "EuRoC": (
        bag(image=["/cam0/image_raw", "/cam1/image_raw"], imu=["/imu0"], pose=["/vicon/pose"]),
        {"left": "/cam0/image_raw", "right": "/cam1/image_raw", "poses": ("/vicon/pose",)},
    ),
    "compressed alone": (
        bag(
            compressed=["/oak/left/image_rect/compressed", "/oak/right/image_rect/compressed"],
            info=["/oak/left/camera_info"],
        ),
        {
            "left": "/oak/left/image_rect/compressed",
            "right": "/oak/right/image_rect/compressed",
            "left_info": "/oak/left/camera_info",
        },
    ),
    "one camera, truth and odometry": (
        bag(image=["/image_raw"], info=["/camera_info"], odometry=["/odom", "/ground_truth/odom"]),
        {
            "left": "/image_raw",
            "left_info": "/camera_info",
            "poses": ("/ground_truth/odom", "/odom"),
        },
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_topics_of_common_drivers(name: str):
    its, expected = CASES[name]
    assert roles_of(its) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("/left/image_rect", True),
        ("/a/rectified", True),
        ("/direct/image_raw", False),
        ("/a/image", False),
    ],
)
def test_rectified_by_name(name: str, expected: bool):
    assert is_rectified(name) == expected


def test_several_cameras_are_reported():
    its = bag(image=["/front/image_raw", "/rear/image_raw"], info=["/rear/camera_info"])
    assert select_topics(its, {}).left == "/rear/image_raw"
    assert (
        "of several topics of pictures /rear/image_raw is taken, not /front/image_raw"
        in its.notes[0]
    )


def test_given_topics_are_used():
    its = bag(
        image=["/cam0/image_raw", "/cam1/image_raw", "/depth"], info=["/k"], odometry=["/odom"]
    )
    said = {
        "left": "/cam0/image_raw",
        "depth": "/depth",
        "left_info": "/k",
        "pose": "/odom",
        "pose_frame": "imu",
    }
    assert select_topics(its, said) == Roles(
        "/cam0/image_raw", None, "/depth", "/k", None, None, ("/odom",), "imu", True
    )
    with pytest.raises(
        RecordingError, match="/odom is nav_msgs/msg/Odometry, which cannot be left_info"
    ):
        select_topics(its, said | {"left_info": "/odom"})
    with pytest.raises(RecordingError, match="left must be, too"):
        select_topics(its, {"right": "/cam1/image_raw"})


@pytest.mark.parametrize("text", ["left", "left=", "=/a", "left=/a,,", "lft=/a"])
def test_wrong_topics_are_refused(text: str):
    with pytest.raises(RecordingError, match="topics"):
        parse_topics(text)
    assert parse_topics("image=/a, info = /b") == {"left": "/a", "left_info": "/b"}
