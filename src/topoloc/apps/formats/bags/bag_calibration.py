"""Find the cameras of a bag: from topics, TF and a camera.json beside it, or as given."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    RecordingError,
    Rigid3,
    StereoRig,
    UnreadableImageError,
)
from topoloc.apps.core_names import replace_cameras
from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.bag_images import camera_info, message_size, reduce_to_part
from topoloc.apps.formats.bags.bag_poses import TransformTree
from topoloc.apps.formats.bags.messages import decode
from topoloc.apps.formats.bags.topics import Roles, is_rectified, is_registered
from topoloc.apps.formats.calibrations.ros_calibration import RosCalibration
from topoloc.plugin import CameraCalibration, read_camera_json


def find_left_camera(
    bag: Bag, roles: Roles, info: RosCalibration | None, given: CameraCalibration | None
) -> Camera | None:
    """Return the given camera, else that of the topic, else that of a camera.json."""
    if given is None and info is not None:
        return info.camera(is_rectified(roles.left))
    found = given or _read_folder_calibration(bag)
    return found and found.camera


def find_rig(
    bag: Bag,
    roles: Roles,
    left: RosCalibration | None,
    tree: TransformTree,
    given: CameraCalibration | None,
) -> StereoRig:
    """Return the given rig. Or return that of the bag, with a given camera for a rectified pair."""
    if given is not None and given.rig is not None:
        return given.rig
    rig = _find_own_rig(bag, roles, left, tree)
    return rig if given is None else replace_cameras(rig, given, str(bag.path))


def _find_own_rig(
    bag: Bag, roles: Roles, left: RosCalibration | None, tree: TransformTree
) -> StereoRig:
    """Return the rig: from P of both calibrations, else from the transform between their frames,
    else from a camera.json of a pair."""
    right = read_camera_info(bag, roles.right_info, roles.right)
    if left is not None and right is not None:
        rig = left.rig(right, is_rectified(roles.left))
        if rig is not None:
            return rig
        right_from_left = None
        if left.frame != right.frame:
            right_from_left = tree.find_static_transform(right.frame, left.frame)
        if right_from_left is not None and is_rectified(roles.left):
            baseline = float(np.linalg.norm(right_from_left.translation))
            return StereoRig.rectified(left.camera(True), baseline)
        if right_from_left is not None:
            return StereoRig(left.camera(False), right.camera(False), right_from_left)
    found = _read_folder_calibration(bag)
    if found is not None and found.rig is not None:
        return found.rig
    infos = {"left": left, "right": right}
    lacking = " and ".join(side for side, info in infos.items() if info is None)
    what = f"neither P of {roles.right_info} nor TF says where the right camera is"
    what = f"no calibration of the {lacking} camera" if lacking else what
    raise CalibrationError(
        f"{bag.path}: {what}; use --camera FILE with both cameras or a baseline, --topics"
        " left_info=TOPIC,right_info=TOPIC, or such a camera.json beside the bag"
    )


def find_depth_camera(
    bag: Bag, depth: str, info_topic: str | None, camera: Camera, frame: str, tree: TransformTree
) -> tuple[Camera, Rigid3]:
    """Return the camera of the depth images, and cam_from_depth. Registered ones have the colour
    camera."""
    info = read_camera_info(bag, info_topic, depth)
    if info is None:
        return camera, Rigid3.identity()
    cam_from_depth = tree.find_static_transform(frame, info.frame) if frame and info.frame else None
    if cam_from_depth is None:
        cam_from_depth = Rigid3.identity()
        if not is_registered(depth):
            bag.notes.append(
                f"{bag.path}: no fixed transform from that of {depth} to the camera of the"
                " pictures: taken for the same place"
            )
    return info.camera(is_rectified(depth)), cam_from_depth


def _read_folder_calibration(bag: Bag) -> CameraCalibration | None:
    path = (bag.path if bag.path.is_dir() else bag.path.parent) / "camera.json"
    return read_camera_json(path) if path.is_file() else None


def read_camera_info(bag: Bag, name: str | None, images: str | None) -> RosCalibration | None:
    """Return the first complete calibration of a topic, for the images of another. Return None if
    there is none, or if it is that of an uncalibrated camera."""
    if name is None or images is None:
        return None
    for ref in bag.messages(name)[:10]:
        with suppress(RecordingError):
            message = decode(bag.topics[name], bag.read(ref))
            break
    else:
        raise CalibrationError(f"{bag.path}: no whole message of {name}")
    found = camera_info(message, name)
    reduced, size = reduce_to_part(found, message), (found.width, found.height)
    # some drivers report binning with the calibration of the binned image
    if (reduced.width, reduced.height) != size != find_image_size(bag, images):
        found = reduced
    return found if found.is_calibrated else None


def find_image_size(bag: Bag, name: str) -> tuple[int, int]:
    """Return width and height of the first whole image of a topic. Return (0, 0) if there is none,
    because reading the images reports the error later."""
    for ref in bag.messages(name)[:10]:
        with suppress(RecordingError, UnreadableImageError):
            return message_size(decode(bag.topics[name], bag.read(ref)), name)
    return 0, 0
