"""Define hypothesis strategies for the tests of geometry."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

coordinates = st.floats(-50.0, 50.0)
vectors = arrays(np.float64, 3, elements=coordinates)
directions = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(
    lambda v: np.linalg.norm(v) > 0.1
)
# Any angle. Angles near zero and pi are frequent, because logarithms are inexact there.
angles = st.one_of(
    st.floats(0.0, np.pi - 1e-9),
    st.floats(0.0, 1e-6),
    st.floats(1e-6, 1e-4),
    st.floats(np.pi - 1e-6, np.pi - 1e-9),
)
rotation_vectors = st.builds(lambda d, angle: d / np.linalg.norm(d) * angle, directions, angles)
tangents = st.builds(lambda rho, omega: np.concatenate([rho, omega]), vectors, rotation_vectors)
rigids = tangents.map(Rigid3.exp)

CAMERAS = {
    "SIMPLE_PINHOLE": Camera("SIMPLE_PINHOLE", 640, 480, (525.0, 319.5, 239.5)),
    "PINHOLE": Camera("PINHOLE", 1241, 376, (718.856, 717.0, 607.1928, 185.2157)),
    "SIMPLE_RADIAL": Camera("SIMPLE_RADIAL", 640, 480, (500.0, 322.0, 238.0, -0.12)),
    "RADIAL": Camera("RADIAL", 640, 480, (500.0, 322.0, 238.0, -0.2, 0.06)),
    # EuRoC's left camera.
    "OPENCV": Camera(
        "OPENCV",
        752,
        480,
        (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    ),
    "OPENCV_FISHEYE": Camera(
        "OPENCV_FISHEYE", 640, 480, (350.0, 351.0, 322.0, 238.0, 0.01, -0.02, 0.005, -0.001)
    ),
    "SIMPLE_FISHEYE": Camera("SIMPLE_FISHEYE", 640, 480, (350.0, 322.0, 238.0)),
    "FISHEYE": Camera("FISHEYE", 640, 480, (350.0, 351.0, 322.0, 238.0)),
    "SIMPLE_RADIAL_FISHEYE": Camera("SIMPLE_RADIAL_FISHEYE", 640, 480, (350.0, 322.0, 238.0, 0.03)),
    "RADIAL_FISHEYE": Camera("RADIAL_FISHEYE", 640, 480, (350.0, 322.0, 238.0, 0.03, -0.01)),
    "FULL_OPENCV": Camera(
        "FULL_OPENCV",
        640,
        480,
        (600.0, 601.0, 320.0, 245.0, 0.4, -0.3, 1e-3, -5e-4, 0.05, 0.35, -0.25, 0.04),
    ),
}

# TUM-VI's left camera: its circle of 195 degrees fills the image, the corners see nothing.
FISHEYE_195_DEG = Camera(
    "OPENCV_FISHEYE",
    512,
    512,
    (190.978, 190.973, 254.932, 256.897, 0.00348, 0.000715, -0.00205, 0.000203),
)


def random_rigid(rng: np.random.Generator, spread: float = 2.0) -> Rigid3:
    return Rigid3.exp(np.concatenate([rng.normal(size=3) * spread, rng.normal(size=3)]))
