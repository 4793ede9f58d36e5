"""Evaluations that `lerobot-eval` ran: its `eval_info.json`, which holds successes and no times.

A file of several tasks has `per_task` (task_group, task_id and lists of metrics), one of a single task `per_episode`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_mapping
from kerv_cli.catalogue.vla_eval import Episode, Evaluation

FILE = "eval_info.json"
"""Name that lerobot-eval gives to its results."""
HARNESS = "lerobot-eval"


def read_info(path: Path) -> list[Evaluation]:
    """Return the evaluations of a file, one per group of tasks.

    The file names no policy, so a policy is called like the file's folder. Without a seed in the file an episode's
    number counts: lerobot-eval gives the episodes of every task the same seeds in order.

    Raises:
        CheckpointError: It is damaged, or holds no episode.
    """
    value = read_mapping(path)
    groups: dict[str, list[Episode]] = {}
    try:
        overall = value.get("overall") or value.get("aggregated") or {}
        seconds = float(overall.get("eval_ep_s") or 0.0)
        for one in value.get("per_task") or ():
            successes = one["metrics"]["successes"]
            task = f"task {one['task_id']}"
            episodes = [_episode(task, i, i, success, seconds) for i, success in enumerate(successes)]
            groups.setdefault(str(one["task_group"]), []).extend(episodes)
        if not groups:
            groups["lerobot"] = [_of_row(row, number, seconds) for number, row in enumerate(value["per_episode"])]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise CheckpointError(f"{path} is damaged or not of lerobot-eval ({why})") from error
    if not any(groups.values()):
        raise CheckpointError(f"{path} holds no episode: the evaluation ended before its first")
    name = path.resolve().parent.name
    return [_evaluation(path, name, group, episodes, overall) for group, episodes in groups.items() if episodes]


def _of_row(row: Mapping[str, Any], number: int, seconds: float) -> Episode:
    seed = row.get("seed")
    return _episode("task", number, number if seed is None else int(seed), row["success"], seconds)


def _episode(task: str, index: int, seed: int, success: Any, seconds: float) -> Episode:
    if not isinstance(success, bool | int | float) or math.isnan(success):
        raise ValueError(f"success {success!r} of episode {index}")
    return Episode(task, index, seed, bool(success), None, seconds, str(index), (float(seed),))


def _evaluation(
    path: Path, name: str, group: str, episodes: Sequence[Episode], overall: Mapping[str, Any]
) -> Evaluation:
    figures = {key: value for key, value in overall.items() if isinstance(value, int | float) and math.isfinite(value)}
    server = {"model_server": name}
    return Evaluation(path, f"{name} {group}", group, figures, server, tuple(episodes), len(episodes), HARNESS)
