"""Drafts of the scout (docs/methods.md §5.1): those of its early drafter's network, from what its own eyes see."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.artifacts import Weights, WeightsDescription
from kerv_cli.methods.context import Context
from kerv_cli.methods.early.drafter import EarlyProposer
from kerv_cli.methods.scout import ScoutSettings
from kerv_cli.methods.scout.network import Scout
from kerv_cli.targets.compact.target import CompactTarget


class ScoutProposer(EarlyProposer):
    """The scout's chunk, drafted once per observation, without the target's encoder."""

    name = "scout"

    def __init__(self, scout: Scout, target: CompactTarget) -> None:
        super().__init__(scout.drafter, target)
        self.scout, self.inputs = scout, target.inputs

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> ScoutProposer:
        """proposer=scout."""
        return cls(context.artifact("scout"), context.target)

    @torch.inference_mode()
    def features(self, chunk: Chunk) -> Tensor:
        """What the network reads of the chunk's observation, (1, F)."""
        assert chunk.observation is not None
        return self.scout.see(self.inputs(chunk.observation))[0]


@dataclass(frozen=True, kw_only=True)
class ScoutDescription(WeightsDescription):
    """A scout's JSON."""

    settings: ScoutSettings


class ScoutArtifact(Weights[ScoutDescription]):
    """The scout's files."""

    kind, noun = "scout", "scout"
    command = ("train", "drafter", "drafter=scout")
    schema = ScoutDescription

    def module(self, description: ScoutDescription, target: ReadableTarget) -> Scout:
        """A fresh scout, which looks through the target's camera.

        Raises:
            CheckpointError: as `check_sees`.
        """
        return Scout.beside(description.settings, check_sees(target))


def check_sees(target: object) -> CompactTarget:
    """The target, if it sees.

    Raises:
        CheckpointError: it is of another family, or is given the state.
    """
    if not isinstance(target, CompactTarget) or not target.cameras:
        raise CheckpointError("a scout looks through the camera of a compact target that sees; this target has none")
    return target
