"""A round waits for the device once, for every family of proposers; and what a stopwatch on a device measures."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np
import pytest
import torch
from pretended_device import DEVICE, Device, move
from test_decoding_lossless import random_prompt, random_target
from test_proposers import HELD, D, moved, retrieval_of, stored

from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.decoder import Decoder, Parts, Stopwatch
from kerv_cli.engine.record import PHASES
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer, EagleNetwork
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyDrafter
from kerv_cli.methods.early.network import EarlyProposer
from kerv_cli.methods.heisd import Always, HybridProposer
from kerv_cli.methods.kerv.prediction import Hold, Kalman, Noise, PredictionProposer
from kerv_cli.methods.merged import MergedProposer
from kerv_cli.methods.reuse import JacobiProposer, JacobiProposerSettings
from kerv_cli.targets.compact.trunk import LayerStack

CHUNK = 2


def parts_of(family: str, target: Any, prompt: torch.Tensor, truth: list[int]) -> Parts:
    """Untrained drafters and a few stored chunks, one of them right at first: there are rejections and rounds."""
    wrong = np.array([truth] * 3)
    wrong[:, 3:] = (wrong[:, 3:] + [[1], [2], [0]]) % 255
    retrieval = retrieval_of(stored(target, prompt, wrong), target, 3, 24)
    torch.manual_seed(1)
    drafter = EagleDrafter().network(DrafterSettings(), target).eval().requires_grad_(False)
    network = EarlyDrafter().network(EarlySettings(width=16, layers=1, rank=4), target).eval()
    chain, tree = (DrafterProposer(drafter, target, *sizes) for sizes in ((5, 1, 5), (3, 4, 9)))
    early = EarlyProposer(network.requires_grad_(False), target)
    hold = PredictionProposer(Hold(HELD, minimum=1, horizon=CHUNK))
    kalman = PredictionProposer(Kalman(HELD, Noise(*2 * [(1.0,) * D]), horizon=CHUNK))
    both = HybridProposer(chain, retrieval)
    merged = MergedProposer([early], 48, [hold, kalman])
    return {
        "ar": Parts(),
        "chain": Parts(proposer=chain),
        "tree": Parts(proposer=tree),
        "jacobi": Parts(proposer=JacobiProposer(JacobiProposerSettings())),
        "hold": Parts(proposer=hold),
        "kalman": Parts(proposer=kalman),
        "retrieval": Parts(proposer=retrieval),
        "hybrid, drafter": Parts(proposer=both, boundary=Always(NoSettings("always_drafter"))),
        "hybrid, retrieval": Parts(proposer=both, boundary=Always(NoSettings("always_retrieval"))),
        "hold in the prefill": Parts(prefill_draft=hold),
        "early": Parts(prefill_draft=early),
        "merged": Parts(prefill_draft=merged),
        "merged, then chain": Parts(prefill_draft=merged, proposer=chain),
    }[family]


FAMILIES = (
    "ar", "chain", "tree", "jacobi", "hold", "kalman", "retrieval", "hybrid, drafter", "hybrid, retrieval",
    "hold in the prefill", "early", "merged", "merged, then chain",
)  # fmt: skip


def members(parts: Parts) -> list[Any]:
    """The parts of a method that draft, and those that they are made of."""
    found: list[Any] = [parts.prefill_draft, parts.proposer]
    for part in found:
        found += [*getattr(part, "sources", ()), *getattr(part, "proposers", {}).values()]
    return found


def modules(parts: Parts) -> list[torch.nn.Module]:
    """The networks of a method."""
    networks = [getattr(part, name, None) for part in members(parts) for name in ("drafter", "early")]
    return [network for network in networks if isinstance(network, torch.nn.Module)]


CASES = [
    (family, captured) for family in FAMILIES for captured in (False, family in ("ar", "tree", "merged, then chain"))
]


@pytest.mark.bits
@pytest.mark.parametrize(("family", "captured"), dict.fromkeys(CASES))
def test_a_round_waits_once(family, captured, monkeypatch):
    """And the tokens are those of the host, draft for draft: the same rounds."""
    target = random_target(2, 1, 2, CHUNK)
    prompt = random_prompt(target, 2)
    truth = Decoder(target).decode_prompt(prompt).tokens
    on_host = Decoder(target, parts_of(family, target, prompt, truth))
    moved(on_host, np.random.default_rng(0), 8)
    wanted = on_host.decode_prompt(prompt)
    assert wanted.tokens == truth
    parts = parts_of(family, target, prompt, truth)
    monkeypatch.setattr(EagleNetwork, "new_cache", functools.partialmethod(LayerStack.new_cache, fixed=captured))
    target.new_cache = functools.partial(target.new_cache, fixed=captured)  # type: ignore[method-assign]
    for module in (target, *modules(parts)):
        move(module)
    with torch.inference_mode(), Device() as device:
        for part in members(parts):  # their target is there now
            if isinstance(part, DrafterProposer):
                part.cache = part.drafter.new_cache(1, part.cache.capacity)
        decoder = Decoder(target, parts)
        waits: list[int] = []

        def counted(work):
            def run(*arguments):
                before = len(device.waits)
                result = work(*arguments)
                waits.append(len(device.waits) - before)
                return result

            return run

        for name in ("round", "decode_plainly"):
            monkeypatch.setattr(decoder, name, counted(getattr(decoder, name)))
        moved(decoder, np.random.default_rng(0), 8)
        found = decoder.decode_prompt(prompt.to(DEVICE, non_blocking=True))
    assert found.tokens == truth
    assert found.rounds == wanted.rounds
    assert len(found.rounds) > 1
    assert max(waits) == (2 if family.startswith(("early", "merged", "retrieval", "hybrid, retrieval")) else 1), (
        device.waits
    )
    assert sum(waits) == len(device.waits), "waits outside of the rounds"
    alone = parts.proposer is None  # what is left is then read at once
    assert len(waits) == (2 if alone else len(found.rounds))


# --- stopwatch


class Event:
    """Stands in for a CUDA event: the host's time when it was recorded."""

    def __init__(self, enable_timing: bool) -> None:
        assert enable_timing

    def record(self) -> None:
        """Notes the time."""
        self.at = time.perf_counter()

    def elapsed_time(self, later: Event) -> float:
        """Milliseconds."""
        return 1000.0 * (later.at - self.at)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_phases_add_up_to_the_decode(device, monkeypatch):
    waits: list[str] = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waits.append("wait"))
    monkeypatch.setattr(torch.cuda, "Event", Event)
    clock = Stopwatch(torch.device(device))
    for phase in ("vision", "prefill", "verify", "verify"):
        time.sleep(0.002)
        clock.lap(phase)
    seconds = clock.stop()
    assert len(waits) == (2 if device == "cuda" else 0)
    assert set(clock.phases) == set(PHASES)
    assert sum(clock.phases.values()) == pytest.approx(seconds, abs=1e-4)
    assert clock.phases["verify"] >= 0.004 > clock.phases["other"]
