"""Made-up episodes for the Rerun tests: every kind of round, without a simulator or a model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from studies_synthetic import still_episode

from kerv_cli.engine.record import PHASES, DecodeRecord, EpisodeRecord, Round
from kerv_cli.report.viewing.viewer import read_chunks

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


def ar_decode(random: np.random.Generator, chunk: int = 4) -> DecodeRecord:
    tokens = tuple(int(t) for t in random.integers(0, 255, chunk * DOFS))
    later = (Round("decode", "none", i, (), (t,), 0, 1, 0, ()) for i, t in enumerate(tokens[1:], 1))
    return decode_of(tokens, (prefill(tokens[0]), *later), chunk, mode="ar")


def drafted_decode(random: np.random.Generator, chunk: int = 4, compensate: bool = False) -> DecodeRecord:
    """Drafts of up to five tokens against random target_tokens; a rejection ends a round, and maybe the chunk."""
    size = chunk * DOFS
    targets = random.integers(20, 235, size)
    tokens, rounds, compensated = [int(targets[0])], [prefill(int(targets[0]))], 0
    variability = 0.0
    while len(tokens) < size:
        start = len(tokens)
        depth = min(5, size - start - 1)
        if depth == 0:
            rounds.append(Round("decode", "none", start, (), (int(targets[start]),), 0, 1, 0, ()))
            tokens.append(int(targets[start]))
            continue
        off = random.choice([0, 0, 0, 0, 3, -6, 25], depth)
        limits = [0 if (start + i) % DOFS == 3 else 9 for i in range(depth)]
        accepted = next((i for i in range(depth) if abs(off[i]) > limits[i]), depth)
        judged = min(accepted + 1, depth)
        drafted = tuple(int(targets[start + i] + off[i]) for i in range(judged))
        seen = tuple(int(v) for v in targets[start : start + (judged if accepted < depth else depth + 1)])
        rounds.append(verify(start, drafted, seen, accepted))
        tokens += [*drafted[:accepted], int(targets[start + accepted])]
        variability += float(np.abs(off[:judged]).sum()) / 128
        if accepted < depth and compensate:
            compensated = -len(tokens) % DOFS
            break
    return decode_of(
        tuple(tokens),
        tuple(rounds),
        (len(tokens) + compensated) // DOFS,
        size=size,
        variability=variability,
        compensated=compensated,
        mode="compensate" if compensated else "drafter",
        metric=float(random.random()),
    )


def skipped_decode(random: np.random.Generator, chunk: int = 4) -> DecodeRecord:
    tokens = tuple(int(t) for t in random.integers(0, 255, chunk * DOFS))
    played = Round("skip", "retrieval", 0, tokens, (), len(tokens), len(tokens), 0, ())
    similarity = float(0.97 + 0.02 * random.random())
    return decode_of(tokens, (played,), chunk, mode="skip", forwards=0, skipped=True, similarity=similarity, metric=0.9)


def episode(kind: str, horizon: int = 60, chunk: int = 4, frames: int = 0, seed: int = 0) -> EpisodeRecord:
    """kind: `ar`, `drafter`, `mixed` (drafter, compensation, verify-skip). frames: side in pixels, 0 for none."""
    random = np.random.default_rng(seed)
    decodes, starts, actions, step = [], [], [], 0
    while step < horizon:
        if kind == "ar":
            decode = ar_decode(random, chunk)
        elif kind == "mixed" and len(decodes) % 7 in (3, 4):
            decode = skipped_decode(random, chunk)
        else:
            decode = drafted_decode(random, chunk, compensate=kind == "mixed")
        decodes.append(decode)
        starts.append(step)
        actions += list(decode.actions[: horizon - step])
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
