"""The `config.json` of a Hugging Face OpenVLA folder, and the statistics beside it, as dataclasses.

A published folder says little: its vision towers by their timm names, its language model by what differs from Llama-2
7B. What it leaves out is filled in here. A folder of another size says its towers' shapes itself (`vision_shapes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.files import read_json, read_mapping
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, Group

SHAPES = "vision_shapes"
"""Field of `config.json` that only folders of another size than the published ones have: one `Tower` per image."""
CONFIG, STATISTICS = "config.json", "dataset_statistics.json"
DOFS = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
GROUPS = (Group("position", 3), Group("rotation", 3), Group("gripper", 1))


@dataclass(frozen=True)
class Tower:
    """Shape of a vision transformer. depth: blocks; the last one's output is never used. registers: learned tokens
    behind the class token; scaled: blocks have layer scales, and a class token stands in front (DINOv2); pooled: a
    pooling head follows, whose output is never used (SigLIP). image, patch: pixels."""

    width: int
    depth: int
    heads: int
    feed_forward: int
    registers: int = 0
    scaled: bool = False
    pooled: bool = False
    image: int = 224
    patch: int = 14

    @property
    def patches(self) -> int:
        """Tokens of an image."""
        return (self.image // self.patch) ** 2

    @property
    def prefix(self) -> int:
        """Tokens in front of the patches."""
        return self.registers + self.scaled


TOWERS = {
    "vit_large_patch14_reg4_dinov2.lvd142m": Tower(1024, 24, 16, 4096, registers=4, scaled=True),
    "vit_so400m_patch14_siglip_224": Tower(1152, 27, 16, 4304, pooled=True),
}
"""The towers of OpenVLA by their timm names (DINOv2 ViT-L/14 with registers, SigLIP So400m/14)."""


@dataclass(frozen=True)
class Language:
    """Shape of the language model; the defaults are those of Llama-2 7B as transformers fills them in."""

    vocab_size: int = 32064
    hidden_size: int = 4096
    intermediate_size: int = 11008
    num_hidden_layers: int = 32
    num_attention_heads: int = 32
    num_key_value_heads: int | None = None
    rms_norm_eps: float = 1e-6
    rope_theta: float = 10_000.0

    @property
    def key_value_heads(self) -> int:
        """Heads of keys and values."""
        return self.num_key_value_heads or self.num_attention_heads

    @property
    def channels(self) -> int:
        """Channels of a head."""
        return self.hidden_size // self.num_attention_heads

    def cache_sizes(self, batch: int, capacity: int) -> tuple[int, int, int, int, int]:
        """The sizes of a `Cache` of this model: layers, B, heads of keys and values, slots, channels."""
        return self.num_hidden_layers, batch, self.key_value_heads, capacity, self.channels


@dataclass(frozen=True)
class Shape:
    """Everything that determines the tensors of an OpenVLA checkpoint and how its tokens are read.

    towers: of the first and of the second half of the input channels. padding: rows of the vocabulary behind the
    tokenizer's own. bins: edges of the action bins.
    """

    towers: tuple[Tower, Tower]
    language: Language = field(default_factory=Language)
    padding: int = 64
    bins: int = 256

    @property
    def vocabulary(self) -> int:
        """Ids of the tokenizer; the last `bins` of them are the action tokens, highest first."""
        return self.language.vocab_size - self.padding

    @property
    def vision_width(self) -> int:
        """Channels of a patch, both towers together."""
        return sum(tower.width for tower in self.towers)

    @property
    def patches(self) -> int:
        """Vision tokens of the prompt."""
        return self.towers[0].patches


def read_shape(folder: Path) -> Shape:
    """The shape that `config.json` in `folder` describes.

    Raises:
        CheckpointError: no such file, or not that of an OpenVLA with two vision towers and a Llama.
    """
    path = folder / CONFIG
    value = read_config(folder)
    text = value.get("text_config")
    if not isinstance(text, Mapping) or text.get("model_type", "llama") != "llama":
        raise CheckpointError(f"{path} has no text_config of a Llama: other language models are not supported")
    if text.get("rope_scaling"):
        raise CheckpointError(f"{path} asks for rope_scaling, which OpenVLA does not have: it cannot be loaded")
    language = read(Language, text, f"{path}, text_config", tolerant=True)
    towers = _towers(value, path)
    numbers = {"padding": value.get("pad_to_multiple_of", 64), "bins": value.get("n_action_bins", 256)}
    plain = {"towers": [asdict(t) for t in towers], "language": asdict(language), **numbers}
    return read(Shape, plain, str(path))


def read_config(folder: Path) -> dict[str, Any]:
    """`config.json` of an OpenVLA folder.

    Raises:
        CheckpointError: there is none, or it is another model's.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(f"no {CONFIG} in {folder}: name the folder of a Hugging Face OpenVLA checkpoint")
    value = read_mapping(path)
    kind = value.get("model_type")
    if kind != "openvla":
        raise CheckpointError(f"{path} is of a model of type {kind}, not openvla")
    return value


def _towers(value: Mapping[str, Any], path: Path) -> list[Tower]:
    if SHAPES in value:
        return read(_Shapes, {"towers": value[SHAPES]}, f"{path}, {SHAPES}").towers
    names = value.get("timm_model_ids") or []
    if not isinstance(names, list) or len(names) != 2:
        raise CheckpointError(f"{path} names {len(names)} vision towers, OpenVLA has two: it cannot be loaded")
    unknown = [name for name in names if name not in TOWERS]
    if unknown:
        raise CheckpointError(f"{path} names vision tower {unknown[0]}; known are {', '.join(TOWERS)}")
    return [TOWERS[name] for name in names]


@dataclass(frozen=True)
class _Shapes:
    towers: list[Tower]


@dataclass(frozen=True)
class Statistics:
    """How one data set's actions are normalised: name, and what −1 and 1 of every DoF mean."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]


def read_statistics(folder: Path, name: str | None) -> Statistics:
    """The action statistics called `name`; None for the only ones there are.

    From `dataset_statistics.json`, which a fine-tuned checkpoint has, else from `norm_stats` of `config.json`. A DoF
    that its `mask` leaves out (the gripper) is not normalised: −1 and 1 mean themselves.

    Raises:
        UsageError: several and no name. UnknownName: none of that name. CheckpointError: none, or damaged ones.
    """
    path = folder / STATISTICS
    statistics = read_json(path) if path.is_file() else read_config(folder).get("norm_stats")
    if not isinstance(statistics, dict) or not statistics:
        raise CheckpointError(f"{folder} has neither {STATISTICS} nor norm_stats in {CONFIG}: actions have no units")
    if name is None and len(statistics) > 1:
        raise UsageError(f"{folder} has statistics of {', '.join(sorted(statistics))}: choose with statistics=NAME")
    name = name or next(iter(statistics))
    if name not in statistics:
        raise UnknownName("statistics", name, statistics)
    try:
        low, high, mask = _bounds(statistics[name]["action"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"statistics {name} in {folder} are damaged: {error}") from error
    bounds = [(a, b) if normalised else (-1.0, 1.0) for a, b, normalised in zip(low, high, mask, strict=True)]
    return Statistics(name, tuple(a for a, _ in bounds), tuple(b for _, b in bounds))


def _bounds(action: Mapping[str, Any]) -> tuple[list[float], list[float], list[bool]]:
    low, high = ([float(x) for x in action[key]] for key in ("q01", "q99"))
    mask = [bool(x) for x in action.get("mask", [True] * len(low))]
    if not len(low) == len(high) == len(mask) or not all(map(math.isfinite, (*low, *high))):
        raise ValueError("q01, q99 and mask are not as many finite numbers")
    return low, high, mask


def action_space(shape: Shape, statistics: Statistics, like: ActionSpace | None, control_hz: float) -> ActionSpace:
    """The action space of a checkpoint. like: an environment's, whose names, groups, strict DoFs and control rate it
    takes over; None for OpenVLA's seven DoFs at `control_hz`.

    Raises:
        CheckpointError: the statistics are of another number of DoFs, or of DoFs that do not move.
    """
    space = like or ActionSpace(DOFS, GROUPS, DOFS[-1:], control_hz, (-1.0,) * 7, (1.0,) * 7)
    names = space.names
    if len(statistics.low) != len(names):
        raise CheckpointError(
            f"statistics {statistics.name} are of {len(statistics.low)} DoFs, the action space has {len(names)} "
            f"({', '.join(names)}): they are of another robot"
        )
    still = [n for n, a, b in zip(names, statistics.low, statistics.high, strict=True) if not a < b]
    if still:
        raise CheckpointError(f"statistics {statistics.name} have q01 = q99 of {still[0]}: they are damaged")
    return replace(space, low=statistics.low, high=statistics.high, bins=shape.bins, end_token=True)
