"""The target of an OpenVLA checkpoint: `ReadableTarget` on published weights (arXiv 2406.09246).

Prompt order: [begin] [vision patches] [text], as its own code inserts the patches after the first token. Action token
t is id vocabulary - 1 - t. The head's logits are those of these ids alone, so greedy decoding equals the published
code's wherever its token is an action. (It takes the argmax over all ids and executes any other as the last bin.)
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.places import artifact
from kerv_cli.base.registry import find, load
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.transfer import upload
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.checkpoint import FORMAT, TargetDescription, target_fields
from kerv_cli.targets.openvla.config import action_space, read_shape, read_statistics
from kerv_cli.targets.openvla.inputs import Prompter, pixels_of, read_normalisations
from kerv_cli.targets.openvla.loading import check_finite, digest_of, load_model, open_checked, open_shards
from kerv_cli.targets.provenance import provenance
from kerv_cli.targets.settings import BuildTargetSettings


@dataclass(frozen=True)
class OpenVLASettings:
    """`settings` of a target.json of family openvla.

    Attributes:
        checkpoint: Folder of the published files.
        statistics: Data set whose actions it emits.
        files: File name to bytes.
        prompt: `openvla` or `openvla_v01`.
        crop: Whether it sees the central 90 % of an image (for checkpoints fine-tuned with augmented images).
        libero: Whether an image goes through JPEG and Lanczos, as in OpenVLA's evaluation on LIBERO.
        int8: Whether the language model's layers have one byte per weight.
        prompt_tokens: Longest prompt without the patches.
        image_size: Pixels of a tower.
        chunk: H, control steps per decode.
    """

    checkpoint: str
    statistics: str
    files: dict[str, int]
    prompt: str = "openvla"
    crop: bool = False
    libero: bool = False
    int8: bool = False
    prompt_tokens: int = 64
    image_size: int = 224
    chunk: int = 1


class OpenVLATarget:
    """The policy in a folder of published files. It reads the image of one camera."""

    def __init__(
        self, settings: OpenVLASettings, description: TargetDescription, device: str, dtype: torch.dtype
    ) -> None:
        """Load the checkpoint, frozen; errors as `build`."""
        source = Path(settings.checkpoint)
        self.settings, self.actions, self.cameras = settings, description.actions, tuple(description.cameras)
        self.shape = shape = read_shape(source)
        self.prompter = Prompter(source, shape, settings.prompt, settings.prompt_tokens)
        self.normalisations = read_normalisations(source)
        self.model = model = load_model(source, shape, device, dtype, settings.int8)
        self.chunk, self.width = settings.chunk, shape.language.hidden_size
        self.heads, self.feed_forward = shape.language.num_attention_heads, shape.language.intermediate_size
        self.max_prompt = shape.patches + settings.prompt_tokens
        last = shape.vocabulary
        self.action_rows = model.language_model.lm_head.weight[last - shape.bins : last].flip(0).contiguous()
        self.device, self.dtype = self.action_rows.device, self.action_rows.dtype
        self.words = functools.lru_cache(maxsize=64)(self._words)

    @property
    def segments(self) -> Mapping[str, slice]:
        """Slice of the prompt by the name of its part. The text ends with the prompt."""
        patches = self.shape.patches
        return {"begin": slice(0, 1), "vision": slice(1, 1 + patches), "instruction": slice(1 + patches, None)}

    @property
    def pooled_width(self) -> int:
        """F of `pooled`."""
        return 2 * self.width

    def pooled(self, prompt: Tensor) -> Tensor:
        """Return mean patch and mean word of a prompt (B, P, E) as (B, F)."""
        return torch.cat([prompt[:, self.segments[name]].mean(1) for name in ("vision", "instruction")], -1)

    def encode(self, observation: Observation) -> Tensor:
        """Return the prompt's embeddings (1, P, E).

        Raises:
            CheckpointError: The camera's image is missing.
            UsageError: The instruction is too long.
        """
        camera = self.cameras[0]
        if camera not in observation.images:
            raise CheckpointError(f"the target sees camera '{camera}', whose image was not drawn")
        image, settings = observation.images[camera], self.settings
        patches = self.see(pixels_of(image, self.shape, self.normalisations, settings.crop, settings.libero))
        words = self.words(observation.instruction)
        return torch.cat([words[:, :1], patches, words[:, 1:]], 1)

    def see(self, pixels: Tensor) -> Tensor:
        """Map pixels (B, 6, s, s) to vision tokens (B, n, E)."""
        return self.model.projector(self.model.vision_backbone(upload(pixels, self.device).to(self.dtype)))

    def _words(self, instruction: str) -> Tensor:
        ids = upload([self.prompter.ids(instruction)], self.device)
        return self.model.language_model.model.embed_tokens(ids)

    def embed(self, tokens: Tensor) -> Tensor:
        """Embed action tokens (B, T) int64 as (B, T, E)."""
        return self.model.language_model.model.embed_tokens(self.shape.vocabulary - 1 - tokens)

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        """Return an empty cache. `fixed`: every forward has the same shapes, by default on CUDA."""
        fixed = self.action_rows.is_cuda if fixed is None else fixed
        return Cache(*self.shape.language.cache_sizes(batch, capacity), self.action_rows, fixed)

    def forward(
        self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Return hidden states (B, T, E) of x (B, T, E) at `positions` (T,), after the cached tokens."""
        return self.model.language_model.model(x, positions, cache, seen)

    def head(self, hidden: Tensor) -> Tensor:
        """Return logits over the action tokens (..., V) of hidden states (..., E)."""
        return F.linear(hidden, self.action_rows)


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> OpenVLATarget:
    """Return the target that the target.json in `folder` describes, frozen.

    Raises:
        CheckpointError: The description is not OpenVLA's, or its checkpoint is missing or does not fit its config.
    """
    return OpenVLATarget(read_settings(folder, description), description, device, dtype)


def read_settings(folder: Path, description: TargetDescription) -> OpenVLASettings:
    """Return the description's settings; errors as `build`."""
    path = str(folder / "target.json")
    if len(description.cameras) != 1:
        raise CheckpointError(f"{path} names {len(description.cameras)} cameras: OpenVLA sees one")
    return read(OpenVLASettings, description.settings, path)


def check_weights(folder: Path, description: TargetDescription) -> None:
    """Compare the checkpoint's files with what was imported, by name and size: hashing 15 GB takes too long.

    Raises:
        CheckpointError: The folder is gone, or a file is missing, new or of another size.
    """
    settings = read_settings(folder, description)
    source = Path(settings.checkpoint)
    if not source.is_dir() or open_shards(source).sizes() != settings.files:
        raise CheckpointError(
            f"the weights that {folder} was made from are no longer in {source}: import it again with "
            "'kerv build target'"
        )


NO_STATE = ObservationSpace(proprioception=(), state=0, places=(), centre=(0.0, 0.0, 0.0))


def import_checkpoint(settings: BuildTargetSettings) -> tuple[Path, dict[str, Any]]:
    """Write target.json for the checkpoint. Every number of the weights is read once.

    Returns:
        The target's folder, and figures for the user.

    Raises:
        UsageError: There is no checkpoint, or several statistics and none chosen.
        UnknownName: There are no such statistics, or no such environment.
        CheckpointError: The folder is incomplete, damaged, pickled or another model's.
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a Hugging Face OpenVLA checkpoint")
    source = Path(settings.checkpoint).expanduser().resolve()
    shape = read_shape(source)
    spec = None if settings.environment is None else load(find("environment", settings.environment).build)
    statistics, bounds = read_statistics(source, settings.statistics)
    actions = action_space(shape, bounds, spec.actions if spec else None, settings.control_hz)
    prompt = Prompter(source, shape, settings.prompt, settings.prompt_tokens).ids("move")
    read_normalisations(source)
    shards = open_checked(source, shape)
    parameters, hashes = check_finite(shards), shards.hashes()
    chosen = {name: getattr(settings, name) for name in ("prompt", "crop", "int8", "libero")}
    target = OpenVLASettings(str(source), statistics, shards.sizes(), **chosen)
    target = replace(target, prompt_tokens=settings.prompt_tokens, image_size=shape.towers[0].image)
    if not settings.libero:  # hashes of older targets lack it
        del chosen["libero"]
    origin = {"command": "kerv build target", "settings": asdict(settings), "files": hashes, "parameters": parameters}
    fields = target_fields(
        "openvla",
        asdict(target),
        spec.name if spec else "none",
        actions,
        spec.observation if spec else NO_STATE,
        cameras=[spec.camera_name(settings.camera) if spec else settings.camera or "primary"],
        provenance={**origin, **provenance(settings.runtime.device)},
    )
    folder = artifact(settings.results, "target", settings.name)
    described = {"format": FORMAT, "kind": "target", "sha256": digest_of(hashes, chosen), **fields}
    write_json(folder / "target.json", described)
    tokens = shape.patches + len(prompt)
    figures = {"parameters": parameters, "prompt tokens": tokens, "action tokens": actions.tokens, "DoFs": actions.dofs}
    return folder, figures
