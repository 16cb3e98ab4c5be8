"""The same walls seen from both ends: a rendered way out and the way back, as views to the sides
show them (`topoloc.features.extraction`).

Depth comes from the stereo pairs of the way out, poses from the truth. Views are kept as pictures
of the size that the teacher sees: an upper and a lower band of each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from topoloc.errors import RecordingError
from topoloc.features.extraction import VirtualView, make_virtual_views
from topoloc.geometry.camera import Camera
from topoloc.recordings.frame import StereoFrame, StereoSequence, to_grey
from topoloc_training.net.pairs import Pair, located_pixels, seen_by
from topoloc_training.net.teacher import HEIGHT, WIDTH

_OPPOSITE = -0.9  # cosine of the angle between the two ways
_REACH = 15.0  # metres between the two cameras
_TRIED, _KEPT, _FEWEST = 24, 3, 250


@dataclass(frozen=True, eq=False)
class _Shown:
    """A band of a side view, kept as the picture `path`; `first` are the column and row of the view
    at which it begins."""

    view: VirtualView
    band: int
    path: str
    first: tuple[int, int]

    def pixels(self, points_side: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return pixels in the band of points in the side camera's frame, NaN for points that are
        not visible."""
        pixels = np.full((len(points_side), 2), np.nan)
        front = points_side[:, 2] > 0.05
        pixels[front] = self.view.camera.img_from_cam(points_side[front])
        columns, rows = np.nan_to_num(np.rint(pixels), nan=-1.0).astype(int).T
        inside = (
            (columns >= 0)
            & (rows >= 0)
            & (columns < self.view.camera.width)
            & (rows < self.view.camera.height)
        )
        inside[inside] = self.view.inside[rows[inside], columns[inside]]
        pixels -= self.first
        inside &= (pixels >= 2).all(axis=1) & (pixels <= [WIDTH - 3, HEIGHT - 3]).all(axis=1)
        pixels[~inside] = np.nan
        return pixels


def find_side_pairs(outs: StereoSequence, backs: StereoSequence, pictures: Path) -> list[Pair]:
    """Pairs of side views that show the same wall, of each band of the way back's up to three; the
    views are kept in `pictures`.

    Raises:
        RecordingError: a frame has no pose, no calibration or, of the way out, no right picture.
    """
    pairs, poses = list[Pair](), [pose for pose in outs.poses if pose is not None]
    if len(poses) < len(outs):
        raise RecordingError(f"{outs.name}: every frame needs a pose")
    centres, axes = (
        np.array([pose.translation for pose in poses]),
        np.array([pose.rotation[:, 2] for pose in poses]),
    )
    clouds: dict[int, tuple[Float[np.ndarray, "n 3"], list[_Shown]]] = {}
    for j in range(len(backs)):
        back = backs[j]
        if back.world_from_cam is None or back.camera is None:
            raise RecordingError(f"{backs.name}: {back.name} needs a pose and a calibration")
        from_back = centres - back.world_from_cam.translation
        ahead = from_back @ back.world_from_cam.rotation[:, 2]
        faces = (
            (axes @ back.world_from_cam.rotation[:, 2] < _OPPOSITE)
            & (ahead > 0.5)
            & (np.linalg.norm(from_back, axis=1) < _REACH)
        )
        rows = np.flatnonzero(faces)
        rows = (
            rows[np.unique(np.linspace(0, len(rows) - 1, _TRIED).astype(int))]
            if len(rows)
            else rows
        )
        shown, found = _kept_views(back, backs.name, pictures), list[Pair]()
        for i in map(int, rows):
            if i not in clouds:
                frame = outs[i]
                clouds[i] = located_pixels(frame)[1], _kept_views(frame, outs.name, pictures)
            points, of_out = clouds[i]
            found += _pairs_of(
                points,
                of_out,
                shown,
                (back.world_from_cam.inverse() @ poses[i]).matrix(),
                back.camera,
            )
        found.sort(key=lambda pair: -len(pair.day_px))
        for path in {one.path for one in shown}:
            pairs += [pair for pair in found if pair.other == path][:_KEPT]
    return pairs


def _pairs_of(
    points: Float[np.ndarray, "n 3"],
    of_out: list[_Shown],
    of_back: list[_Shown],
    back_from_out: np.ndarray,
    camera: Camera,
) -> list[Pair]:
    rows, _ = seen_by(points, back_from_out, camera)
    points, pairs = points[rows], list[Pair]()
    moved = points @ back_from_out[:3, :3].T + back_from_out[:3, 3]
    for here in of_out:
        for there in of_back:
            if (
                here.view.name == there.view.name or here.band != there.band
            ):  # the other hand, the same band
                continue
            at = [
                one.pixels(one.view.cam_from_virtual.inverse().apply(p))
                for one, p in ((here, points), (there, moved))
            ]
            both = np.isfinite(at[0]).all(axis=1) & np.isfinite(at[1]).all(axis=1)
            if np.count_nonzero(both) >= _FEWEST:
                pairs.append(
                    Pair(
                        here.path,
                        there.path,
                        at[0][both].astype(np.float32),
                        at[1][both].astype(np.float32),
                    )
                )
    return pairs


def _kept_views(frame: StereoFrame, recording: str, pictures: Path) -> list[_Shown]:
    assert frame.camera is not None
    grey, kept = to_grey(frame.image), list[_Shown]()
    for view in make_virtual_views(frame.camera):
        picture = view.picture(grey)
        # the farthest columns are cut off, where there are too many
        column = 0 if view.name == "left" else max(0, picture.shape[1] - WIDTH)
        for band, row in enumerate(sorted({0, max(0, picture.shape[0] - HEIGHT)})):
            path = pictures / f"{recording}-{Path(frame.name).stem}-{view.name}-{band}.png"
            if not path.is_file():
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(_filled(picture[row : row + HEIGHT, column : column + WIDTH])).save(
                    path
                )
            kept.append(_Shown(view, band, str(path), (column, row)))
    return kept


def _filled(picture: UInt8[np.ndarray, "a b"]) -> UInt8[np.ndarray, "c d"]:
    missing = (max(0, HEIGHT - picture.shape[0]), max(0, WIDTH - picture.shape[1]))
    return np.pad(picture, np.array([(0, missing[0]), (0, missing[1])]), mode="edge")
