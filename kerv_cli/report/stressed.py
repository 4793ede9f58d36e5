"""A study of stress: success of every method against the level, kind by kind, and where a method falls behind
autoregressive decoding under the same stress."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO, Row, columns_of, paired_columns
from kerv_cli.report.tables import rows_of

BEHIND = 0.10
"""A method falls behind where its success is lower than the baseline's, under the same stress, by this or more."""
NONE = "none"


def is_stressed(table: pd.DataFrame) -> bool:
    """Whether a study's table compares kinds or levels of stress."""
    return table["stress"].nunique() > 1 or table["stress_level"].nunique() > 1


def by_kind(table: pd.DataFrame) -> dict[str, dict[str, list[Row]]]:
    """Kind -> method -> rows of the table along the level, beginning with the method's unstressed row."""
    rows = rows_of(table, MICRO)
    plain = {str(row["unstressed"]): row for row in rows if row["stress"] == NONE}
    kinds: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        if row["stress"] != NONE:
            kinds.setdefault(str(row["stress"]), {}).setdefault(str(row["unstressed"]), []).append(row)
    return {
        kind: {
            name: sorted([*([plain[name]] if name in plain else []), *group], key=lambda row: int(row["stress_level"]))
            for name, group in methods.items()
        }
        for kind, methods in kinds.items()
    }


def summed_table(table: pd.DataFrame) -> pd.DataFrame:
    """Successes of every method summed over the levels of a kind, the kinds of a level, and all stresses, and the
    difference from the baseline in the same worlds under the same stresses; the unstressed row is in no sum.

    Args:
        table: a study's.

    Returns:
        Columns study, label (`METHOD SUM`), method (label without stress), sum (`push`, `level 2`, `all`), baseline,
        episodes, successes, success, pairs and their counts, mcnemar_p, difference, margin, non_inferior; intervals
        with the endings _low and _high.
    """
    rows = [row for row in rows_of(table, MICRO) if row["stress"] != NONE]
    reference = _reference(table)
    kinds = sorted({str(row["stress"]) for row in rows})
    levels = sorted({int(row["stress_level"]) for row in rows})
    groups = {kind: [row for row in rows if row["stress"] == kind] for kind in kinds}
    groups |= {f"level {level}": [row for row in rows if int(row["stress_level"]) == level] for level in levels}
    groups["all"] = rows
    return pd.DataFrame(
        _sum([row for row in group if row["unstressed"] == method], method, name, reference)
        for name, group in groups.items()
        for method in _names(group)
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
        **paired_columns(counts),
    }


def verdict(table: pd.DataFrame) -> str:
    """In which levels of which kinds each method falls behind the baseline, in one sentence."""
    behind = [row for row in rows_of(table, MICRO) if row["pairs"] and row["difference"] <= -BEHIND]
    behind = [row for row in behind if row["label"] != row["baseline"]]
    reference = _reference(table)
    bound = f"{100 * BEHIND:.0f} points of success or more behind {reference} under the same stress"
    if not behind:
        return f"No method falls {bound}."
    methods = {name: [row for row in behind if row["unstressed"] == name] for name in _names(behind)}
    clauses = [f"{name}: {_levels_text(rows)}" for name, rows in methods.items()]
    return f"{bound} (* with 95 % confidence behind it): {'; '.join(clauses)}."


def _names(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(str(row["unstressed"]) for row in rows))


def _reference(table: pd.DataFrame) -> str:
    """Return what the baseline is called, whatever its stress."""
    baseline = table["baseline"].iloc[0]
    same = table.loc[table["label"] == baseline, "unstressed"]
    return str(same.iloc[0] if len(same) else baseline)


def _levels_text(rows: Iterable[Row]) -> str:
    """The levels of each kind as text, `camera 3/4*, light 4`; a star where the interval of the difference lies below
    0."""
    levels: dict[str, list[str]] = {}
    for row in rows:
        if row["stress"] == NONE:
            levels.setdefault("unstressed", [])
        else:
            sure = "*" if row["difference_high"] < 0 else ""
            levels.setdefault(str(row["stress"]), []).append(f"{row['stress_level']}{sure}")
    return ", ".join(" ".join([kind, "/".join(numbers)]).strip() for kind, numbers in levels.items())
