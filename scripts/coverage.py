"""How often the 95 % intervals of the tables contain the truth, by simulation: `python scripts/coverage.py [STUDIES]`.

A simulated study has ten tasks, or one, and blocks of five seeds. Tasks differ in time,
speedup and success. The speedup of a block is off by 8 % (the machine's state), that of a pair by 5 %; episodes
that fail run to the horizon.
Prints coverage in per cent, a row per interval and a column per number of blocks per task. Then the same of three runs,
each with seeds of its own: a run's speedup is off by 8 %, in all tasks together.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from kerv_cli.report import statistics as stats
from kerv_cli.report.statistics import Estimate

BLOCKS = (1, 2, 4, 10, 50)
SEEDS_OF_RUNS = (1, 2, 5)
SEEDS, DRIFT, NOISE, HORIZON = 5, 0.08, 0.05, 500
Drawn = tuple[Estimate, float]
"""An interval and the truth."""


class Tasks:
    """What is true of the tasks of a study. Arrays (tasks,); lost, won: rates of the two kinds of discordant pairs."""

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(count)
        self.count = count
        self.seconds, self.speedup = random.lognormal(0, 0.3, count), 2 * random.lognormal(0, 0.15, count)
        self.steps = random.lognormal(4.4, 0.4, count)
        self.lost, self.won = random.uniform(0.01, 0.06, count), random.uniform(0.01, 0.04, count)
        self.neither = random.uniform(0.0, 0.1, count)


class Study:
    """A simulated study of `blocks` blocks per task. Arrays (pairs,), except those of the tasks.

    `run` is the factor of the run on every speedup.
    """

    def __init__(
        self, tasks: Tasks, blocks: int, random: np.random.Generator, run: float = 1.0, seeds: int = SEEDS
    ) -> None:
        per_task = blocks * seeds
        self.tasks, n = tasks, tasks.count * per_task
        self.task = np.repeat(np.arange(tasks.count), per_task)
        self.block = np.repeat(np.arange(tasks.count * blocks), seeds)
        self.seed = np.tile(np.arange(per_task), tasks.count)
        u, t = random.random(n), tasks
        lost, won, neither = t.lost[self.task], t.won[self.task], t.neither[self.task]
        self.method = (u >= lost) & (u < 1 - neither)
        self.baseline = (u < lost) | ((u >= lost + won) & (u < 1 - neither))
        drift = random.lognormal(-(DRIFT**2) / 2, DRIFT, tasks.count * blocks)[self.block] * run
        self.step_method = t.seconds[self.task] * random.lognormal(-(NOISE**2) / 2, NOISE, n)
        noise = random.lognormal(-(NOISE**2) / 2, NOISE, n)
        self.step_baseline = t.seconds[self.task] * t.speedup[self.task] * drift * noise
        world = t.steps[self.task] * random.lognormal(-0.02, 0.2, n)
        self.steps_baseline = np.where(self.baseline, world * random.lognormal(-0.005, 0.1, n), HORIZON)
        self.steps_method = np.where(self.method, world * random.lognormal(-0.005, 0.1, n), HORIZON)

    def micro(self, of_task: np.ndarray) -> float:
        """Mean over tasks, which have as many episodes."""
        return float(of_task.mean())

    def names(self, of: np.ndarray) -> list[str]:
        """Numbers as names."""
        return [str(number) for number in of]


def success(study: Study) -> Estimate:
    """Success of the method with Wilson's interval."""
    return stats.wilson(int(study.method.sum()), study.method.size)


def difference(study: Study) -> Estimate:
    """Paired difference with Newcombe's interval."""
    outcomes = np.bincount(3 - 2 * study.baseline - study.method, minlength=4).tolist()
    return stats.paired_difference(stats.PairedCounts(*outcomes))


def speedup(study: Study, per_episode: bool) -> Drawn:
    """Ratio of mean times, and its truth."""
    t = study.tasks
    times = [study.step_baseline, study.step_method]
    means = [t.seconds * t.speedup, t.seconds]
    if per_episode:
        times = [times[0] * study.steps_baseline, times[1] * study.steps_method]
        fails = (t.won + t.neither, t.lost + t.neither)
        means = [mean * (t.steps * (1 - f) + HORIZON * f) for mean, f in zip(means, fails, strict=True)]
    return stats.speedup(*times, study.names(study.task), study.names(study.block)), float(
        means[0].sum() / means[1].sum()
    )


def intervals(study: Study) -> dict[str, Drawn]:
    """Every interval of a table."""
    t = study.tasks
    return {
        "success, Wilson": (success(study), study.micro(1 - t.lost - t.neither)),
        "difference, Newcombe": (difference(study), study.micro(t.won - t.lost)),
        "speedup per step": speedup(study, False),
        "speedup per episode": speedup(study, True),
    }


def coverage(tasks: int, blocks: int, studies: int, seed: int = 0) -> dict[str, float]:
    """Interval -> share of simulated studies in which it contains the truth; studies without it do not count."""
    random, truth = np.random.default_rng([seed, tasks, blocks]), Tasks(tasks)
    inside: dict[str, list[bool]] = {}
    for _ in range(studies):
        for name, (found, true) in intervals(Study(truth, blocks, random)).items():
            if not np.isnan(found.low):
                inside.setdefault(name, []).append(found.low <= true <= found.high)
    return {name: float(np.mean(hits)) for name, hits in inside.items()}


def coverage_of_runs(runs: int, blocks: int, studies: int, per_episode: bool) -> float:
    """Share of simulated studies whose interval over runs contains the truth. Each run has `blocks` seeds per task."""
    random, truth, inside = np.random.default_rng([runs, blocks]), Tasks(10), 0
    for _ in range(studies):
        drifts = random.lognormal(-(DRIFT**2) / 2, DRIFT, runs)
        drawn = [speedup(Study(truth, blocks, random, drift, seeds=1), per_episode) for drift in drifts]
        found = stats.over_runs([estimate for estimate, _ in drawn], same_pairs=False)
        inside += found.low <= drawn[0][1] <= found.high
    return inside / studies


def main(words: Sequence[str]) -> None:
    """Prints the tables."""
    studies = int(words[0]) if words else 1000
    for tasks in (10, 1):
        table = {blocks: coverage(tasks, blocks, studies) for blocks in BLOCKS}
        print(f"{tasks} task{'s' * (tasks > 1)}, {studies} studies; blocks of {SEEDS} seeds per task:", *BLOCKS)
        for name in table[BLOCKS[-1]]:
            row = [f"{100 * table[blocks].get(name, np.nan):5.1f}" for blocks in BLOCKS]
            print(f"  {name:28}", *row)
    for runs in (3, 5):
        print(f"10 tasks, {runs} runs with seeds of their own; seeds per task in a run:", *SEEDS_OF_RUNS)
        for per_episode in (False, True):
            row = [f"{100 * coverage_of_runs(runs, seeds, studies, per_episode):5.1f}" for seeds in SEEDS_OF_RUNS]
            print(f"  {'speedup per episode' if per_episode else 'speedup per step':28}", *row)


if __name__ == "__main__":
    main(sys.argv[1:])
