"""The compact target: vision + instruction + scene + proprioception tokens -> Llama-style trunk -> action tokens.

Prompt order: [vision grid] [instruction] [scene] [proprioception]; the last prompt position predicts token 0. A frame
of several views has as many grids.

Scene tokens carry where the environment's places are (object and goal, say), as positions and as vectors relative to
the hand. With `observation=vision` the positions are *estimated* from the image points (supervised while training,
never read from the simulator afterwards); with `observation=state` they are given, together with the rest of the state:
privileged, to separate decoding from perception.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.engine.transfer import upload
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.compact.features import (
    hand_features,
    mlp,
    places_of,
    privileged_features,
    privileged_width,
    scene_features,
    scene_width,
)
from kerv_cli.targets.compact.packable import Packable, PackableLinear, wants_gradient
from kerv_cli.targets.compact.program import Program
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.targets.compact.trunk import Trunk
from kerv_cli.targets.compact.vision import VisionEncoder
from kerv_cli.worlds.views import frame_shape, views_of


@dataclass(frozen=True)
class Inputs:
    """A batch of observations as tensors; a vision policy does not read the states.

    Attributes:
        images: (B, 3, size, size · views) uint8, or None.
        proprioception: (B, p) float32.
        states: (B, s) float32.
        words: (B, L) int64.
    """

    images: Tensor | None
    proprioception: Tensor
    states: Tensor
    words: Tensor


class Compiled(NamedTuple):
    """The compiled forms of a target: what encodes a prompt, and what decodes one token after another."""

    prompt: Program
    step: Program | None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()


class CompactTarget(Packable):
    """The compact policy: encoder, trunk and head; implements `ReadableTarget`. Its parameters are float32.

    Attributes:
        cameras: The camera whose images a vision policy reads. Each of its views has an encoder and vision tokens.
        frame_shape: Shape of those images.
        segments: Slice of the prompt by the name of its part.
        sha256: Of the weights it was loaded with, else empty.
        chunk: H, control steps it was trained to decode at once.
        parallel: Whether it decodes by `parallel_pass` alone. It has not learnt to continue action tokens.
        width: E.
        heads, feed_forward: Attention heads and hidden units of the trunk's layers, and of a drafter's.
    """

    centre: Tensor
    packed: Compiled | None

    def __init__(
        self,
        settings: TargetSettings,
        actions: ActionSpace,
        observation: ObservationSpace,
        words: WordTokenizer,
        camera: str = "",
    ) -> None:
        super().__init__()
        s = self.settings = settings
        self.actions, self.observation, self.words, self.sha256 = actions, observation, words, ""
        self.grown_drafter: Any = None  # of a grown target: the shape of its drafter, if that grows too
        self.chunk, self.parallel = s.chunk, s.parallel
        self.width, self.heads, self.feed_forward = s.width, s.heads, s.feed_forward
        self.cameras = (camera,) if s.observation == "vision" else ()
        views = len(views_of(camera)) if self.cameras else 0
        self.segments, self.frame_shape = _segments(s, views), frame_shape(camera, s.image_size)
        p, places = len(observation.proprioception), len(observation.places)
        self.register_buffer("centre", torch.tensor(observation.centre), persistent=False)
        self.embedding = nn.Embedding(actions.tokens, s.width)
        self.embedding.weight.data = _smooth_table(actions.tokens, s.width)
        self.word_embedding = nn.Embedding(words.size, s.width)
        nn.init.normal_(self.word_embedding.weight, std=0.02)
        features = scene_width(observation) + (privileged_width(observation) if s.observation == "state" else 0)
        self.scene = mlp(features, 2 * s.width, s.scene_tokens * s.width)
        self.proprioception = mlp(p, s.width, s.width)
        if s.observation == "vision":
            shapes = s.image_size, s.grid, s.keypoints, s.channels, s.width, s.norm
            self.vision = VisionEncoder(*shapes)
            self.further_views = nn.ModuleList(VisionEncoder(*shapes) for _ in range(views - 1))
            self.locate = mlp(2 * s.keypoints * views + p + s.width, 256, 128, 3 * places)
        self.trunk = Trunk(s.width, s.layers, s.heads, s.feed_forward)
        self.head = PackableLinear(s.width, actions.tokens, bias=False)
        nn.init.normal_(self.head.weight, std=0.02)
        if s.parallel:
            queries = self.embedding.weight.data.mean(0).repeat(s.chunk * actions.dofs, 1)
            self.queries = nn.Parameter(queries + 0.02 * torch.randn_like(queries))

    @property
    def max_prompt(self) -> int:
        """P, which is the same for every observation and instruction."""
        return self.segments["proprioception"].stop

    @property
    def encoders(self) -> tuple[VisionEncoder, ...]:
        """The encoders of a vision policy's views, from left to right."""
        return self.vision, *self.further_views

    @property
    def pooled_width(self) -> int:
        """F of `pooled`."""
        return self.width * (self.settings.scene_tokens + (3 if self.cameras else 2))

    def pooled(self, prompt: Tensor) -> Tensor:
        """Pool a prompt (B, P, E) -> (B, F): scene tokens, proprioception, mean word, and mean vision token if any."""
        parts = self.segments
        pooled = [prompt[:, parts["scene"]].flatten(1), prompt[:, parts["proprioception"]].flatten(1)]
        pooled += [prompt[:, parts[name]].mean(1) for name in ("instruction", "vision") if name in parts]
        return torch.cat(pooled, -1)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.head.weight.device

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the weights."""
        return self.head.weight.dtype

    def inputs(self, observation: Observation) -> Inputs:
        """Return one observation as a batch of one.

        Raises:
            CheckpointError: Numbers or images have another size than in training.
        """
        proprioception, state = (
            upload(np.asarray(x, dtype=np.float32), self.device)[None]
            for x in (observation.proprioception, observation.state)
        )
        given = proprioception.shape[1], state.shape[1]
        sizes = len(self.observation.proprioception), self.observation.state
        if given != sizes:
            raise CheckpointError(
                f"the target takes {sizes[0]} numbers of proprioception and {sizes[1]} of state, the environment gives "
                f"{given[0]} and {given[1]}: it was trained for another environment"
            )
        images = None
        for camera in self.cameras:
            if camera not in observation.images:
                raise CheckpointError(f"the target was trained on images of camera '{camera}', which were not drawn")
            image = np.ascontiguousarray(observation.images[camera])
            if image.shape != self.frame_shape:
                raise CheckpointError(
                    f"the image of camera '{camera}' has shape {image.shape}, the target takes {self.frame_shape}"
                )
            images = upload(image, self.device).permute(2, 0, 1)[None]
        words = self.words.encode(observation.instruction, self.settings.instruction_tokens)
        return Inputs(images, proprioception, state, upload([words], self.device))

    def encode(self, observation: Observation) -> Tensor:
        """Return the prompt's embeddings (1, P, E); errors as `inputs`."""
        return self.encode_batch(self.inputs(observation))[0]

    def encode_many(self, observations: Sequence[Observation]) -> Tensor:
        """Return the prompts' embeddings (B, P, E); errors as `inputs`."""
        batch = [self.inputs(observation) for observation in observations]
        images = [one.images for one in batch if one.images is not None]
        rows = (torch.cat([getattr(one, name) for one in batch]) for name in ("proprioception", "states", "words"))
        return self.encode_batch(Inputs(torch.cat(images) if images else None, *rows))[0]

    def encode_batch(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """Return prompt embeddings (B, P, E), and the places' positions (B, K, 3) in metres that they carry."""
        given = [inputs.words, inputs.proprioception, inputs.states]
        if self.cameras:
            assert inputs.images is not None
            images = inputs.images.split(self.settings.image_size, -1)
            views = [encoder(image) for encoder, image in zip(self.encoders, images, strict=True)]
            given[2:] = torch.cat([tokens for tokens, _ in views], 1), torch.cat([points for _, points in views], -1)
        if self.packed is not None and not any(map(wants_gradient, given)):
            prompt, places = self.packed.prompt(*given)
            return prompt, places
        return self.prompt(*given)

    def prompt(self, words: Tensor, proprioception: Tensor, *seen: Tensor) -> tuple[Tensor, Tensor]:
        """Compute `encode_batch` by the modules. seen: states (B, s), or vision tokens and points of all views."""
        embedded, hand = self.word_embedding(words), hand_features(proprioception, self.centre)
        if self.cameras:
            tokens, points = seen
            places = self.located(points, hand, embedded)
            features, parts = scene_features(proprioception, places, self.centre), [tokens]
        else:
            places = places_of(seen[0], self.observation)
            features = scene_features(proprioception, places, self.centre)
            features = torch.cat([features, privileged_features(proprioception, seen[0], self.observation)], -1)
            parts = []
        scene = self.scene(features.to(self.head.weight.dtype)).unflatten(-1, (self.settings.scene_tokens, -1))
        felt = self.proprioception(hand.to(self.head.weight.dtype))[:, None]
        return torch.cat([*parts, embedded, scene, felt], 1), places

    def located(self, points: Tensor, hand: Tensor, words: Tensor) -> Tensor:
        """Estimate the places' positions (B, K, 3), metres."""
        # bfloat16 would round image points to a fifth of a cell: millimetres matter here
        with torch.autocast(points.device.type, enabled=False):
            features = torch.cat([points, hand, words.mean(1)], -1).to(self.head.weight.dtype)
            located = self.locate(features)
        return located.to(torch.float32).unflatten(-1, (-1, 3)) * 0.1 + self.centre

    def pack_weights(self) -> Compiled | None:
        """Return what encodes a prompt and what decodes a token, compiled; None in other formats than float32."""
        if self.dtype != torch.float32:
            return None
        s, space = self.settings, self.observation
        shapes: list[tuple[int, ...]] = [(1, s.instruction_tokens), (1, len(space.proprioception))]
        if self.cameras:
            views = len(self.encoders)
            shapes += [(1, s.grid**2 * views, s.width), (1, 2 * s.keypoints * views)]
        else:
            shapes += [(1, space.state)]

        def step(token: Tensor) -> Tensor:
            return self.head(self.trunk.recorded(self.embedding(token))).argmax(-1)

        return Compiled(Program(self.prompt, *shapes), Program(step, (1, 1), repeats=True))

    def embed(self, tokens: Tensor) -> Tensor:
        """Action tokens (B, T) int64 -> (B, T, E)."""
        return self.embedding(tokens)

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        """Return an empty cache. fixed: every forward has the same shapes; default: on CUDA."""
        return self.trunk.new_cache(batch, capacity, fixed)

    def forward(
        self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Return the hidden states (B, T, E) of x (B, T, E) at `positions` (T,), after the cached tokens."""
        return self.trunk(x, positions, cache, seen)

    def continue_greedily(self, token: int, count: int, cache: Cache) -> list[int] | None:
        """Decode `count` tokens after a token in one call; None if this target is not compiled."""
        step = self.packed.step if self.packed else None
        if step is None or cache.fixed:
            return None
        tokens = step.repeat(count, torch.tensor([[token]]), cache=cache)
        cache.length += count
        return [int(token) for token in tokens[:, 0]]

    def parallel_pass(self, prompt: Tensor, cache: Cache | None = None) -> Tensor:
        """Return the hidden states (B, N, E) of all tokens in one forward (docs/methods.md §6).

        No action token is embedded: learned queries at their positions see the prompt (B, P, E) and each other.
        """
        x = torch.cat([prompt, self.queries.to(prompt.dtype).expand(len(prompt), -1, -1)], 1)
        visible = np.tri(x.shape[1], dtype=bool)
        visible[prompt.shape[1] :] = True
        return self(x, torch.arange(x.shape[1], device=x.device), cache, visible)[:, prompt.shape[1] :]

    def teacher_forced(self, inputs: Inputs, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B, N, V) that predict tokens (B, N), and the places' positions (B, K, 3), metres.

        A parallel target is shown none of the tokens.
        """
        prompt, places = self.encode_batch(inputs)
        if self.parallel:
            return self.head(self.parallel_pass(prompt)), places
        x = torch.cat([prompt, self.embedding(tokens[:, :-1]).to(prompt.dtype)], 1)
        hidden = self(x, torch.arange(x.shape[1], device=x.device))
        return self.head(hidden[:, prompt.shape[1] - 1 :]), places


def _segments(settings: TargetSettings, views: int) -> Mapping[str, slice]:
    sizes = {"instruction": settings.instruction_tokens, "scene": settings.scene_tokens, "proprioception": 1}
    if views:
        sizes = {"vision": settings.grid**2 * views, **sizes}
    stops = itertools.accumulate(sizes.values())
    return {name: slice(stop - size, stop) for (name, size), stop in zip(sizes.items(), stops, strict=True)}


def _smooth_table(tokens: int, width: int) -> Tensor:
    """(V, E) initial embedding that is similar for neighbouring bins: cosines of the bin's value."""
    centres = torch.linspace(-1, 1, tokens)[:, None]
    generator = torch.Generator().manual_seed(0)
    frequency = torch.exp(torch.rand(width, generator=generator) * 4.0)  # up to 55 rad per unit
    phase = torch.rand(width, generator=generator) * 2 * torch.pi
    return 0.03 * torch.cos(centres * frequency + phase)
