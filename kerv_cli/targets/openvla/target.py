"""A target with the weights of a published OpenVLA checkpoint (arXiv 2406.09246).

The prompt is [begin] [vision patches] [text], as in OpenVLA's own code. Action token t has the id vocabulary - 1 - t.
The head gives logits for the ids of action tokens only. The published code takes the argmax over all ids, and executes
an id that is no action token as the last bin. As long as the published code decodes action tokens, greedy decoding here
gives the same tokens.

Shapes: B prompts, P prompt tokens, T new tokens, n vision tokens, F pooled features, V action tokens, E width, s pixels
per side of an image.
"""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.draft import upload
from kerv_cli.engine.protocol import Seen
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.checkpoint import FORMAT, TargetDescription, target_fields
from kerv_cli.targets.openvla.config import DOFS, GRIP, action_space, read_shape, read_statistics
from kerv_cli.targets.openvla.inputs import Prompter, pixels_of, read_normalisations
from kerv_cli.targets.openvla.loading import check_finite, digest_of, load_model, open_checked, open_shards
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.targets.settings import BuildTargetSettings
from kerv_cli.worlds import EnvironmentPart


@dataclass(frozen=True)
class OpenVLASettings:
    """The field `settings` in the target.json of an OpenVLA target.

    Attributes:
        checkpoint: Folder of the published files.
        statistics: Name of the data set whose action statistics are used.
        files: Size of each file of weights in bytes, by name.
        crop: Whether images are cropped to the central 90 %, for checkpoints fine-tuned on augmented images.
        libero: Whether images are first compressed as JPEG and resized by Lanczos, as OpenVLA does it for LIBERO.
        prompt_tokens: Longest prompt in tokens, without the vision patches.
        image_size: Pixels per side of a tower's image.
    """

    checkpoint: str
    statistics: str
    files: dict[str, int]
    crop: bool = False
    libero: bool = False
    prompt_tokens: int = 64
    image_size: int = 224
    chunk: int = 1


class OpenVLATarget:
    """An OpenVLA policy, which reads the image of one camera. Implements the protocol `ReadableTarget`."""

    def __init__(
        self, settings: OpenVLASettings, description: TargetDescription, device: str, dtype: torch.dtype
    ) -> None:
        source = Path(settings.checkpoint)
        self.settings, self.actions, self.cameras = settings, description.actions, tuple(description.cameras)
        self.observation = description.observation
        self.shape = shape = read_shape(source)
        self.prompter = Prompter(source, shape, settings.prompt_tokens)
        self.normalisations = read_normalisations(source)
        self.model = model = load_model(source, shape, device, dtype)
        self.chunk, self.width = settings.chunk, shape.language.hidden_size
        self.heads, self.feed_forward = shape.language.num_attention_heads, shape.language.intermediate_size
        self.max_prompt, self.pooled_width = shape.patches + settings.prompt_tokens, 2 * self.width
        # instructions differ in length, so the instruction's slice has no end
        begin, vision = slice(0, 1), slice(1, 1 + shape.patches)
        self.segments = {"begin": begin, "vision": vision, "instruction": slice(vision.stop, None)}
        last = shape.vocabulary
        self.action_rows = model.language_model.lm_head.weight[last - shape.bins : last].flip(0).contiguous()
        self.trunk: Any = model.language_model.model
        self.layers = self.trunk.layers
        self.device, self.dtype = self.action_rows.device, self.action_rows.dtype
        self.words = functools.lru_cache(maxsize=64)(self._words)

    def pooled(self, prompt: Tensor) -> Tensor:
        """Pool each prompt (B, P, E) into one vector (B, F): the mean vision token, then the mean text token."""
        return torch.cat([prompt[:, self.segments[name]].mean(1) for name in ("vision", "instruction")], -1)

    def encode(self, observation: Observation) -> Tensor:
        image, settings = observation.images[self.cameras[0]], self.settings
        pixels = pixels_of(image, self.shape, self.normalisations, settings.crop, settings.libero)
        patches = self.model.projector(self.model.vision_backbone(upload(pixels, self.device).to(self.dtype)))
        words = self.words(observation.instruction)
        return torch.cat([words[:, :1], patches, words[:, 1:]], 1)

    def _words(self, instruction: str) -> Tensor:
        ids = upload([self.prompter.ids(instruction)], self.device)
        return self.trunk.embed_tokens(ids)

    def embed(self, tokens: Tensor) -> Tensor:
        return self.trunk.embed_tokens(self.shape.vocabulary - 1 - tokens)

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        return self.trunk.new_cache(batch, capacity, fixed)

    def forward(self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: Seen = None) -> Tensor:
        return self.trunk(x, positions, cache, seen)

    def head(self, hidden: Tensor) -> Tensor:
        """Return the logits (..., V) of the action tokens only."""
        return F.linear(hidden, self.action_rows)


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> OpenVLATarget:
    return OpenVLATarget(read_settings(folder, description), description, device, dtype)


def read_settings(folder: Path, description: TargetDescription) -> OpenVLASettings:
    return read(OpenVLASettings, description.settings, str(folder / "target.json"))


def check_weights(folder: Path, description: TargetDescription) -> None:
    """Check the names and sizes of the checkpoint's files. Hashing 15 GB would take too long."""
    settings = read_settings(folder, description)
    source = Path(settings.checkpoint)
    if not source.is_dir() or open_shards(source).sizes() != settings.files:
        raise CheckpointError(
            f"the weights that {folder} was made from are no longer in {source}: import it again with "
            "'kerv build target'"
        )


NO_STATE = ObservationSpace(proprioception=(), state=0, places=(), centre=(0.0, 0.0, 0.0))


def import_checkpoint(settings: BuildTargetSettings, folder: Path) -> dict[str, Any]:
    """Check all weights of an OpenVLA checkpoint, and write `target.json`. Return numbers to print, by name."""
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a Hugging Face OpenVLA checkpoint")
    source = Path(settings.checkpoint).expanduser().resolve()
    shape = read_shape(source)
    spec = None if settings.environment is None else EnvironmentPart.find(settings.environment).built()
    if spec is not None and spec.actions.dofs == len(DOFS) and spec.grip not in ((), GRIP):
        raise UsageError(
            f"environment={spec.name}: its gripper closes with {spec.grip[0]:g}, OpenVLA's with {GRIP[0]:g}: leave it "
            "out, and let kerv serve convert, with gripper=signed_inverted"
        )
    statistics, bounds = read_statistics(source, settings.statistics)
    actions = action_space(shape, bounds, spec.actions if spec else None, settings.control_hz)
    prompt = Prompter(source, shape, settings.prompt_tokens).ids("move")
    read_normalisations(source)
    shards = open_checked(source, shape)
    parameters, hashes = check_finite(shards), shards.hashes()
    chosen = {name: getattr(settings, name) for name in ("crop", "libero")}
    target = OpenVLASettings(str(source), statistics, shards.sizes(), **chosen)
    target = replace(target, prompt_tokens=settings.prompt_tokens, image_size=shape.towers[0].image)
    if not settings.libero:  # left out, so that targets from before this setting keep their hashes
        del chosen["libero"]
    figures = {"files": hashes, "parameters": parameters}
    fields = target_fields(
        "openvla",
        asdict(target),
        spec.name if spec else "none",
        actions,
        spec.observation if spec else NO_STATE,
        cameras=[spec.camera_name(settings.camera) if spec else settings.camera or "primary"],
        provenance=provenance_of("kerv build target", settings, settings.runtime.device, **figures),
    )
    described = {"format": FORMAT, "kind": "target", "sha256": digest_of(hashes, chosen), **fields}
    write_json(folder / "target.json", described)
    sizes = {"prompt tokens": shape.patches + len(prompt), "action tokens": actions.tokens, "DoFs": actions.dofs}
    return {"parameters": parameters, **sizes}
