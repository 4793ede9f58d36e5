"""A study of stress: rows along the level, kind by kind, and sums over levels and kinds."""

from __future__ import annotations

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO, Row, columns_of, paired_columns
from kerv_cli.report.tables import is_baseline, rows_of

NONE = "none"


def is_stressed(table: pd.DataFrame) -> bool:
    """Return whether a study's table compares kinds or levels of stress."""
    return table["stress"].nunique() > 1 or table["stress_level"].nunique() > 1


def by_kind(table: pd.DataFrame) -> dict[str, dict[str, list[Row]]]:
    """Return kind -> method -> rows along the level, beginning with the method's unstressed row."""
    rows = rows_of(table[table["averaging"] == MICRO].sort_values("stress_level", kind="stable"))
    kinds: dict[str, dict[str, list[Row]]] = {}
    for kind in dict.fromkeys(table.loc[table["stress"] != NONE, "stress"]):
        for row in rows:
            if row["stress"] in (NONE, kind):
                kinds.setdefault(str(kind), {}).setdefault(str(row["unstressed"]), []).append(row)
    return kinds


def summed_table(table: pd.DataFrame) -> pd.DataFrame:
    """Sum a study's table over the levels of a kind, the kinds of a level, and all stresses.

    Each sum is compared with the baseline in the same worlds under the same stresses. No sum has unstressed rows.

    Returns:
        Columns study, label (`METHOD SUM`), method (its label without stress), sum (`push`, `level 2`, `all`),
        baseline, episodes, successes, success, pairs and their counts, mcnemar_p, difference, margin, non_inferior;
        intervals with the endings _low and _high.
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
