import cv2
import numpy as np

from topoloc.features.sift import extract_sift


def picture(seed: int = 0) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (24, 32), dtype=np.uint8)
    return cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)


def test_descriptors_have_unit_length_and_the_strongest_come_first():
    features = extract_sift(picture())
    assert len(features) > 100
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-4)
    assert np.all(np.diff(features.responses) <= 0)
    assert features.descriptors.shape[1] == 128


def test_no_more_features_than_requested():
    assert len(extract_sift(picture(), 50)) == 50


def test_key_points_follow_a_turned_picture():
    image = picture()
    turned = np.ascontiguousarray(np.rot90(image, -1))  # clockwise: (x, y) goes to (h - 1 - y, x)
    before, after = (extract_sift(i, 100) for i in (image, turned))
    expected = np.stack(
        [image.shape[0] - 1 - before.points_img[:, 1], before.points_img[:, 0]], axis=1
    )
    distances = np.linalg.norm(expected[:, None] - after.points_img[None], axis=2)
    found = distances.min(1) < 1.0
    assert found.mean() > 0.8
    turns = after.angles[distances.argmin(1)[found]] - before.angles[found]
    assert np.median(np.abs(np.angle(np.exp(1j * (turns - np.pi / 2))))) < 0.1


def test_plain_picture_has_no_features():
    features = extract_sift(np.full((100, 120), 90, np.uint8))
    assert len(features) == 0
    assert features.descriptors.shape == (0, 128)
