"""Fills the figures of Markdown pages from the committed tables: `scripts/figures.py PAGE…`, `--check` changes nothing.

    <!-- table main: setting success speedup -->      becomes a table with these columns, a row per setting
    <!-- /table -->
    <!-- figure main one_pass speedup -->2.04 (1.97–2.11)<!-- /figure -->      one number within a sentence
    <!-- errors prediction_mt10-vision -->           becomes a table of the predictors' errors by steps ahead
    <!-- /errors -->
    <!-- replay replay_main_vla-150m 16 -->         becomes a table of replayed decodes of N tokens
    <!-- /replay -->

A study's name is that of `results/tables/<study>.csv`. Behind it `macro` takes the average over difficulty groups
instead of tasks, and `only=a,b` takes these settings, which are written with `_` for a space. A column `NAME@PROFILE`
is priced for another machine, from `<study>_on.csv`.
"""

from __future__ import annotations

import csv
import functools
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

TABLES = Path(__file__).resolve().parent.parent / "results" / "tables"
_TABLE = re.compile(r"(<!-- table (\S+)((?: \S+)*?): ([^>]*?) -->\n)(.*?)(<!-- /table -->)", re.DOTALL)
_FIGURE = re.compile(r"(<!-- figure (\S+)( macro)? (\S+) (\S+) -->)(.*?)(<!-- /figure -->)", re.DOTALL)
_ERRORS = re.compile(r"(<!-- errors (\S+) -->\n)(.*?)(<!-- /errors -->)", re.DOTALL)
_REPLAY = re.compile(r"(<!-- replay (\S+) (\d+) -->\n)(.*?)(<!-- /replay -->)", re.DOTALL)

Row = Mapping[str, str]


class BadReference(Exception):
    """A page names a table, setting or column that does not exist."""


@functools.cache
def table_of(study: str, macro: bool) -> tuple[dict[str, str], ...]:
    """The rows of one averaging of a study's table; all rows of a table without averaging."""
    path = TABLES / f"{study}.csv"
    if not path.is_file():
        raise BadReference(f"no table {path.name} in {TABLES}")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    wanted = "macro over difficulty groups" if macro else "micro over tasks"
    return tuple(row for row in rows if row.get("averaging", wanted) == wanted)


def _number(row: Row, name: str, form: str, scale: float = 1.0, unit: str = "") -> str:
    if name not in row:
        raise BadReference(f"no column {name}")
    text = row[name]
    return f"{scale * float(text):{form}}{unit}" if text not in ("", "nan") else ""


def _interval(row: Row, name: str, form: str, scale: float = 1.0, between: str = "–") -> str:
    value, low, high = (_number(row, f"{name}{end}", form, scale) for end in ("", "_low", "_high"))
    return f"{value} ({low}{between}{high})" if value and low else value


def _is_baseline(row: Row) -> bool:
    """A table of latencies has AR at the same latency for a baseline."""
    return row["label"] == row.get("baseline", row.get("ar"))


def _ratio(row: Row, name: str) -> str:
    return "1" if _is_baseline(row) else _interval(row, name, ".2f")


def _own(text: Callable[[Row], str]) -> Callable[[Row], str]:
    """Empty for the baseline, which is not compared with itself."""
    return lambda row: "" if _is_baseline(row) else text(row)


def _lost_won(row: Row) -> str:
    p = float(row["mcnemar_p"] or "nan")
    return f"{row['only_baseline']} / {row['only_method']}, {'<0.001' if p < 0.001 else f'{p:.2g}'}"


def _rate(row: Row) -> str:
    """Decodes per second that the 95th percentile of the latency allows."""
    latency = _number(row, "latency_p95_ms", ".6f")
    return f"{1000 / float(latency):.0f}" if latency and float(latency) else ""


def _again(row: Row) -> str:
    value, low, high = (_number(row, f"speedup{end}_again", ".2f") for end in ("", "_low", "_high"))
    return f"{value} ({low}–{high})"


COLUMNS: dict[str, tuple[str, Callable[[Row], str]]] = {
    "setting": ("setting", lambda row: row["label"]),
    "success": ("success", lambda row: f"{row['successes']}/{row['episodes']}"),
    "percent": ("success, %", lambda row: _interval(row, "success", ".1f", 100)),
    "lost/won": ("lost / won, p", _own(_lost_won)),
    "difference": ("difference, points", _own(lambda row: _interval(row, "difference", "+.1f", 100, " to "))),
    "non-inferior": ("non-inferior", _own(lambda row: {"True": "yes", "False": "no"}.get(row["non_inferior"], ""))),
    "pairs": ("pairs to settle", _own(lambda row: _number(row, "pairs_to_settle", ".0f").replace("inf", "∞"))),
    "speedup": ("speedup", lambda row: _ratio(row, "speedup")),
    "per-episode": ("per episode", lambda row: _ratio(row, "episode_speedup")),
    "ceiling": ("ceiling", lambda row: _number(row, "ceiling", ".1f")),
    "ms": ("ms per step", lambda row: _number(row, "time_per_step_ms", ".2f")),
    "ms-episode": ("ms per episode", lambda row: _number(row, "time_per_episode_ms", ".0f")),
    "p50": ("p50, ms", lambda row: _number(row, "latency_p50_ms", ".1f")),
    "p95": ("p95, ms", lambda row: _number(row, "latency_p95_ms", ".1f")),
    "worst": ("worst, ms", lambda row: _number(row, "latency_worst_ms", ".0f")),
    "rate": ("chunks per s at p95", _rate),
    "AL": ("AL", lambda row: _number(row, "AL", ".1f")),
    "steps": ("control steps to success", lambda row: _number(row, "steps_to_success", ".0f")),
    "path": ("path, against AR", _own(lambda row: _interval(row, "path_m_ratio", ".2f"))),
    "forwards": ("forwards per step", lambda row: _number(row, "forwards_per_step", ".2f")),
    "skipped": ("skipped", lambda row: _number(row, "skip_rate", ".0f", 100, " %")),
    "unverified": ("unverified", lambda row: _number(row, "unverified_share", ".0f", 100, " %")),
    "compensated": ("compensated", lambda row: _number(row, "compensation_rate", ".0f", 100, " %")),
    "retrieved": ("retrieved", lambda row: _number(row, "retrieval_share", ".0f", 100, " %")),
    "deviation": ("deviation", lambda row: _number(row, "deviation", ".4f")),
    # of an agreement table
    "risk": ("realised risk", lambda row: _interval(row, "realised_risk", ".2f") if row.get("realised_risk") else ""),
    "alarms": ("episodes with an alarm", lambda row: _number(row, "alarm_rate", ".0f", 100, " %")),
    "to-alarm": ("audits to it", lambda row: _number(row, "audits_to_alarm", ".1f")),
    "felt": ("a decode takes, ms", lambda row: _number(row, "felt_latency_ms", ".0f")),
    "felt-steps": ("control steps", lambda row: _number(row, "felt_latency_steps", ".1f")),
    "held": ("steps on a held action", lambda row: _number(row, "held_share", ".0f", 100, " %")),
    "again": ("again", _again),
    "ratio": ("difference, %", lambda row: f"{100 * (float(row['ratio']) - 1):+.1f}"),
    "overlap": ("intervals overlap", lambda row: {"True": "yes", "False": "no"}[row["overlap"]]),
}


def _column(name: str, study: str = "") -> tuple[str, Callable[[Row], str]]:
    """Title and text. `NAME@PROFILE` is that column of `<study>_on.csv`, priced for another machine and marked so."""
    name, _, machine = name.partition("@")
    if name not in COLUMNS:
        raise BadReference(f"no column {name}; known: {', '.join(COLUMNS)}")
    title, text = COLUMNS[name]
    if not machine:
        return title, text
    priced = {row["label"]: row for row in table_of(f"{study}_on", False) if row["on"] == machine}
    if not priced:
        raise BadReference(f"{study}_on has no machine {machine}")
    return f"{title}, ≈ {machine}", lambda row: f"≈ {text(priced[row['label']])}" if row["label"] in priced else ""


def _named(label: str) -> str:
    return label.replace(" ", "_")


def markdown_table(study: str, options: list[str], names: list[str]) -> str:
    """The table as Markdown lines."""
    only = [word[5:].split(",") for word in options if word.startswith("only=")]
    rows = [r for r in table_of(study, "macro" in options) if not only or _named(r["label"]) in only[0]]
    if not rows:
        raise BadReference(f"{study} has none of these settings")
    columns = [_column(name, study) for name in names]
    lines = [[title for title, _ in columns], ["---"] * len(columns)]
    lines += [[text(row) for _, text in columns] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def figure(study: str, macro: bool, label: str, column: str) -> str:
    """One number."""
    found = [row for row in table_of(study, macro) if _named(row["label"]) == label]
    if len(found) != 1:
        raise BadReference(f"{study} has {len(found)} settings {label}")
    return _column(column, study)[1](found[0])


def error_table(name: str) -> str:
    """Mean errors by predictor and steps ahead, over all tasks and the DoFs in which some predictor differs from hold,
    with their share of hold's."""
    rows = table_of(name, macro=False)
    dofs = {row["dof"] for row in rows if row["error"] != row["hold_error"]}
    errors: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row["dof"] in dofs:
            errors.setdefault(row["predictor"], {}).setdefault(row["steps_ahead"], []).append(float(row["error"]))
    means = {name: {step: sum(x) / len(x) for step, x in steps.items()} for name, steps in errors.items()}
    lines = [["predictor", *(f"{step} ahead" for step in means["hold"])], ["---"] * (1 + len(means["hold"]))]
    for predictor, steps in means.items():
        shares = {step: f" ({100 * x / means['hold'][step]:.0f} %)" for step, x in steps.items() if predictor != "hold"}
        lines.append([predictor, *(f"{x:.4f}{shares.get(step, '')}" for step, x in steps.items())])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _steps_per_decode(study: str) -> dict[str, float]:
    """Control steps that a setting executes per decode, by label: a method that drops the rest of a chunk has fewer."""
    return {row["label"]: float(row["steps"]) / float(row["decodes"]) for row in table_of(study, macro=False)}


def replay_table(name: str, tokens: str) -> str:
    """Decodes of whole chunks, N tokens, that `kerv bench replay` executed: a row per setting. A ratio per control step
    is the one per decode times the setting's control steps per decode in the replayed study, relative to AR's."""
    titles = ["setting", "forwards", "ms per decode", "per control step", "per decode", "cost model, per decode"]
    lines = [titles, ["---"] * len(titles)]
    for row in (row for row in table_of(name, macro=False) if row["tokens"] == tokens):
        steps = _steps_per_decode(row["study"])
        texts = []
        for scale in (steps[row["label"]] / steps["ar"], 1.0):
            value, low, high = (_number(row, end, ".2f", scale) for end in ("speedup", "low", "high"))
            texts.append("1" if row["label"] == "ar" else f"{value} ({low}–{high})")
        times = [_number(row, "forwards", ".2f"), _number(row, "seconds", ".1f", 1000)]
        lines.append([row["label"], *times, *texts, _number(row, "model", ".2f")])
    if len(lines) == 2:
        raise BadReference(f"{name} has no decodes of {tokens} tokens")
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def filled(text: str) -> str:
    """A page with its tables and figures renewed.

    Raises:
        BadReference: a table, setting or column that does not exist.
    """
    text = _TABLE.sub(lambda m: m[1] + markdown_table(m[2], m[3].split(), m[4].split()) + m[6], text)
    text = _ERRORS.sub(lambda m: m[1] + error_table(m[2]) + m[4], text)
    text = _REPLAY.sub(lambda m: m[1] + replay_table(m[2], m[3]) + m[5], text)
    return _FIGURE.sub(lambda m: m[1] + figure(m[2], bool(m[3]), m[4], m[5]) + m[7], text)


def main(words: list[str]) -> int:
    """Fills the pages, or with --check says which differ -> exit status."""
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
