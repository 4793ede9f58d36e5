"""Reads evaluations that `lerobot-eval` ran: its `eval_info.json`, which has successes but no times.

A file with several tasks has `per_task` (task_group, task_id and lists of metrics), one with a single task
`per_episode`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_mapping
from kerv_cli.catalogue.vla_eval import Evaluation, RecordedEpisode

FILE = "eval_info.json"
"""Name of lerobot-eval's results."""


def read_info(path: Path) -> list[Evaluation]:
    """Return the evaluations of a file, one per group of tasks.

    The file does not name the policy, so its name is that of the file's folder. Without a seed in the file, an
    episode's number is its seed: lerobot-eval gives the episodes of every task the same seeds in order.

    Raises:
        CheckpointError: The file is damaged, or has no episodes.
    """
    value = read_mapping(path)
    groups: dict[str, list[RecordedEpisode]] = {}
    try:
        overall = value.get("overall") or value.get("aggregated") or {}
        seconds = float(overall.get("eval_ep_s") or 0.0)
        for one in value.get("per_task") or ():
            episodes = groups.setdefault(str(one["task_group"]), [])
            for index, success in enumerate(one["metrics"]["successes"]):
                episodes.append(_episode(f"task {one['task_id']}", index, index, success, seconds))
        if not groups:
            for index, row in enumerate(value["per_episode"]):
                seed = index if row.get("seed") is None else int(row["seed"])
                groups.setdefault("lerobot", []).append(_episode("task", index, seed, row["success"], seconds))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise CheckpointError(f"{path} is damaged or not of lerobot-eval ({why})") from error
    if not any(groups.values()):
        raise CheckpointError(f"{path} holds no episode: the evaluation ended before its first")
    figures = {key: value for key, value in overall.items() if isinstance(value, int | float) and math.isfinite(value)}
    name = path.resolve().parent.name
    return [
        Evaluation(
            path,
            f"{name} {group}",
            group,
            figures,
            {"model_server": name},
            tuple(episodes),
            len(episodes),
            "lerobot-eval",
        )
        for group, episodes in groups.items()
        if episodes
    ]


def _episode(task: str, index: int, seed: int, success: Any, seconds: float) -> RecordedEpisode:
    if not isinstance(success, bool | int | float) or math.isnan(success):
        raise ValueError(f"success {success!r} of episode {index}")
    return RecordedEpisode(task, index, seed, bool(success), None, seconds, str(index), (float(seed),))
