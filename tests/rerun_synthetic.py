"""Made-up episodes for the Rerun tests: every kind of round, without a simulator or a model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mock_target import MockTarget
from studies_synthetic import still_episode
from test_accepted_loop import Greedy, NearTrees

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.record import PHASES, DecodeRecord, EpisodeRecord, Round
from kerv_cli.methods.kerv import CompensateSettings, Compensation
from kerv_cli.methods.kerv.prediction import Hold, PredictionProposer
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.methods.unverified import AlwaysSkip
from kerv_cli.report.viewing.viewer import read_chunks
from kerv_cli.worlds.metaworld.spec import SPEC

DOFS = 4


def read_recording(path: Path) -> dict[str, Any]:
    """Its blueprint, the episode's facts, entities -> rows, and timelines -> first and last."""
    reader, chunks = read_chunks(path)
    episode: dict[str, Any] = {}
    entities: dict[str, int] = {}
    times: dict[str, list[int]] = {}
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/__properties/episode":
            episode = {f.name: batch[f.name][0].as_py()[0] for f in batch.schema if not f.name.startswith("rerun.")}
        elif not chunk.entity_path.startswith("/__properties"):
            rows = 0 if chunk.is_static else chunk.num_rows
            entities[chunk.entity_path] = entities.get(chunk.entity_path, 0) + rows
            for timeline in ("step", "time") if rows else ():
                times.setdefault(timeline, []).extend(batch[timeline].cast("int64").to_pylist())
    timelines = {timeline: (min(values), max(values)) for timeline, values in times.items()}
    return {"blueprint": reader.blueprints(), "episode": episode, "entities": entities, "timelines": timelines}


def prefill(token: int) -> Round:
    return Round("prefill", "none", 0, (), (token,), 0, 1, 0, ())


def verify(
    start: int,
    drafted: tuple[int, ...],
    target_tokens: tuple[int, ...],
    accepted: int,
    r: tuple[int, ...] = (9, 9, 9, 0),
) -> Round:
    return Round("verify", "drafter", start, drafted, target_tokens, accepted, accepted + 1, 20, r)


def decode_of(tokens: tuple[int, ...], rounds: tuple[Round, ...], steps: int, **extra: object) -> DecodeRecord:
    seconds = 0.004 + 0.002 * len(rounds)
    values = {
        "tokens": tokens,
        "actions": np.linspace(-1, 1, steps * DOFS, dtype=np.float32).reshape(steps, DOFS),
        "forwards": len(rounds),
        "rounds": rounds,
        "mode": "drafter",
        "seconds": seconds,
        "phases": dict.fromkeys(PHASES, seconds / len(PHASES)),
        **extra,
    }
    return DecodeRecord(**values)  # type: ignore[arg-type]


def episode(kind: str, horizon: int = 60, frames: int = 0, seed: int = 0) -> EpisodeRecord:
    """Decodes of a target that is no network. kind: `ar`, `drafter`, `mixed` (drafts, compensations, skips).
    frames: side in pixels, 0 for none."""
    target, space = MockTarget(SPEC.actions, 4, seed=seed), SPEC.actions
    drafts = NearTrees(Greedy(target, torch.zeros(1, 0, 8)), "drafter", seed, 20, 12)
    whole = PredictionProposer(Hold(space.is_strict, minimum=1, horizon=4))
    rectifier = Compensation(CompensateSettings(), Hold(space.is_strict, minimum=1)) if kind == "mixed" else None
    proposer = None if kind == "ar" else drafts
    usual = Decoder(target, Parts(RelaxedRule(space), Fixed(9), proposer=proposer, rectifier=rectifier))
    skipping = Decoder(target, Parts(prefill_draft=whole, skip=AlwaysSkip(whole)))
    decodes, starts, actions, step = [], [], [], 0
    for decoder in (usual, skipping):
        decoder.reset("drawer-open-v3", 7, np.zeros(3))
    while step < horizon:
        seen = Observation(np.array([0.1 * step]), np.zeros(0), "open the drawer")
        drafts.greedy = Greedy(target, target.encode(seen))
        decoder = skipping if kind == "mixed" and len(decodes) % 7 in (3, 4) else usual
        decodes.append(decoder.decode(seen))
        starts.append(step)
        for action in decodes[-1].actions[: horizon - step]:
            actions.append(action)
            for one in (usual, skipping):
                one.observe(action, np.zeros(3))
        step = len(actions)
    angle = np.linspace(0, 4, step + 1)
    path = np.stack([0.1 * np.cos(angle), 0.6 + 0.1 * np.sin(angle), 0.05 + 0.04 * angle], axis=1)
    pictures = {}
    if frames:
        rows = np.linspace(0, 255, frames).astype(np.uint8)
        base = np.stack([np.broadcast_to(rows, (frames, frames)), np.broadcast_to(rows[:, None], (frames, frames))], -1)
        for i in range(step + 1):
            pictures[i] = np.concatenate([base, np.full((frames, frames, 1), i % 256, np.uint8)], axis=2)
    return replace(
        still_episode("drawer-open-v3", 7, True, decodes),
        instruction="open the drawer",
        steps=step,
        decode_steps=tuple(starts),
        actions=np.stack(actions).astype(np.float32),
        path=path.astype(np.float32),
        gripper=(0.5 + 0.5 * np.cos(angle)).astype(np.float32),
        frames=pictures,
    )
