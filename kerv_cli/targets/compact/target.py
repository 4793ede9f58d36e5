"""The target: vision + instruction + scene + proprioception tokens -> Llama-style trunk -> action tokens.

Prompt order: [vision grid] [instruction] [scene] [proprioception]; the last prompt position predicts token 0.

Scene tokens carry where the object and the goal are, as positions and as vectors relative to the hand. With
`observation=vision` the positions are *estimated* from the image points (supervised while training, never read from the
simulator afterwards); with `observation=state` they are given, together with the rest of Meta-World's state:
privileged, to separate decoding from perception.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.settings import TargetSettings
from kerv_cli.spaces import VOCABULARY, ActionTokenizer
from kerv_cli.targets.compact.inference import Planned
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.targets.compact.trunk import Cache, Trunk
from kerv_cli.targets.compact.vision import VisionEncoder

OBJECT, GOAL = slice(4, 7), slice(36, 39)  # Meta-World's state vector
WORKSPACE = (0.0, 0.7, 0.15)  # metres, centre of the positions that Meta-World uses
STATE_EXTRAS = 11 + 18 + 12  # rotations and second object, velocities, vectors to the second object


@dataclass(frozen=True)
class Inputs:
    """A batch of observations as the policy takes them. images (B, 3, s, s) uint8 or None, states (B, 39) float32,
    words (B, L) int64. Of `states` a vision policy reads only the first four numbers (hand, gripper)."""

    images: Tensor | None
    states: Tensor
    words: Tensor


def relative(vector: Tensor) -> Tensor:
    """(…, 3) metres -> (…, 6): a coarse linear and a fine saturating view of the same vector."""
    return torch.cat([vector / 0.1, torch.tanh(vector / 0.02)], -1)


def scene_features(states: Tensor, positions: Tensor, centre: Tensor) -> Tensor:
    """states (B, >=4), positions (B, 6) object and goal, metres -> (B, 28)."""
    hand, gripper = states[:, :3], states[:, 3:4]
    thing, goal = positions[:, :3], positions[:, 3:]
    absolute = [(hand - centre) / 0.1, gripper, (thing - centre) / 0.1, (goal - centre) / 0.1]
    return torch.cat([*absolute, relative(thing - hand), relative(goal - hand), relative(goal - thing)], -1)


def privileged_features(states: Tensor) -> Tensor:
    """states (B, 39) -> (B, 41): what Meta-World's state has beyond the two positions."""
    second = states[:, 11:14]
    velocity = (states[:, :18] - states[:, 18:36]) / 0.01
    vectors = [relative(second - states[:, :3]), relative(states[:, GOAL] - second)]
    return torch.cat([states[:, 7:18], velocity.clamp(-3, 3), *vectors], -1)


class Target(Planned):
    """The policy put together. Parameters in float32; `VOCABULARY` action tokens; greedy target_tokens are the argmax."""

    centre: Tensor

    def __init__(self, settings: TargetSettings, actions: ActionTokenizer, words: WordTokenizer) -> None:
        super().__init__()
        s = self.settings = settings
        self.actions, self.words = actions, words
        self.register_buffer("centre", torch.tensor(WORKSPACE), persistent=False)
        self.embedding = nn.Embedding(VOCABULARY, s.width)
        self.embedding.weight.data = _smooth_table(s.width)
        self.word_embedding = nn.Embedding(words.size, s.width)
        nn.init.normal_(self.word_embedding.weight, std=0.02)
        features = 28 + (STATE_EXTRAS if s.observation == "state" else 0)
        self.scene = nn.Sequential(
            nn.Linear(features, 2 * s.width), nn.SiLU(), nn.Linear(2 * s.width, s.scene_tokens * s.width)
        )
        self.proprioception = nn.Sequential(nn.Linear(4, s.width), nn.SiLU(), nn.Linear(s.width, s.width))
        if s.observation == "vision":
            self.vision = VisionEncoder(s.image_size, s.grid, s.keypoints, s.channels, s.width)
            self.locate = nn.Sequential(
                nn.Linear(2 * s.keypoints + 4 + s.width, 256),
                nn.SiLU(),
                nn.Linear(256, 128),
                nn.SiLU(),
                nn.Linear(128, 6),
            )
        self.trunk = Trunk(s.width, s.layers, s.heads, s.feed_forward)
        self.head = nn.Linear(s.width, VOCABULARY, bias=False)
        nn.init.normal_(self.head.weight, std=0.02)

    @property
    def needs_frame(self) -> bool:
        return self.settings.observation == "vision"

    @property
    def tokens_per_chunk(self) -> int:
        """N = H · D."""
        return self.settings.chunk * self.settings.dofs

    @property
    def prompt_length(self) -> int:
        """P, the same for every observation and instruction."""
        s = self.settings
        return (s.grid**2 if self.needs_frame else 0) + s.instruction_tokens + s.scene_tokens + 1

    @property
    def device(self) -> torch.device:
        return self.head.weight.device

    def inputs(self, frame: np.ndarray | None, state: np.ndarray, words: Tensor) -> Inputs:
        """One observation to a batch of one: frame (s, s, 3) uint8 or None, state (39,), words (1, L)."""
        images = None
        if self.needs_frame:
            images = torch.from_numpy(np.ascontiguousarray(frame)).to(self.device).permute(2, 0, 1)[None]
        states = torch.from_numpy(np.asarray(state, dtype=np.float32)).to(self.device)[None]
        return Inputs(images, states, words)

    def words_of(self, instruction: str) -> Tensor:
        """(1, L) int64."""
        return torch.tensor([self.words.encode(instruction, self.settings.instruction_tokens)], device=self.device)

    def encode(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """Prompt embeddings (B, P, E) and the object and goal positions (B, 6) in metres they are built on."""
        if self.plan is not None and len(inputs.states) == 1:
            return self.plan(inputs)
        words = self.word_embedding(inputs.words)
        hand = torch.cat([(inputs.states[:, :3] - self.centre) / 0.1, inputs.states[:, 3:4]], -1)
        parts = []
        if self.needs_frame:
            tokens, positions = self.see(inputs, words, hand)
            parts.append(tokens)
            features = scene_features(inputs.states, positions, self.centre)
        else:
            positions = torch.cat([inputs.states[:, OBJECT], inputs.states[:, GOAL]], -1)
            features = scene_features(inputs.states, positions, self.centre)
            features = torch.cat([features, privileged_features(inputs.states)], -1)
        scene = self.scene(features.to(self.head.weight.dtype)).unflatten(-1, (self.settings.scene_tokens, -1))
        proprioception = self.proprioception(hand.to(self.head.weight.dtype))[:, None]
        return torch.cat([*parts, words, scene, proprioception], 1), positions

    def see(self, inputs: Inputs, words: Tensor, hand: Tensor) -> tuple[Tensor, Tensor]:
        """Vision tokens (B, grid², E) and estimated object and goal positions (B, 6), metres."""
        assert inputs.images is not None
        tokens, points = self.vision(inputs.images)
        # bfloat16 would round image points to a fifth of a cell: millimetres matter here
        with torch.autocast(points.device.type, enabled=False):
            features = torch.cat([points, hand, words.mean(1)], -1).to(self.head.weight.dtype)
            located = self.locate(features)
        return tokens, located.float() * 0.1 + self.centre.repeat(2)

    def forward(self, inputs: Inputs, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Teacher forcing: tokens (B, N) -> logits (B, N, V) that predict them, positions (B, 6) metres."""
        prompt, positions = self.encode(inputs)
        x = torch.cat([prompt, self.embedding(tokens[:, :-1]).to(prompt.dtype)], 1)
        hidden = self.trunk(x, torch.arange(x.shape[1], device=x.device))
        return self.head(hidden[:, self.prompt_length - 1 :]), positions

    def prefill(self, prompt: Tensor, cache: Cache) -> Tensor:
        """Encode a prompt (1, P, E) into an emptied cache -> hidden (1, P, E)."""
        cache.length = 0
        return self.trunk(prompt, torch.arange(prompt.shape[1], device=prompt.device), cache)

    def step(self, tokens: Tensor, positions: Tensor, cache: Cache, mask: Tensor | None = None) -> Tensor:
        """Forward tokens (1, T) at positions (T,) behind the cache -> hidden (1, T, E); mask as in `Trunk`."""
        return self.trunk(self.embedding(tokens), positions, cache, mask)


def _smooth_table(width: int) -> Tensor:
    """(V, E) initial embedding in which neighbouring bins are neighbours: cosines of the bin's value."""
    centres = torch.linspace(-1, 1, VOCABULARY)[:, None]
    generator = torch.Generator().manual_seed(0)
    frequency = torch.exp(torch.rand(width, generator=generator) * 4.0)  # up to 55 rad per unit
    phase = torch.rand(width, generator=generator) * 2 * torch.pi
    return 0.03 * torch.cos(centres * frequency + phase)
