"""Example: a column of your own in every table and CSV file of a study."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.registry import ColumnPart

if TYPE_CHECKING:
    import pandas as pd


@ColumnPart("longest_episode")
def longest(episodes: pd.DataFrame) -> float:
    """episodes: a setting's, with the columns of `EPISODE_SCHEMA` (`kerv_cli/episodes/rows.py`)."""
    return float(episodes["steps"].max())
