"""Prepare the inputs of OpenVLA: images for its two vision towers, and instructions as token ids.

An image is resized to the size of the towers without keeping its proportions (`resize-naive`, bicubic). Then it is
scaled to [0, 1] and normalised for each tower. For a checkpoint that was fine-tuned on augmented images, the image is
first cropped to the central 90 % of its area (`crop`), with bilinear interpolation. Each side is then √0.9 times as
long.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import read_mapping
from kerv_cli.base.manifests import read
from kerv_cli.targets.openvla.config import Shape

PREPROCESSOR = "preprocessor_config.json"
CROPPED_AREA = 0.9
RESIZE = "resize-naive"


@dataclass(frozen=True)
class Normalisation:
    """Mean and standard deviation of the three colour channels, for pixels in [0, 1]."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


# published: ImageNet's (rounded to bfloat16) for DINOv2, and SigLIP's
DEFAULTS = (
    Normalisation((0.484375, 0.455078125, 0.40625), (0.228515625, 0.2236328125, 0.224609375)),
    Normalisation((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
)


@dataclass(frozen=True)
class _Preprocessor:
    tvf_normalize_params: tuple[Normalisation, Normalisation] = DEFAULTS
    image_resize_strategy: str = RESIZE


def read_normalisations(folder: Path) -> tuple[Normalisation, Normalisation]:
    path = folder / PREPROCESSOR
    found = read(_Preprocessor, read_mapping(path) if path.is_file() else {}, str(path), tolerant=True)
    if found.image_resize_strategy != RESIZE:
        raise CheckpointError(f"{path} has image_resize_strategy={found.image_resize_strategy}; OpenVLA's is {RESIZE}")
    return found.tvf_normalize_params


def cropped(image: np.ndarray, size: int) -> np.ndarray:
    """Crop an image (h, w, 3) uint8 to the central 90 % of its area, and resize it to (size, size, 3) uint8.

    This equals TensorFlow's crop_and_resize: interpolation is bilinear, and the outermost pixels are on the crop's
    edges.
    """
    axis = math.sqrt(CROPPED_AREA) * torch.linspace(-1, 1, size)  # -1 and 1 are the centres of the outermost pixels
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)[None]
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None] / 255
    found = F.grid_sample(pixels, grid, align_corners=True)[0].permute(1, 2, 0)
    return (found * 255.5).clamp(0, 255).to(torch.uint8).numpy()


def as_in_libero(image: np.ndarray, size: int) -> np.ndarray:
    """Prepare an image (h, w, 3) uint8 as OpenVLA's evaluation on LIBERO does before it crops.

    Return (size, size, 3). This equals `resize_image` in OpenVLA's libero_utils: JPEG with TensorFlow's settings, as
    the training images were, then Lanczos with antialiasing.
    """
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    pixels = np.asarray(Image.open(file), dtype=np.float32)
    # each channel as floats: with integers Pillow would clip values between its two passes
    channels: Any = (Image.fromarray(pixels[:, :, i]).resize((size, size), Image.Resampling.LANCZOS) for i in range(3))
    return np.stack(list(channels), -1).round().clip(0, 255).astype(np.uint8)


def pixels_of(
    image: np.ndarray, shape: Shape, normalisations: Sequence[Normalisation], crop: bool, libero: bool = False
) -> Tensor:
    """Prepare an image (h, w, 3) uint8 for both vision towers.

    Args:
        crop: Whether to crop the image to the central 90 % of its area.
        libero: Whether to apply `as_in_libero` first.

    Returns:
        (1, 6, s, s) float32, s pixels per side: three channels normalised for the first tower, then three for the
            second.
    """
    parts = []
    for tower, normal in zip(shape.towers, normalisations, strict=True):
        view, sides = image, (tower.image, tower.image)
        if libero:
            view = as_in_libero(view, tower.image)
        if crop:
            view = cropped(view, tower.image)
        if view.shape[:2] != sides:
            view = np.asarray(Image.fromarray(view).resize(sides, Image.Resampling.BICUBIC))
        pixels = torch.from_numpy(np.array(view, dtype=np.float32)) / 255
        mean, std = torch.tensor(normal.mean), torch.tensor(normal.std)
        parts.append(((pixels - mean) / std).permute(2, 0, 1))
    return torch.cat(parts)[None]


TOKENIZER = "tokenizer.json"
BEGIN, BOUNDARY = "<s>", "\u2581"
PROMPT = "In: What action should the robot take to {}?\nOut:"  # the instruction replaces `{}`


class Prompter:
    """Turns instructions into the token ids of a checkpoint's prompt, at most `limit`."""

    def __init__(self, folder: Path, shape: Shape, limit: int) -> None:
        path = folder / TOKENIZER
        if not path.is_file():
            raise CheckpointError(f"no {TOKENIZER} in {folder}: copy the one that was published with the checkpoint")
        try:
            from tokenizers import Tokenizer
        except ImportError as error:
            raise KervError("OpenVLA checkpoints need the package tokenizers: pip install 'kerv[openvla]'") from error
        try:
            self.tokenizer = Tokenizer.from_file(str(path))
        except Exception as error:
            raise CheckpointError(f"{path} cannot be read ({str(error)[:120]}): copy it again") from error
        self.limit, size = limit, self.tokenizer.get_vocab_size(with_added_tokens=False)
        self.begin, self.boundary = map(self.tokenizer.token_to_id, (BEGIN, BOUNDARY))
        if size != shape.vocabulary or None in (self.begin, self.boundary):
            raise CheckpointError(
                f"{path} has {size} ids, the weights are for {shape.vocabulary} of a Llama: it is another model's"
            )

    def ids(self, instruction: str) -> list[int]:
        ids: list[Any] = self.tokenizer.encode(PROMPT.format(instruction.lower())).ids
        if ids[:1] != [self.begin]:
            ids = [self.begin, *ids]
        if ids[-1] != self.boundary:
            ids = [*ids, self.boundary]
        if len(ids) > self.limit:
            raise UsageError(
                f"instruction '{instruction[:60]}' makes a prompt of {len(ids)} tokens, at most {self.limit} are "
                "taken: shorten it, or import the checkpoint with more prompt_tokens"
            )
        return ids
