"""Executes recorded sequences of forwards on a model of another shape."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from kerv_cli.bench.machine import synchronise
from kerv_cli.bench.model import Model
from kerv_cli.bench.phases import Stage
from kerv_cli.bench.sequences import Recorded
from kerv_cli.engine.cost import DRAFTER, DecodeSequence, Forward
from kerv_cli.engine.tree import TokenTree, visible_in_verification
from kerv_cli.engine.unread import Unread
from kerv_cli.methods.eagle.drafter import draft_tree

_SPARE = 8


class Player:
    """Plays decodes of recorded settings; `stage` holds the model's caches."""

    def __init__(self, model: Model, recorded: Sequence[Recorded]) -> None:
        """Allocates caches that hold the largest draft of the settings."""
        forwards = [f for setting in recorded for s in setting.sequences for f in s.forwards]
        most = max((f.start + f.drafted for f in forwards), default=1)
        wide = max((_tree(setting.proposer)[0] * _tree(setting.proposer)[1] for setting in recorded), default=0)
        self.model, self.stage = model, Stage(model, most + wide + _SPARE)

    @torch.inference_mode()
    def play(self, decode: DecodeSequence, proposer: Mapping[str, Any]) -> float:
        """Seconds of the decode's forwards and drafts on the model, the prompt's encoding included, and its recorded
        host seconds."""
        device = self.stage.device
        synchronise(device)
        began = time.perf_counter()
        self.stage.encode()
        for number, forward in enumerate(decode.forwards):
            last = number + 1 == len(decode.forwards)
            self._forward(forward, proposer, last)
            if decode.drafts and number + 1 < len(decode.forwards):
                self._feed(forward)
        synchronise(device)
        return time.perf_counter() - began + decode.host

    def _forward(self, forward: Forward, proposer: Mapping[str, Any], last: bool) -> None:
        stage, count, drafted = self.stage, forward.drafted, None
        if forward.proposer == DRAFTER:
            drafted = self._draft(forward, proposer)
            count = len(drafted)
        if forward.kind == "prefill":
            stage.prefill(count)
        else:
            # as in a decode: a draft is read with the target's tokens; without a proposer all tokens behind the last
            reads = last or proposer.get("kind") != "none"
            seen, beside = None, None
            if isinstance(drafted, Unread):
                seen, beside = drafted.seen(1), drafted.numbers
            elif drafted is not None:
                seen = visible_in_verification(drafted)
            stage.verify(count, forward.start, seen, beside, reads)
        if count:
            first = stage.length + forward.start - (forward.kind == "verify")
            committed = forward.accepted + (forward.kind == "verify")
            if isinstance(drafted, TokenTree) or (drafted is not None and drafted.visible is not None):
                stage.cache.compact(first, torch.arange(first, first + committed, device=stage.device))
            stage.cache.length = first + committed

    def _draft(self, forward: Forward, proposer: Mapping[str, Any]) -> TokenTree | Unread:
        depth, top_k = _tree(proposer)
        state, stage = self.stage.draft_state, self.stage
        state.cache.length = stage.length + forward.start - 1
        depth = min(depth, forward.drafted)
        return draft_tree(self.model.drafter, stage.target, state, depth, top_k, forward.drafted)

    def _feed(self, forward: Forward) -> None:
        if forward.kind == "prefill":
            self.stage.feed(self.stage.hidden[:, : self.stage.length], 0)
        else:
            states = self.stage.hidden[:, : forward.accepted + 1]
            self.stage.feed(states, self.stage.length + forward.start - 1)


def _tree(proposer: Mapping[str, Any]) -> tuple[int, int]:
    """Depth and children per level of a setting's drafter; 0, 0 without one."""
    return int(proposer.get("depth") or 0), int(proposer.get("top_k") or 0)


def play_all(player: Player, recorded: Sequence[Recorded]) -> np.ndarray:
    """(settings, decodes) seconds; the settings take turns decode by decode, each turn begins with another one.
    Settings with fewer decodes begin again."""
    count = max(len(setting.sequences) for setting in recorded)
    for setting in recorded:
        player.play(setting.sequences[0], setting.proposer)  # first calls choose kernels
    seconds = np.empty((len(recorded), count))
    for i in range(count):
        for turn in range(len(recorded)):
            index = (turn + i) % len(recorded)
            setting = recorded[index]
            seconds[index, i] = player.play(setting.sequences[i % len(setting.sequences)], setting.proposer)
    return seconds
