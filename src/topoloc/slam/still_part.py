"""Find a part of the images that moves with the camera, such as the robot's own body. SLAM takes it
for the world, and a map of it shows every place alike."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc.recordings.frame import StereoSequence, to_grey

_COLUMNS, _ROWS, _CELL_PX = 16, 12, 20  # of the reduced images that are compared


def find_still_part(sequence: StereoSequence) -> str | None:
    """Return a note if a textured part of the images stays the same while the others change. Raises
    as the recording."""
    # The change of a cell from image to image, relative to its texture: 0.2 to 1.3 in right
    # recordings, 0.0 to 0.1 on a body. At least 4 % of the cells, and other cells that change.
    num_images, min_images, max_change, min_texture = 16, 6, 0.15, 6.0
    min_share, min_others = 0.04, 0.35
    rows = np.unique(np.linspace(0, len(sequence) - 1, num_images).astype(int)).tolist()
    size = _COLUMNS * _CELL_PX, _ROWS * _CELL_PX
    images = [
        cv2.resize(to_grey(sequence[k].image), size, interpolation=cv2.INTER_AREA) for k in rows
    ]
    if len(images) < min_images:
        return None
    cells = np.array(images, np.float32).reshape(len(images), _ROWS, _CELL_PX, _COLUMNS, _CELL_PX)
    texture = cells.std(axis=(2, 4)).mean(axis=0)
    change = np.median(np.abs(np.diff(cells, axis=0)).mean(axis=(2, 4)), axis=0)
    is_textured = texture > min_texture
    is_still = is_textured & (change < max_change * texture)
    others = (change / np.maximum(texture, 1.0))[is_textured & ~is_still]
    if is_still.mean() < min_share or len(others) == 0 or np.median(others) < min_others:
        return None
    height, width = sequence[0].image.shape[:2]
    (top, left), (bottom, right) = (
        np.argwhere(is_still).min(axis=0),
        np.argwhere(is_still).max(axis=0),
    )
    columns = f"{left * width // _COLUMNS} to {(right + 1) * width // _COLUMNS - 1}"
    lines = f"{top * height // _ROWS} to {(bottom + 1) * height // _ROWS - 1}"
    return (
        f"{sequence.name}: a part of the picture (columns {columns}, rows {lines}) moves with the"
        " camera, such as the robot's own body, and spoils motion and map; give a picture that is"
        " black there and white elsewhere: --mask FILE, here and with queries"
    )
