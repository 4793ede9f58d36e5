"""The compact target, the policy that kerv trains: a Llama-style trunk that maps prompt tokens to action tokens.

The prompt is [vision grid] [instruction] [scene] [proprioception]. The last prompt position predicts token 0. An image
of several camera views gives one vision grid per view.

Scene tokens encode the *places*: the 3D positions that matter to the task, such as object and goal. They contain each
place's position, the vector from the hand to the place, and the vector from the place to the next one. With
`observation=vision` these positions are estimated from the image. The estimate is trained on the simulator's positions,
which are never read afterwards. With `observation=state` the simulator gives the positions, together with the rest of
its state. Such a policy has privileged information. It serves to study decoding without perception.

Shapes: B observations, p and s numbers of proprioception and state, L words, K places, P prompt tokens, T new tokens, N
tokens of a chunk, V action tokens, E width.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.engine.draft import HOST, upload
from kerv_cli.engine.protocol import Seen
from kerv_cli.targets.attention import Cache, CapturedCache
from kerv_cli.targets.checkpoint import FLOAT32, TargetDescription, save_module, target_fields
from kerv_cli.targets.compact import features
from kerv_cli.targets.compact.features import VisionEncoder, WordTokenizer, mlp
from kerv_cli.targets.compact.program import Compilable, CompilableLinear, Program, load_compiled
from kerv_cli.targets.compact.trunk import POSITIONS, Trunk
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds.views import frame_shape, views_of


@dataclass(frozen=True)
class Inputs:
    """A batch of B observations as tensors.

    Attributes:
        images: (B, 3, size, size · views) uint8, all camera views side by side. None if the policy reads the state.
        proprioception: (B, p) float32.
        states: (B, s) float32, the simulator's state. A policy that reads images ignores it.
        words: (B, L) int64, ids of the instruction's words.
    """

    images: Tensor | None
    proprioception: Tensor
    states: Tensor
    words: Tensor


class Programs(NamedTuple):
    """The compiled programs of a target.

    Attributes:
        step: Program that reads a token, and returns the most probable next token and the hidden state. The next token
            can become the next input, so that one call of `Program.repeat` decodes several tokens.
    """

    prompt: Program
    step: Program
    dtype: torch.dtype


class CompactTarget(Compilable):
    """The compact policy: encoders, trunk and head. Implements the protocol `ReadableTarget`.

    Args:
        camera: Name of the camera. Names that are joined with `+` stand for one image of several camera views.

    Attributes:
        cameras: A tuple with one name, the camera whose images are read. Empty if the policy reads the state.
        max_prompt: P, number of prompt tokens. It is the same for every observation and instruction.
        parallel: Whether the policy decodes all tokens in one forward (`parallel_pass`), and not single tokens.
        enlarges: Function that enlarges a drafter in place, as this target was enlarged (docs/methods.md §0.2). None if
            drafters stay as they are.
    """

    centre: Tensor
    compiled: Programs | None

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
        self.actions, self.observation, self.words = actions, observation, words
        self.enlarges: Callable[[Any], None] | None = None
        self.chunk, self.parallel = s.chunk, s.parallel
        self.width, self.heads, self.feed_forward = s.width, s.heads, s.feed_forward
        self.cameras = (camera,) if s.observation == "vision" else ()
        views = len(views_of(camera)) if self.cameras else 0
        self.segments, self.frame_shape = _segments(s, views), frame_shape(camera, s.image_size)
        self.max_prompt = self.segments["proprioception"].stop
        if (positions := self.max_prompt + actions.longest(s.chunk)) > POSITIONS:
            raise UsageError(
                f"target.grid={s.grid} target.chunk={s.chunk}: prompt and chunk have {positions} tokens in all, at "
                f"most {POSITIONS} are possible"
            )
        self.pooled_width = s.width * (s.scene_tokens + (3 if self.cameras else 2))
        p, places = len(observation.proprioception), len(observation.places)
        self.register_buffer("centre", torch.tensor(observation.centre), persistent=False)
        self.embedding = nn.Embedding(actions.tokens, s.width)
        self.embedding.weight.data = _smooth_table(actions.tokens, s.width)
        self.word_embedding = nn.Embedding(words.size, s.width)
        nn.init.normal_(self.word_embedding.weight, std=0.02)
        read = features.scene_width(observation)
        read += features.privileged_width(observation) if s.observation == "state" else 0
        self.scene = mlp(read, 2 * s.width, s.scene_tokens * s.width)
        self.proprioception = mlp(p, s.width, s.width)
        if s.observation == "vision":
            shapes = s.image_size, s.grid, s.keypoints, s.channels, s.width, s.norm
            self.vision = VisionEncoder(*shapes)
            self.further_views = nn.ModuleList(VisionEncoder(*shapes) for _ in range(views - 1))
            self.locate = mlp(2 * s.keypoints * views + p + s.width, 256, 128, 3 * places)
        self.trunk = Trunk(s.width, s.layers, s.heads, s.feed_forward)
        self.head = CompilableLinear(s.width, actions.tokens, bias=False)
        nn.init.normal_(self.head.weight, std=0.02)
        if s.parallel:
            queries = self.embedding.weight.data.mean(0).repeat(actions.longest(s.chunk), 1)
            self.queries = nn.Parameter(queries + 0.02 * torch.randn_like(queries))

    @property
    def encoders(self) -> tuple[VisionEncoder, ...]:
        """The encoders of a vision policy, one per camera view, from left to right in the image."""
        return self.vision, *self.further_views

    def pooled(self, prompt: Tensor) -> Tensor:
        """Return (B, F): scene tokens, proprioception token, mean word token and mean vision token, concatenated."""
        parts = self.segments
        pooled = [prompt[:, parts["scene"]].flatten(1), prompt[:, parts["proprioception"]].flatten(1)]
        pooled += [prompt[:, parts[name]].mean(1) for name in ("instruction", "vision") if name in parts]
        return torch.cat(pooled, -1)

    @property
    def device(self) -> torch.device:
        # asked several times per round; a module finds its parts slowly
        return HOST if self.compiled is not None else self.head.weight.device

    @property
    def layers(self) -> nn.ModuleList:
        return self.trunk.layers

    @property
    def dtype(self) -> torch.dtype:
        return self.compiled.dtype if self.compiled is not None else self.head.weight.dtype

    def inputs(self, observation: Observation) -> Inputs:
        device = self.device
        proprioception = upload(np.asarray(observation.proprioception, dtype=np.float32)[None], device)
        state = upload(np.asarray(observation.state, dtype=np.float32)[None], device)
        given = proprioception.shape[1], state.shape[1]
        # a policy that reads images ignores the state, so that its length does not matter
        sizes = len(self.observation.proprioception), given[1] if self.cameras else self.observation.state
        if given != sizes:
            raise CheckpointError(
                f"the target takes {sizes[0]} numbers of proprioception and {sizes[1]} of state, the environment gives "
                f"{given[0]} and {given[1]}: it was trained for another environment"
            )
        images = None
        for camera in self.cameras:
            image = np.ascontiguousarray(observation.images[camera])
            if image.shape != self.frame_shape:
                raise CheckpointError(
                    f"the image of camera '{camera}' has shape {image.shape}, the target takes {self.frame_shape}"
                )
            images = upload(image.transpose(2, 0, 1)[None], device)
        words = self.words.encode(observation.instruction, self.settings.instruction_tokens)
        return Inputs(images, proprioception, state, upload([words], device))

    def encode(self, observation: Observation) -> Tensor:
        return self.encode_batch(self.inputs(observation))[0]

    def encode_many(self, observations: Sequence[Observation]) -> Tensor:
        columns: Any = zip(*(vars(inputs).values() for inputs in map(self.inputs, observations)), strict=True)
        joined: Any = (None if column[0] is None else torch.cat(column) for column in columns)
        return self.encode_batch(Inputs(*joined))[0]

    def encode_batch(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """Return prompts (B, P, E), and the positions (B, K, 3) in metres of places such as object and goal."""
        given = [inputs.words, inputs.proprioception, inputs.states]
        if self.cameras:
            assert inputs.images is not None
            if not self.further_views:
                given[2:] = self.vision(inputs.images)
            else:
                images = inputs.images.split(self.settings.image_size, -1)
                views = (encoder(image) for encoder, image in zip(self.encoders, images, strict=True))
                given[2:] = (torch.cat(parts, 1) for parts in zip(*views, strict=True))  # vision tokens, image points
        if self.compiled is not None and self.runs_compiled(*given):
            prompt, places = self.compiled.prompt(*given)
            return prompt.to(self.dtype), places
        return self.prompt(*given)

    def prompt(self, words: Tensor, proprioception: Tensor, *seen: Tensor) -> tuple[Tensor, Tensor]:
        """Compute what `encode_batch` returns with PyTorch's modules instead of compiled code.

        Args:
            words: (B, L) ids of words.
            proprioception: (B, p).
            seen: For a vision policy two tensors from its vision encoders: vision tokens (B, grid² · views, E) and
                image points (B, 2 · keypoints · views). For any other policy the states (B, s).
        """
        embedded, hand = self.word_embedding(words), features.hand_features(proprioception, self.centre)
        *tokens, read = seen  # vision tokens and image points, or only states
        if self.cameras:
            places = self.located(read, hand, embedded)
            known = features.scene_features(proprioception, places, self.centre)
        else:
            places = features.places_of(read, self.observation)
            known = features.scene_features(proprioception, places, self.centre)
            known = torch.cat([known, features.privileged_features(proprioception, read, self.observation)], -1)
        scene = self.scene(known.to(self.head.weight.dtype)).unflatten(-1, (self.settings.scene_tokens, -1))
        felt = self.proprioception(hand.to(self.head.weight.dtype))[:, None]
        return torch.cat([*tokens, embedded, scene, felt], 1), places

    def located(self, points: Tensor, hand: Tensor, words: Tensor) -> Tensor:
        """Estimate the positions (B, K, 3) of the task's places (object, goal, …) in metres.

        Args:
            points: (B, 2 · keypoints · views) image points.
            hand: (B, p) result of `hand_features`.
            words: (B, L, E) embedded words.
        """
        # bfloat16 would round image points to a fifth of a cell: millimetres matter here
        with torch.autocast(points.device.type, enabled=False):
            located = self.locate(torch.cat([points, hand, words.mean(1)], -1).to(self.head.weight.dtype))
        return located.to(torch.float32).unflatten(-1, (-1, 3)) * 0.1 + self.centre

    def new_program(self) -> Programs:
        s, space = self.settings, self.observation
        shapes: list[tuple[int, ...]] = [(1, s.instruction_tokens), (1, len(space.proprioception))]
        if self.cameras:
            views = len(self.encoders)
            shapes += [(1, s.grid**2 * views, s.width), (1, 2 * s.keypoints * views)]
        else:
            shapes += [(1, space.state)]

        def step(token: Tensor) -> tuple[Tensor, Tensor]:
            hidden = self.trunk.recorded(self.embedding(token))
            return self.head(hidden).argmax(-1)[None], hidden

        return Programs(Program(self.prompt, *shapes), Program(step, (1, 1), repeats=True), self.head.weight.dtype)

    def join(self, function: Callable[..., Any], *shapes: tuple[int, ...], repeats: bool = False) -> Program | None:
        return Program(function, *shapes, repeats=repeats) if self.compiled is not None else None

    def enlarge(self, drafter: Any) -> None:
        if self.enlarges is not None:
            self.enlarges(drafter)

    def embed(self, tokens: Tensor) -> Tensor:
        return torch.embedding(self.embedding.weight, tokens)

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        cache = self.trunk.new_cache(batch, capacity, fixed)
        if isinstance(cache, CapturedCache):
            cache.head = self.head
        return cache

    def forward(self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: Seen = None) -> Tensor:
        return self.trunk(x, positions, cache, seen)

    def continue_greedily(self, token: int, count: int, cache: Cache, end: int | None = None) -> list[int] | None:
        if self.compiled is None or cache.fixed:
            return None
        tokens = self.compiled.step.repeat(count, upload([[token]], self.device), cache=cache, end=end)
        cache.length += len(tokens)
        return tokens[:, 0].astype(int).tolist()

    def predict(self, tokens: Tensor, positions: Tensor, cache: Cache, seen: Seen) -> tuple[Tensor, Tensor]:
        if self.compiled is None or cache.fixed:
            hidden = self(self.embed(tokens[None]), positions, cache, seen)
            captured = cache.predicted if isinstance(cache, CapturedCache) else None
            return captured[0] if captured is not None else self.head(hidden[0]).argmax(-1), hidden
        found, hidden = self.compiled.step(tokens, positions=positions, cache=cache, seen=seen)
        cache.length += len(found)
        return found[:, 0].long(), hidden.view(1, len(found), -1).to(self.dtype)

    def parallel_pass(self, prompt: Tensor, cache: Cache | None = None) -> Tensor:
        """Return the outputs of learned queries that take the place of action tokens (docs/methods.md §6).

        Every query attends to the prompt and to all queries.
        """
        x = torch.cat([prompt, self.queries.to(prompt.dtype).expand(len(prompt), -1, -1)], 1)
        visible = np.tri(x.shape[1], dtype=bool)
        visible[prompt.shape[1] :] = True
        return self(x, torch.arange(x.shape[1], device=x.device), cache, visible)[:, prompt.shape[1] :]

    def teacher_forced(self, inputs: Inputs, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B, N, V) that predict the true `tokens` (B, N), and the positions (B, K, 3) of `encode_batch`.

        A parallel target does not read the tokens.
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
    # neighbouring tokens are similar: each number is a cosine of the token's value, with random frequency and phase
    centres = torch.linspace(-1, 1, tokens)[:, None]
    generator = torch.Generator().manual_seed(0)
    frequency = torch.exp(torch.rand(width, generator=generator) * 4.0)  # up to 55 rad per unit
    phase = torch.rand(width, generator=generator) * 2 * torch.pi
    return 0.03 * torch.cos(centres * frequency + phase)


def save_target(
    folder: Path,
    target: CompactTarget,
    environment: str,
    provenance: dict[str, Any],
    stored: str = FLOAT32,
    state_range: Sequence[Sequence[float]] | None = None,
) -> str:
    """Write a target's weights and `target.json`. Return the SHA-256 of the weights.

    Args:
        environment: Name of the environment that the target's demonstrations come from.
        stored: Number format of the stored weights: float32, float16 or int8.
        state_range: As in `TargetDescription`.
    """
    others: dict[str, Any] = {"cameras": target.cameras, "words": target.words.words, "provenance": provenance}
    if state_range:
        others["state_range"] = state_range
    spaces = target.actions, target.observation
    fields = target_fields("compact", asdict(target.settings), environment, *spaces, **others)
    return save_module(folder, "target", target, fields, stored)


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> CompactTarget:
    """Load a compact target for inference. The target is frozen and, on a CPU, compiled."""
    settings = read(TargetSettings, description.settings, str(folder / "target.json"))
    camera = description.cameras[0] if description.cameras else ""
    words = WordTokenizer(description.words)
    target = CompactTarget(settings, description.actions, description.observation, words, camera)
    return load_compiled(target, folder, "target", device, dtype)
