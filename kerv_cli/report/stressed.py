"""Tables for studies that compare kinds and levels of stress (disturbed worlds, docs/stress.md)."""

from __future__ import annotations

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO, columns_of, paired_columns

NONE = "none"


def is_stressed(table: pd.DataFrame) -> bool:
    """Return whether a study's table compares several kinds or levels of stress."""
    return table["stress"].nunique() > 1 or table["stress_level"].nunique() > 1


def summed_table(table: pd.DataFrame) -> pd.DataFrame:
    """Pool a study's stressed episodes in three ways: by kind of stress, by level, and all together.

    Each pooled row is compared with the baseline's episodes in the same worlds under the same stresses.

    Returns:
        One row for each method and each way of pooling. `method` is the setting's label without stress. `sum` says what
        was pooled, such as `push`, `level 2` or `all`. `label` consists of both. The further columns are those of a
        study's table: `study`, `baseline`, `episodes`, `successes`, `success`, `pairs`, the counts of the pairs'
        outcomes, `mcnemar_p`, `difference`, `margin` and `non_inferior`. Intervals are in
        columns that end in _low and _high.
    """
    rows = table[(table["averaging"] == MICRO) & (table["stress"] != NONE)]
    reference = next(iter(rows.loc[rows["label"] == rows["baseline"], "unstressed"]), "")
    levels = "level " + rows["stress_level"].astype(str)
    groups = [*rows.groupby("stress"), *rows.groupby(levels), ("all", rows)]
    summed = []
    for name, group in groups:
        for method, parts in group.groupby("unstressed", sort=False):
            sums = parts[["episodes", "successes", *stats.PairedCounts._fields]].sum().astype(int)
            counts = stats.PairedCounts(*sums.iloc[2:].tolist())
            summed.append(
                {
                    "study": rows["study"].iloc[0],
                    "label": f"{method} {name}",
                    "method": method,
                    "sum": name,
                    "baseline": f"{reference} {name}",
                    **sums.iloc[:2].to_dict(),
                    **columns_of("success", stats.wilson(int(sums["successes"]), int(sums["episodes"]))),
                    **paired_columns(counts, stats.paired_difference(counts)),
                }
            )
    return pd.DataFrame(summed)
