"""Fills the figures of Markdown pages from the committed tables: `scripts/figures.py PAGE…`, `--check` changes nothing.

`scripts/figures.py publish STUDY…` copies the tables of these studies, which `kerv report` wrote, to where they are
committed.

    <!-- table main: setting success speedup -->      becomes a table with these columns, a row per setting
    <!-- /table -->
    <!-- figure main one_pass speedup -->2.04 (1.97–2.11)<!-- /figure -->      one number within a sentence

A study's name is that of `results/tables/<study>.csv`. Behind it `only=a,b` takes these settings, which are written
with `_` for a space. A column `NAME@OTHER` takes NAME of the same setting from OTHER, a table, OTHER.csv, or a
machine, for which `<study>_on.csv` has prices, or TABLE:MACHINE, for which `TABLE_on.csv` has them. Behind a column,
`=TITLE` is its heading, with `_` for a space.
"""

from __future__ import annotations

import csv
import functools
import json
import re
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

TABLES = Path(__file__).resolve().parent.parent / "results" / "tables"
WRITTEN = TABLES.parent / "report" / "tables"
_POOLED = "micro over tasks"
_TABLE = re.compile(r"(<!-- table (\S+)((?: \S+)*?): ([^>]*?) -->\n)(.*?)(<!-- /table -->)", re.DOTALL)
_FIGURE = re.compile(r"(<!-- figure (\S+) (\S+) (\S+) -->)(.*?)(<!-- /figure -->)", re.DOTALL)

Row = Mapping[str, str]


class BadReference(Exception):
    """A page names a table, setting or column that does not exist."""


@functools.cache
def table_of(study: str) -> tuple[dict[str, str], ...]:
    """The rows of a study's table. Of a table with several ways of averaging, those that pool all tasks."""
    path = TABLES / f"{study}.csv"
    if not path.is_file():
        raise BadReference(f"no table {path.name} in {TABLES}")
    with path.open(newline="", encoding="utf-8") as file:
        rows = [_further(study).get(row.get("label", ""), {}) | row for row in csv.DictReader(file)]
    return tuple(row for row in rows if row.get("averaging", _POOLED) == _POOLED)


@functools.cache
def _further(study: str) -> dict[str, dict[str, str]]:
    """label -> the measures that are in `<study>.json` instead of a column; none of an older table."""
    path = TABLES / f"{study}.json"
    labels = json.loads(path.read_text(encoding="utf-8"))["labels"] if path.is_file() else {}
    found = {}
    for label, about in labels.items():
        measures = about["measures"][_POOLED] | {"bias": _largest(about.get("acceptance") or {})}
        found[label] = {name: "" if value is None else str(value) for name, value in measures.items()}
    return found


def _largest(acceptance: Mapping[str, list[float | None]]) -> float | None:
    """Of the DoFs' mean differences between accepted drafts and the target's tokens, the one furthest from 0."""
    known = [one for one in acceptance.get("mean_accepted_difference_per_dof", ()) if one is not None]
    return max(known, key=abs, default=None)


def publish(studies: list[str]) -> None:
    """Copy the tables of `kerv report` to where they are committed."""
    for study in studies:
        parts = re.compile(rf"{re.escape(study)}(_against_\w+)?(_per_task|_on)?\.(csv|json)")
        found = [path for path in WRITTEN.glob(f"{study}*") if parts.fullmatch(path.name)]
        if not found:
            raise BadReference(f"no table of {study} in {WRITTEN}: kerv report study={study}")
        for path in found:
            shutil.copy(path, TABLES)


def _number(row: Row, name: str, form: str, scale: float = 1.0, unit: str = "") -> str:
    if name not in row:
        raise BadReference(f"no column {name}")
    text = row[name]
    return f"{scale * float(text):{form}}{unit}" if text not in ("", "nan") else ""


def _interval(row: Row, name: str, form: str, scale: float = 1.0, between: str = "–") -> str:
    value, low, high = (_number(row, f"{name}{end}", form, scale) for end in ("", "_low", "_high"))
    return f"{value} ({low}{between}{high})" if value and low else value


def _is_baseline(row: Row) -> bool:
    return row["label"] == row.get("baseline")


def _ratio(row: Row, name: str) -> str:
    """A ratio; its interval only if it covers at least three runs, or if decodes were priced instead of timed."""
    if _is_baseline(row):
        return "1"
    return _interval(row, name, ".2f") if int(row.get("runs", 3)) > 2 else _number(row, name, ".2f")


def _own(text: Callable[[Row], str]) -> Callable[[Row], str]:
    """Empty for the baseline, which is not compared with itself."""
    return lambda row: "" if _is_baseline(row) else text(row)


def _lost_won(row: Row) -> str:
    p = float(row["mcnemar_p"] or "nan")
    return f"{row['only_baseline']} / {row['only_method']}, {'<0.001' if p < 0.001 else f'{p:.2g}'}"


def _encoders(row: Row) -> str:
    """The speed with an encoder at its floor, at twice its floor, and with one of 8 ms."""
    return " / ".join(
        "1" if _is_baseline(row) else _number(row, f"encoder_{at}", ".2f") for at in ("floor", "twice", "8ms")
    )


def _again(row: Row) -> str:
    value, low, high = (_number(row, f"speedup{end}_again", ".2f") for end in ("", "_low", "_high"))
    return f"{value} ({low}–{high})"


CLAIMED = {"spec_vla": "1.42", "kerv": "1.27 × Spec-VLA", "heisd": "2.45", "naive_sd": "0.87 (HeiSD)"}
"""Setting -> what its paper says, over its own loop."""

COLUMNS: dict[str, tuple[str, Callable[[Row], str]]] = {
    "setting": ("setting", lambda row: row["label"]),
    "claimed": ("claimed", lambda row: CLAIMED.get(row["label"], "")),
    "success": ("success", lambda row: f"{row['successes']}/{row['episodes']}"),
    "percent": ("success, %", lambda row: _interval(row, "success", ".1f", 100)),
    "lost/won": ("lost / won, p", _own(_lost_won)),
    "difference": ("difference, points", _own(lambda row: _interval(row, "difference", "+.1f", 100, " to "))),
    "non-inferior": ("non-inferior", _own(lambda row: {"True": "yes", "False": "no"}.get(row["non_inferior"], ""))),
    "speedup": ("speedup", lambda row: _ratio(row, "speedup")),
    "per-episode": ("per episode", lambda row: _ratio(row, "episode_speedup")),
    "both-solved": ("both solved", lambda row: _ratio(row, "solved_speedup")),
    "failed": ("failed", lambda row: f"{int(row['episodes']) - int(row['successes'])} of {row['episodes']}"),
    "encoders": ("encoder at its floor / twice / 8 ms", _encoders),
    "p95": ("p95, ms", lambda row: _number(row, "latency_p95_ms", ".1f")),
    "AL": ("AL", lambda row: _number(row, "AL", ".1f")),
    "steps": ("control steps to success", lambda row: _number(row, "steps_to_success", ".0f")),
    "forwards": ("forwards per step", lambda row: _number(row, "forwards_per_step", ".2f")),
    "compensated": ("decodes compensated", lambda row: _number(row, "compensation_rate", ".0f", 100, " %")),
    "retrieved": ("decodes retrieved", lambda row: _number(row, "retrieval_share", ".0f", 100, " %")),
    "skipped": ("decodes skipped", lambda row: _number(row, "skip_rate", ".0f", 100, " %")),
    "unverified": ("unverified", lambda row: _number(row, "unverified_share", ".0f", 100, " %")),
    "felt": ("a decode takes, ms", lambda row: _number(row, "felt_latency_ms", ".0f")),
    "held": ("steps on a held action", lambda row: _number(row, "held_share", ".0f", 100, " %")),
    "again": ("again", _again),
    "bias": ("mean difference of accepted drafts, bins", _own(lambda row: _number(row, "bias", "+.2f"))),
}


def _column(name: str, study: str = "") -> tuple[str, Callable[[Row], str]]:
    """Heading and text. `NAME@OTHER=HEADING`: of the same setting, priced for a machine or in another table."""
    name, _, own = name.partition("=")
    name, _, other = name.partition("@")
    if name not in COLUMNS:
        raise BadReference(f"no column {name}; known: {', '.join(COLUMNS)}")
    title, text = COLUMNS[name]
    own = own.replace("_", " ")
    if not other:
        return own or title, text
    if (TABLES / f"{other}.csv").is_file():
        there, title, mark = table_of(other), f"{title}, {other}", ""
    else:
        table, _, machine = other.rpartition(":")
        there = tuple(row for row in table_of(f"{table or study}_on") if row["on"] == machine)
        title, mark = f"{title}, ≈ {machine}", "≈ "
    rows = {row["label"]: row for row in there}
    if not rows:
        raise BadReference(f"no table has the machine or rows of {other}")
    return own.replace(
        "_", " "
    ) or title, lambda row: f"{mark}{text(rows[row['label']])}" if row["label"] in rows else ""


def _named(label: str) -> str:
    return label.replace(" ", "_")


def markdown_table(study: str, options: list[str], names: list[str]) -> str:
    """The table as Markdown lines."""
    only = [word[5:].split(",") for word in options if word.startswith("only=")]
    rows = [r for r in table_of(study) if not only or _named(r["label"]) in only[0]]
    if not rows:
        raise BadReference(f"{study} has none of these settings")
    columns = [_column(name, study) for name in names]
    lines = [[title for title, _ in columns], ["---"] * len(columns)]
    lines += [[text(row) for _, text in columns] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def figure(study: str, label: str, column: str) -> str:
    """One number."""
    found = [row for row in table_of(study) if _named(row["label"]) == label]
    if len(found) != 1:
        raise BadReference(f"{study} has {len(found)} settings {label}")
    return _column(column, study)[1](found[0])


def filled(text: str) -> str:
    """A page with its tables and figures renewed.

    Raises:
        BadReference: a table, setting or column that does not exist.
    """
    text = _TABLE.sub(lambda m: m[1] + markdown_table(m[2], m[3].split(), m[4].split()) + m[6], text)
    return _FIGURE.sub(lambda m: m[1] + figure(m[2], m[3], m[4]) + m[6], text)


def main(words: list[str]) -> int:
    """Publish tables, or fill the pages, or with --check say which differ -> exit status."""
    if words[:1] == ["publish"]:
        try:
            publish(words[1:])
        except BadReference as error:
            print(error, file=sys.stderr)
            return 1
        return 0
    check, status = "--check" in words, 0
    for page in [Path(word) for word in words if not word.startswith("--")]:
        before = page.read_text(encoding="utf-8")
        try:
            after = filled(before)
        except BadReference as error:
            print(f"{page}: {error}", file=sys.stderr)
            return 1
        if after != before and check:
            print(f"{page} differs from results/tables: run 'make pages'", file=sys.stderr)
            status = 1
        elif after != before:
            page.write_text(after, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
