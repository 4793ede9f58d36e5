"""Frames -> the pixels that OpenVLA's two vision towers take, as its own preprocessing makes them.

The whole frame is resized to the towers' size without keeping its proportions (`resize-naive`, bicubic), scaled to
[0, 1] and normalised for each tower. A checkpoint that was fine-tuned with augmented images is shown the central 90 %
of the area (`crop`), resized bilinearly: the sides are cut by the square root of that.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_mapping
from kerv_cli.base.manifests import read
from kerv_cli.targets.openvla.config import Shape

PREPROCESSOR = "preprocessor_config.json"
CROPPED_AREA = 0.9
RESIZE = "resize-naive"


@dataclass(frozen=True)
class Normalisation:
    """Mean and standard deviation of the three channels, in [0, 1]."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


DEFAULTS = (
    Normalisation((0.484375, 0.455078125, 0.40625), (0.228515625, 0.2236328125, 0.224609375)),
    Normalisation((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
)
"""ImageNet's for DINOv2, as published (rounded to bfloat16), and SigLIP's."""


def read_normalisations(folder: Path) -> tuple[Normalisation, Normalisation]:
    """Those of `preprocessor_config.json`, the published ones where the folder has none.

    Raises:
        CheckpointError: the file is damaged, or asks for another way of resizing.
    """
    path = folder / PREPROCESSOR
    if not path.is_file():
        return DEFAULTS
    value = read_mapping(path)
    strategy = value.get("image_resize_strategy", RESIZE)
    if strategy != RESIZE:
        raise CheckpointError(f"{path} asks for image_resize_strategy={strategy}; OpenVLA's is {RESIZE}")
    towers = value.get("tvf_normalize_params")
    if towers is None:
        means, stds = value.get("means"), value.get("stds")
        if means is None or stds is None:
            return DEFAULTS
        towers = [{"mean": mean, "std": std} for mean, std in zip(means, stds, strict=False)]
    if len(towers) != 2:
        raise CheckpointError(f"{path} normalises for {len(towers)} vision towers, OpenVLA has two")
    first, second = (read(Normalisation, one, f"{path}, tvf_normalize_params", tolerant=True) for one in towers)
    return first, second


def check_image(image: np.ndarray, camera: str) -> np.ndarray:
    """The image, if it is (h, w, 3) uint8.

    Raises:
        UsageError: it is not.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape[:2]) < 2:
        raise UsageError(
            f"the image of camera '{camera}' has shape {image.shape} and type {image.dtype}: "
            "height x width x 3 of uint8 are wanted"
        )
    return image


def cropped(image: np.ndarray, size: int) -> np.ndarray:
    """image (h, w, 3) uint8 -> its central CROPPED_AREA, sampled bilinearly at size × size points, the outermost on the
    crop's edges (TensorFlow's crop_and_resize), uint8."""
    side = math.sqrt(CROPPED_AREA)
    rows, columns = ((n - 1) * ((1 - side) / 2 + side * np.linspace(0, 1, size)) for n in image.shape[:2])
    pixels = image.astype(np.float32) / 255
    pixels = _interpolated(_interpolated(pixels, rows).swapaxes(0, 1), columns).swapaxes(0, 1)
    return np.clip(np.floor(np.clip(pixels, 0, 1) * 255.5), 0, 255).astype(np.uint8)


def _interpolated(rows: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """rows (n, …) at fractional `indices` (m,) -> (m, …)."""
    below = np.clip(np.floor(indices).astype(int), 0, len(rows) - 2)
    share = (indices - below).astype(np.float32).reshape(-1, *[1] * (rows.ndim - 1))
    return rows[below] * (1 - share) + rows[below + 1] * share


def resized(image: np.ndarray, size: int) -> np.ndarray:
    """image (h, w, 3) uint8 -> (size, size, 3) uint8, bicubic with antialiasing."""
    if image.shape[:2] == (size, size):
        return image
    return np.asarray(Image.fromarray(image).resize((size, size), Image.Resampling.BICUBIC))


def as_in_libero(image: np.ndarray, size: int) -> np.ndarray:
    """image (h, w, 3) uint8 -> (size, size, 3) uint8 as OpenVLA's evaluation on LIBERO prepares a frame before its crop
    (`resize_image` of its libero_utils): through JPEG as TensorFlow writes it (quality 95, colour at half resolution),
    because the training data were, then Lanczos with antialiasing."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    pixels = np.asarray(Image.open(file), dtype=np.float32)
    # channel by channel as floats: Pillow would cut off the overshoot of whole numbers between its two passes
    channels = (Image.fromarray(pixels[:, :, i]).resize((size, size), Image.Resampling.LANCZOS) for i in range(3))
    return np.stack([np.asarray(one) for one in channels], -1).round().clip(0, 255).astype(np.uint8)


def pixels_of(
    image: np.ndarray, shape: Shape, normalisations: Sequence[Normalisation], crop: bool, libero: bool = False
) -> Tensor:
    """image (h, w, 3) uint8 -> (1, 6, s, s) float32: normalised for the first tower, then for the second. crop: show
    the central part. libero: as `as_in_libero`, before that."""
    parts = []
    for tower, normal in zip(shape.towers, normalisations, strict=True):
        view = as_in_libero(image, tower.image) if libero else image
        view = cropped(view, tower.image) if crop else view
        pixels = torch.from_numpy(np.array(resized(view, tower.image), dtype=np.float32)) / 255
        mean, std = torch.tensor(normal.mean), torch.tensor(normal.std)
        parts.append(((pixels - mean) / std).permute(2, 0, 1))
    return torch.cat(parts)[None]
