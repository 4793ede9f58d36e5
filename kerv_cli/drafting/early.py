"""The early drafter: the whole chunk from the prompt alone, before the target's trunk has run (METHODS §5, ours).

It reads what the target encodes anyway (scene, proprioception, pooled words and vision tokens) and the last executed
actions: a residual network of which every token gets a few features, and one head turns features into bins. Nothing is
autoregressive, so a chunk costs one small pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.drafting.datastore import segments_of
from kerv_cli.errors import CheckpointError, UsageError
from kerv_cli.settings import DrafterSettings, TargetSettings
from kerv_cli.spaces import GRIPPER, VOCABULARY
from kerv_cli.targets.checkpoint import load_state, read_description, save_module
from kerv_cli.targets.compact.layout import lay_out_for_inference
from kerv_cli.targets.compact.target import Target


def pool(prompt: Tensor, settings: TargetSettings) -> Tensor:
    """prompt (B, P, E) -> (B, F): scene tokens end to end, proprioception, mean word, mean vision token if any."""
    parts = segments_of(settings)
    words = slice(parts["scene"].start - settings.instruction_tokens, parts["scene"].start)
    pooled = [prompt[:, parts["scene"]].flatten(1), prompt[:, parts["proprioception"]].flatten(1)]
    pooled.append(prompt[:, words].mean(1))
    if "vision" in parts:
        pooled.append(prompt[:, parts["vision"]].mean(1))
    return torch.cat(pooled, -1)


def pooled_width(settings: TargetSettings) -> int:
    """F of `pool`."""
    return settings.width * (settings.scene_tokens + (3 if settings.observation == "vision" else 2))


def padded(history: np.ndarray, length: int, dofs: int) -> tuple[np.ndarray, np.ndarray]:
    """history (m, D), oldest first -> its newest `length` actions (length, D) and which of them are known (length,),
    both float32; what an episode's start lacks is zero and stands in front."""
    actions, known = np.zeros((length, dofs), np.float32), np.zeros(length, np.float32)
    newest = history[max(0, len(history) - length) :]
    if len(newest):
        actions[-len(newest) :], known[-len(newest) :] = newest, 1.0
    return actions, known


class Block(nn.Module):
    """Residual SwiGLU block, pre-norm; measured better than a plain one of as many weights."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(width, width)
        nn.init.zeros_(self.down.weight)

    def forward(self, x: Tensor) -> Tensor:
        gate, up = self.gate_up(self.norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class EarlyDrafter(nn.Module):
    """A residual network from (pooled prompt, last actions) to the logits of all N tokens."""

    mean: Tensor
    scale: Tensor

    def __init__(self, settings: DrafterSettings, target: TargetSettings) -> None:
        super().__init__()
        if min(settings.width, settings.rank) < 1 or min(settings.layers, settings.history) < 0:
            raise UsageError("drafter: width and rank must be at least 1, layers and history at least 0")
        self.settings, self.target = settings, target
        self.tokens = target.chunk * target.dofs
        features = pooled_width(target)
        # prompt embeddings differ in size by orders of magnitude; actions lie in [-1, 1] as they are
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.enter = nn.Linear(features + settings.history * (target.dofs + 1), settings.width)
        self.blocks = nn.ModuleList(Block(settings.width) for _ in range(settings.layers))
        self.norm = nn.RMSNorm(settings.width, eps=1e-5)
        self.spread = nn.Linear(settings.width, self.tokens * settings.rank)
        self.head = nn.Linear(settings.rank, VOCABULARY)

    def standardise(self, features: Tensor) -> None:
        """Remember mean and spread of the training features (n, F)."""
        self.mean.copy_(features.float().mean(0))
        self.scale.copy_(1.0 / features.float().std(0).clamp_min(1e-3))

    def forward(self, prompt: Tensor, history: Tensor, known: Tensor) -> Tensor:
        """prompt (B, P, E), history (B, h, D) normalised, known (B, h) -> logits (B, N, V)."""
        return self.draft(pool(prompt, self.target), history, known)

    def draft(self, features: Tensor, history: Tensor, known: Tensor) -> Tensor:
        """`forward` on pooled prompts (B, F)."""
        x = torch.cat([(features - self.mean) * self.scale, history.flatten(1), known], -1)
        x = self.enter(x)
        for block in self.blocks:
            x = block(x)
        logits: Tensor = self.head(self.spread(self.norm(x)).unflatten(-1, (self.tokens, self.settings.rank)))
        return logits

    @torch.inference_mode()
    def propose(self, prompt: Tensor, history: np.ndarray, size: int | None = None, radius: int = 0) -> list[int]:
        """prompt (1, P, E), history (m, D) normalised executed actions, oldest first -> the chunk's first `size`
        tokens (default all N). radius: how far from its verdict a draft token is accepted, see `choose`."""
        return self.drafted(prompt, history, radius)[0][:size]

    @torch.inference_mode()
    def drafted(self, prompt: Tensor, history: np.ndarray, radius: int) -> tuple[list[int], float]:
        """As `propose`: all N tokens, and how likely the drafter holds it that every one of them is accepted."""
        weight = self.head.weight
        actions, known = padded(history, self.settings.history, self.target.dofs)
        tensors = [torch.from_numpy(x).to(device=weight.device, dtype=weight.dtype)[None] for x in (actions, known)]
        logits = self(prompt.to(weight.dtype), *tensors)
        tokens = choose(logits, radius, self.target.dofs)
        return tokens[0].tolist(), float(acceptance_odds(logits, tokens, radius, self.target.dofs)[0])


def choose(logits: Tensor, radius: int, dofs: int) -> Tensor:
    """logits (B, N, V) -> tokens (B, N): the bins that are most likely to be accepted at `radius`.

    The most probable bin is not the one with the most probability within ±radius. Inside a wide window many bins are
    equally good; a third of the radius and the bin itself count a little, so that what is kept stays close to the
    verdict. The gripper's token is always the most probable one: it is judged strictly.
    """
    best = logits.argmax(-1)
    if not radius:
        return best
    probability = logits.float().softmax(-1)
    score = _within(probability, radius) + 0.1 * _within(probability, radius // 3) + 0.05 * probability
    tokens = score.argmax(-1)
    tokens[:, GRIPPER::dofs] = best[:, GRIPPER::dofs]
    return tokens


def acceptance_odds(logits: Tensor, tokens: Tensor, radius: int, dofs: int) -> Tensor:
    """logits (B, N, V), tokens (B, N) -> (B,): probability that each token lies within `radius` of its verdict, the
    gripper's exactly on it, if the tokens were independent. They are not, and soft labels keep the
    drafter unsure: the number is far too low, but it orders chunks well."""
    probability = logits.float().softmax(-1)
    exact = probability.gather(-1, tokens[..., None])[..., 0]
    odds = _within(probability, radius).gather(-1, tokens[..., None])[..., 0]
    odds[:, GRIPPER::dofs] = exact[:, GRIPPER::dofs]
    return odds.prod(-1)


def _within(probability: Tensor, radius: int) -> Tensor:
    """(…, V) -> probability of lying at most `radius` bins away, (…, V)."""
    below = F.pad(probability, (radius + 1, radius)).cumsum(-1)
    return below[..., 2 * radius + 1 :] - below[..., : probability.shape[-1]]


def save_early(folder: Path, early: EarlyDrafter, target_sha256: str, provenance: dict[str, Any]) -> str:
    """The description names the target by the hash of its weights, and the chunk (H) it drafts."""
    description = {
        "settings": asdict(early.settings),
        "target": target_sha256,
        "chunk": early.target.chunk,
        "provenance": provenance,
    }
    return save_module(folder, "early", early, description)


def read_early(folder: Path, target: Mapping[str, Any]) -> dict[str, Any]:
    """Its description. target: the target's description, as `load_target` returns it.

    Raises:
        CheckpointError: none there, a damaged one, one of another target or chunk.
    """
    if not (folder / "early.json").is_file():
        raise CheckpointError(f"no early drafter in {folder}: run 'kerv train drafter drafter=early policy.target=…'")
    description = read_description(folder, "early")
    try:
        trained, chunk = description["target"], description["chunk"]
    except KeyError as error:
        raise CheckpointError(f"{folder / 'early.json'} is not an early drafter's description: no {error}") from error
    if (trained, chunk) != (target["sha256"], target["settings"]["chunk"]):
        raise CheckpointError(
            f"the early drafter in {folder} was trained for target {trained[:12]} and chunks of {chunk}, not for "
            f"{target['sha256'][:12]} and {target['settings']['chunk']}: train one with "
            "'kerv train drafter drafter=early policy.target=…'"
        )
    return description


def load_early(folder: Path, target: Target, description: Mapping[str, Any]) -> tuple[EarlyDrafter, dict[str, Any]]:
    """The early drafter of `target`, ready for inference, and its own description; errors as `read_early`."""
    own = read_early(folder, description)
    try:
        early = EarlyDrafter(DrafterSettings(**own["settings"]), target.settings)
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / 'early.json'} is not an early drafter's description ({error})") from error
    load_state(early, folder, "early")
    weight = target.head.weight
    early = early.to(device=weight.device, dtype=weight.dtype).eval().requires_grad_(False)
    lay_out_for_inference(early)
    return early, own
