"""Records that look like those of real episodes, made up from a seed; no world, no model."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kerv_cli.base.registry import find
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord, Round
from kerv_cli.episodes.identity import Setting, without
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database, opened
from kerv_cli.lab.plan import all_episodes
from kerv_cli.lab.store import Study
from kerv_cli.lab.study import Plan, is_elsewhere, plan_study, save
from kerv_cli.lab.work import OnEvent, Outcome, Prepare, RunEpisode, follow
from kerv_cli.lab.workers import begun, workers
from kerv_cli.worlds import settled
from kerv_cli.worlds.metaworld.spec import SPEC

TOKENS = 16
IDENTITY = {"target": "a" * 64, "drafter": "b" * 64}


def settings_of(method: str, r: int = 0, episodes: int = 4) -> RolloutSettings:
    settings = RolloutSettings(method=method, episodes=episodes)
    settings.world = settled(settings.world, ["reach"])
    settings.proposer = part("proposer", "none" if method == "ar" else "drafter")
    settings.acceptance = part("acceptance", "relaxed" if r else "strict")
    settings.threshold.r = r
    return settings


def part(kind: str, name: str, **values: Any) -> Any:
    """Settings of a registered part."""
    return find(kind, name).settings(kind=name, **values)


def still_episode(task: str, seed: int, success: bool, decodes: Sequence[DecodeRecord], each: int = 1) -> EpisodeRecord:
    """An episode in which nothing moves, with `each` control steps per decode: for what is measured of its decodes."""
    steps = each * len(decodes)
    return EpisodeRecord(
        environment=SPEC.name,
        space=SPEC.actions,
        task=task,
        instruction="reach the goal",
        seed=seed,
        success=success,
        steps=steps,
        decodes=tuple(decodes),
        decode_steps=tuple(range(0, steps, each)),
        actions=np.zeros((steps, 4), np.float32),
        path=np.zeros((steps + 1, 3), np.float32),
        gripper=np.zeros(steps + 1, np.float32),
        initial_state=np.array([float(seed)]),
        wall_seconds=1.0,
    )


def study_of(
    settings: Mapping[str, RolloutSettings],
    tasks: Sequence[str],
    name: str = "threshold",
    block: int = 5,
    **about: Any,
) -> Study:
    """A study of these settings, by label; `ar` is the baseline. `planned` puts it into a database."""
    made = tuple(
        Setting(
            label,
            tuple(f"method={label.replace(' ', ' threshold.')}".split()),
            without(asdict(one), {"task"}),
            IDENTITY,
            name=" ".join(word for word in label.split() if "=" not in word),
        )
        for label, one in settings.items()
    )
    about = {"baseline": "ar", "title": "Acceptance threshold", "axis": "threshold.r"} | about
    episodes = all_episodes(made, tasks, block)
    return Study(Database("nowhere"), name, "sweep", made, episodes, block=block, **about)


def planned(database: Database, study: Study, *arguments: Any, **options: Any) -> Plan:
    """What a database has of a study, and what is missing."""
    return plan_study(replace(study, database=database), *arguments, **options)


def threshold_study(
    tasks: Sequence[str], episodes: int = 4, radii: tuple[int, ...] = (3, 9), name: str = "threshold", **about: Any
) -> Study:
    settings = {"ar": settings_of("ar", episodes=episodes), "naive_sd": settings_of("naive_sd", episodes=episodes)}
    settings |= {f"spec_vla r={r}": settings_of("spec_vla", r, episodes) for r in radii}
    return study_of(settings, tasks, name, **about)


def swept(
    results: Path | str,
    study: Study,
    prepare: Prepare | None = None,
    rerun: str = "never",
    runtime: RuntimeSettings | None = None,
    on_event: OnEvent = lambda event: None,
    words: Sequence[str] = (),
) -> tuple[Study, Outcome]:
    """Runs what the database of a results folder lacks of a study. `words`: what the command names besides it."""
    command = ["sweep", f"study={study.name}", *words]
    plan = planned(opened(results), study, rerun, runtime=runtime, command=command)
    prepare = prepare or episodes_of
    # variables of a process are set for its worker processes alone: two threads that sweep would restore each other's
    in_others = is_elsewhere(plan.runtime) or plan.runtime.workers > 1
    with begun(plan) as record, pretending(prepare) if in_others else contextlib.nullcontext():
        save(plan, record.id)
        with workers(plan, record.id) as tend:
            return plan.study, follow(plan, record, tend, prepare, on_event)


@contextlib.contextmanager
def pretending(prepare: Prepare, **environment: str) -> Iterator[None]:
    """Let `kerv work`, started in this `with` block, call a function of this module for every setting of a block."""
    path = os.pathsep.join(one for one in sys.path if one)
    environment |= {
        "KERV_PLUGINS": "pretended_worker",
        "PRETENDED": getattr(prepare, "__name__", ""),
        "PYTHONPATH": path,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


def generator(*parts: object) -> np.random.Generator:
    digest = hashlib.sha256(repr(parts).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


def episode(setting: Setting, task: str, seed: int) -> EpisodeRecord:
    """An episode: higher r, longer acceptance, a little less success."""
    world = generator(task, seed)
    initial_state, difficulty = world.uniform(size=3), world.uniform()
    rng = generator(task, seed, setting.label)
    r = setting.settings["threshold"].get("r", 9)
    slow = setting.settings["method"] == "ar"
    decodes = [ar_decode(rng) if slow else draft_decode(rng, r) for _ in range(rng.integers(12, 25))]
    return replace(
        still_episode(task, seed, bool(difficulty < 0.9 - 0.015 * max(0, r - 5)), decodes, 4),
        initial_state=initial_state,
        closest_approach=0.04 * difficulty,
        object_moved=0.02,
        wall_seconds=2.0 * sum(d.seconds for d in decodes),
    )


def decode_of(rounds: list[Round], phases: dict[str, float], mode: str) -> DecodeRecord:
    return DecodeRecord(
        tokens=tuple(range(TOKENS)),
        actions=np.full((4, 4), 0.25, np.float32),
        forwards=len(rounds),
        rounds=tuple(rounds),
        mode=mode,
        seconds=sum(phases.values()),
        phases=phases,
    )


def ar_decode(rng: np.random.Generator) -> DecodeRecord:
    rounds = [Round("decode" if i else "prefill", "none", i, (), (i,), 0, 1, 0, ()) for i in range(TOKENS)]
    noise = rng.lognormal(0, 0.1)
    phases = {"vision": 0.005, "prefill": 0.012 * noise, "verify": 0.045 * noise, "other": 0.001}
    return decode_of(rounds, phases, "ar")


def draft_decode(rng: np.random.Generator, r: int) -> DecodeRecord:
    rounds, committed = [Round("prefill", "none", 0, (), (0,), 0, 1, 0, ())], 1
    while committed < TOKENS:
        depth = min(5, TOKENS - committed)
        accepted = min(depth, int(rng.binomial(5, 0.45 + 0.03 * min(r, 15))))
        gain = min(accepted + 1, TOKENS - committed)
        drafted = tuple(range(min(depth, accepted + 1)))
        rounds.append(Round("verify", "drafter", committed, drafted, drafted, accepted, gain, 24, (r, r, r, 0)))
        committed += gain
    noise, cycles = rng.lognormal(0, 0.1), len(rounds) - 1
    phases = {"vision": 0.005, "prefill": 0.012 * noise, "propose": 0.0015 * cycles}
    phases |= {"verify": 0.0055 * cycles * noise, "accept": 0.0004 * cycles, "other": 0.0008}
    return replace(decode_of(rounds, phases, "drafter"), variability=float(rng.uniform()))


def episodes_of(setting: Setting, task: str) -> RunEpisode:
    """What a sweep calls for every setting of a block."""
    return lambda seed: episode(setting, task, seed)


def slowly(setting: Setting, task: str, seconds: float) -> RunEpisode:
    """So many seconds for each episode."""

    def run(seed):
        time.sleep(seconds)
        return episode(setting, task, seed)

    return run


def unhurried(setting: Setting, task: str) -> RunEpisode:
    """A tenth of a second for each episode."""
    return slowly(setting, task, 0.1)


def brisk(setting: Setting, task: str) -> RunEpisode:
    """A hundredth of a second for each episode."""
    return slowly(setting, task, 0.01)


def slow_elsewhere(setting: Setting, task: str) -> RunEpisode:
    """The first task at once, every other in a minute."""
    return slowly(setting, task, 0.0 if task == "reach-v3" else 60.0)


def mortal(setting: Setting, task: str) -> RunEpisode:
    """Kills its process in the seventh episode that it begins."""

    def run(seed):
        _begun.append(seed)
        if len(_begun) == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return episode(setting, task, seed)

    return run


_begun: list[int] = []


def struck_at_the_third(setting: Setting, task: str, number: int) -> RunEpisode:
    """Sends its process a signal in an episode."""

    def run(seed):
        if (setting.label, seed) == ("ar", 100_002):
            os.kill(os.getpid(), number)
        return episode(setting, task, seed)

    return run


def stops(setting: Setting, task: str) -> RunEpisode:
    """Stops its process in an episode, until somebody lets it go on."""
    return struck_at_the_third(setting, task, signal.SIGSTOP)


def killed_at_the_third(setting: Setting, task: str) -> RunEpisode:
    return struck_at_the_third(setting, task, signal.SIGKILL)


def points_of(figure: Any) -> list[Any]:
    """The points of each panel of a chart, as a browser gets them."""
    import pandas as pd

    spec = figure.to_dict()
    held = [
        next(one["data"] for one in (panel["layer"][-1], panel, spec) if "name" in one.get("data", {}))
        for panel in spec["concat"]
    ]
    return [pd.DataFrame(spec["datasets"][data["name"]]) for data in held]
