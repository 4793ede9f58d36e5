"""Tables for studies that compare kinds and levels of stress (disturbed worlds, docs/stress.md)."""

from __future__ import annotations

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO, Row, columns_of, paired_columns
from kerv_cli.report.tables import is_baseline, rows_of

NONE = "none"


def is_stressed(table: pd.DataFrame) -> bool:
    """Return whether a study's table compares several kinds or levels of stress."""
    return table["stress"].nunique() > 1 or table["stress_level"].nunique() > 1


def by_kind(table: pd.DataFrame) -> dict[str, dict[str, list[Row]]]:
    """Return the rows of each method, sorted by level of stress, for every kind of stress.

    Each list begins with the method's unstressed row.

    Returns:
        Kind of stress -> label of the method without stress -> rows.
    """
    rows = rows_of(table[table["averaging"] == MICRO].sort_values("stress_level", kind="stable"))
    kinds: dict[str, dict[str, list[Row]]] = {}
    for kind in dict.fromkeys(table.loc[table["stress"] != NONE, "stress"]):
        for row in rows:
            if row["stress"] in (NONE, kind):
                kinds.setdefault(str(kind), {}).setdefault(str(row["unstressed"]), []).append(row)
    return kinds


def summed_table(table: pd.DataFrame) -> pd.DataFrame:
    """Pool a study's episodes over the levels of each kind of stress, the kinds at each level, and all stresses.

    Each pooled row is compared with the baseline's episodes in the same worlds under the same stresses. Unstressed
    episodes are left out.

    Returns:
        Columns: `study`; `label` (METHOD and SUM); `method` (label without stress); `sum` (such as `push`, `level 2` or
        `all`); `baseline`; `episodes`; `successes`; `success`; `pairs` with the counts of their outcomes; `mcnemar_p`;
        `difference`; `margin`; `non_inferior`. Intervals are in columns that end in _low and _high.
    """
    rows = [row for row in rows_of(table, MICRO) if row["stress"] != NONE]
    reference = next((str(row["unstressed"]) for row in rows if is_baseline(row)), "")
    kinds, levels = ({str(row[name]) for row in rows} for name in ("stress", "stress_level"))
    groups = {kind: [row for row in rows if row["stress"] == kind] for kind in sorted(kinds)}
    groups |= {f"level {level}": [r for r in rows if str(r["stress_level"]) == level] for level in sorted(levels)}
    groups["all"] = rows
    return pd.DataFrame(
        _sum([row for row in group if row["unstressed"] == method], str(method), name, reference)
        for name, group in groups.items()
        for method in dict.fromkeys(row["unstressed"] for row in group)
    )


def _sum(rows: list[Row], method: str, name: str, reference: str) -> Row:
    """Return one pooled row.

    Args:
        rows: Rows of one method to pool.
        method: The method's label without stress.
        name: What is pooled, such as `push` or `level 2`.
        reference: The baseline's label without stress.
    """
    counts = stats.PairedCounts(*(sum(int(row[count]) for row in rows) for count in stats.PairedCounts._fields))
    episodes, successes = (sum(int(row[column]) for row in rows) for column in ("episodes", "successes"))
    return {
        "study": rows[0]["study"],
        "label": f"{method} {name}",
        "method": method,
        "sum": name,
        "baseline": f"{reference} {name}",
        "episodes": episodes,
        "successes": successes,
        **columns_of("success", stats.wilson(successes, episodes)),
        **paired_columns(counts, stats.paired_difference(counts)),
    }
