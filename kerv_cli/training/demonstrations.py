"""Which demonstrations a command learns from: one dataset, or several that add up."""

from __future__ import annotations

from kerv_cli.base.places import artifact
from kerv_cli.worlds.demos.dataset import DemoDataset


def open_demos(results: str, names: str) -> DemoDataset:
    """The dataset of that name; several, e.g. `mt50+mt50-dagger`, are joined in that order. A folder of that very
    name comes first.

    Raises:
        UsageError: no folder name. CheckpointError: one is missing, unfinished or damaged, or they do not add up.
    """
    whole = artifact(results, "demos", names)
    folders = [whole] if whole.is_dir() else [artifact(results, "demos", name) for name in names.split("+")]
    return DemoDataset.joined([DemoDataset.open(folder) for folder in folders])
