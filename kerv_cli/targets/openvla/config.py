"""Read the configuration and the action statistics of a Hugging Face OpenVLA checkpoint.

The `config.json` of a published checkpoint gives timm's names of the two vision encoders (towers), but not their
shapes. For the language model it gives only the fields that differ from Llama-2 7B. This module fills in the rest. A
checkpoint of a different size must give the shapes of its towers in the field `vision_shapes`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.files import read_json, read_mapping
from kerv_cli.base.manifests import read

if TYPE_CHECKING:
    from kerv_cli.base.spaces import ActionSpace

SHAPES = "vision_shapes"  # shape of each vision tower; published checkpoints lack it
CONFIG, STATISTICS = "config.json", "dataset_statistics.json"
DOFS = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
GRIP = (0.0, 1.0)  # values of the gripper's DoF that close and open it, as in `EnvironmentSpec.grip`


@dataclass(frozen=True)
class Tower:
    """Shape of a vision tower, one of OpenVLA's two vision transformers.

    Attributes:
        depth: Number of blocks. The output of the last block is never used.
        registers: Number of learned tokens after the class token.
        scaled: Whether the tower is a DINOv2. Then its blocks have layer scales, and its first token is a class token.
        image: Pixels per side of the image.
        patch: Pixels per side of a patch.
    """

    width: int
    depth: int
    heads: int
    feed_forward: int
    registers: int = 0
    scaled: bool = False
    image: int = 224
    patch: int = 14

    @property
    def patches(self) -> int:
        return (self.image // self.patch) ** 2

    @property
    def prefix(self) -> int:
        return self.registers + self.scaled


# by timm's name: DINOv2 ViT-L/14 with registers, and SigLIP So400m/14
TOWERS = {
    "vit_large_patch14_reg4_dinov2.lvd142m": Tower(1024, 24, 16, 4096, registers=4, scaled=True),
    "vit_so400m_patch14_siglip_224": Tower(1152, 27, 16, 4304),
}


@dataclass(frozen=True)
class Language:
    """Shape of the language model. Names are from transformers' LlamaConfig, defaults from Llama-2 7B."""

    vocab_size: int = 32064
    hidden_size: int = 4096
    intermediate_size: int = 11008
    num_hidden_layers: int = 32
    num_attention_heads: int = 32
    rms_norm_eps: float = 1e-6


@dataclass(frozen=True)
class Shape:
    """Shapes of all parts of an OpenVLA checkpoint.

    Attributes:
        towers: Shapes of the two vision towers, in the order of the input channels.
        padding: Number of unused rows at the end of the vocabulary.
        bins: Number of edges of the action bins.
    """

    towers: tuple[Tower, Tower]
    language: Language = field(default_factory=Language)
    padding: int = 64
    bins: int = 256

    @property
    def vocabulary(self) -> int:
        """Number of the tokenizer's ids. The last `bins` ids are the action tokens, in descending order."""
        return self.language.vocab_size - self.padding

    @property
    def patches(self) -> int:
        return self.towers[0].patches


def read_shape(folder: Path) -> Shape:
    path, value = folder / CONFIG, read_config(folder)
    text = value.get("text_config")
    if not isinstance(text, Mapping) or text.get("model_type", "llama") != "llama":
        raise CheckpointError(f"{path} has no text_config of a Llama: it cannot be loaded")
    for name in ("rope_scaling", "rope_theta", "num_key_value_heads"):
        if text.get(name) not in (None, 10_000, text.get("num_attention_heads")):
            raise CheckpointError(f"{path} has a text_config with {name}={text[name]}: it is not of a Llama-2 7B")
    towers = value.get(SHAPES)
    if towers is None:
        names = value.get("timm_model_ids")
        if not isinstance(names, list) or len(names) != 2 or not all(name in TOWERS for name in names):
            raise CheckpointError(f"{path} has timm_model_ids {names}, two of {', '.join(TOWERS)} are wanted")
        towers = [asdict(TOWERS[name]) for name in names]
    numbers = {"padding": value.get("pad_to_multiple_of", 64), "bins": value.get("n_action_bins", 256)}
    return read(Shape, {"towers": towers, "language": text, **numbers}, str(path), tolerant=True)


def read_config(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(f"no {CONFIG} in {folder}: name the folder of a Hugging Face OpenVLA checkpoint")
    value = read_mapping(path)
    kind = value.get("model_type")
    if kind != "openvla":
        raise CheckpointError(f"{path} is of a model of type {kind}, not openvla")
    return value


@dataclass(frozen=True)
class Bounds:
    """Action statistics of a data set, one number per DoF.

    Attributes:
        q01: 1st percentile of the actions.
        q99: 99th percentile of the actions.
        mask: Whether each DoF is normalised with the percentiles. A gripper, for example, is not. None if all are.
    """

    q01: tuple[float, ...]
    q99: tuple[float, ...]
    mask: tuple[bool, ...] | None = None


def read_statistics(folder: Path, name: str | None) -> tuple[str, Bounds]:
    """Return the name and the action statistics of a data set.

    If `name` is None, the checkpoint must have the statistics of a single data set. A fine-tuned checkpoint stores its
    statistics in `dataset_statistics.json`, any other in the field `norm_stats` of `config.json`.
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
    action = statistics[name].get("action") if isinstance(statistics[name], dict) else None
    return name, read(Bounds, action, f"statistics {name} in {folder}", tolerant=True)


def action_space(shape: Shape, bounds: Bounds, like: ActionSpace | None, control_hz: float) -> ActionSpace:
    """Return the action space of a checkpoint.

    Args:
        bounds: The percentiles become `low` and `high` of the space. A DoF that `bounds.mask` excludes gets -1 and 1.
        like: Action space of an environment, from which names, groups, strict DoFs and control rate are copied. If
            None, the space has OpenVLA's seven DoFs and the rate `control_hz`.
    """
    from kerv_cli.base.spaces import ActionSpace, Group

    groups = (Group("position", 3), Group("rotation", 3), Group("gripper", 1))
    space = like or ActionSpace(DOFS, groups, DOFS[-1:], control_hz, (-1.0,) * 7, (1.0,) * 7)
    mask = bounds.mask or (True,) * len(bounds.q01)
    if not len(bounds.q01) == len(bounds.q99) == len(mask) == space.dofs:
        raise CheckpointError(
            f"the statistics are of {len(bounds.q01)} DoFs, the action space has {space.dofs} "
            f"({', '.join(space.names)}): they are of another robot"
        )
    low, high = [-1.0] * space.dofs, [1.0] * space.dofs
    for dof, (name, normalised) in enumerate(zip(space.names, mask, strict=True)):
        if normalised:
            low[dof], high[dof] = bounds.q01[dof], bounds.q99[dof]
        if not low[dof] < high[dof]:
            raise CheckpointError(f"the statistics have q01 = q99 of {name}: they are damaged")
    return replace(space, low=tuple(low), high=tuple(high), bins=shape.bins, end_token=True)
