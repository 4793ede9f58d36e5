"""Judges settings by a bound on the loss of success: which setting of a study to take (`kerv report --choose`), and
which settings a sweep stops (`until=decided`); docs/methods.md §7.

A choice tests the settings of a finished study in a fixed order, the safest first, each only where all before it
passed: however many there are, the error is that of one test. A sweep looks after every block of seeds,
group-sequentially with Pocock's constant boundary (Biometrika 64, 1977): of K planned looks each has the same
confidence, so high that a setting exactly at the bound is misjudged at any of them with at most 5 %, both sides
together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_json, write_json
from kerv_cli.lab.plan import Wanted
from kerv_cli.lab.store import StudyStore
from kerv_cli.lab.study import Judge
from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO, Row, pair_counts, paired
from kerv_cli.report.tables import StudyData, is_baseline, is_number, load_study, rows_of
from kerv_cli.report.text import interval

POINTS = 100.0
SPEED = "episode_speedup"


@dataclass(frozen=True)
class Choice:
    """The answer for a suite or a task. front: settings that no other one beats in both speed and success, the fastest
    first. chosen: the fastest setting whose loss of success is shown to be below the bound; empty if there is none.
    loss_at_most, episode_speedup: of the chosen one, the first in points of success at 95 % confidence. candidate: the
    fastest that more pairs would show at the present rates, empty if there is none, and about how many pairs, all in
    all. faster: how many settings are faster than the baseline, or untimed; no other is ever chosen."""

    where: str
    pairs: int
    front: tuple[str, ...]
    chosen: str
    loss_at_most: float
    candidate: str
    candidate_pairs: float
    faster: int
    episode_speedup: float
    episode_speedup_low: float
    episode_speedup_high: float

    def as_dict(self) -> Row:
        """For JSON."""
        return {**asdict(self), "front": ";".join(self.front)}


def choices(study: pd.DataFrame, per_task: pd.DataFrame | None, loss: float) -> list[Choice]:
    """The suite's choice, then each task's.

    Args:
        study, per_task: a study's table, and that by task; None: the suite alone.
        loss: bound on the loss of success, points.
    """
    suite = rows_of(study, MICRO)
    groups = () if per_task is None else per_task.groupby("task", sort=True)
    tasks = {str(task): rows_of(rows) for task, rows in groups}
    return [_choice(where, rows, loss) for where, rows in {"all tasks": suite, **tasks}.items()]


def _choice(where: str, rows: Sequence[Row], loss: float) -> Choice:
    order = safest_first(rows)
    best = _fastest(list(itertools.takewhile(lambda row: _loss_at_most(row) < loss, order)))
    pairs = itertools.accumulate((_pairs_needed(row, loss) for row in order), max)  # what is safer is shown before
    reached = {str(row["label"]): least for row, least in zip(order, pairs, strict=True) if math.isfinite(least)}
    candidate = None if best else _fastest([row for row in order if str(row["label"]) in reached])
    label = str(candidate["label"]) if candidate else ""
    return Choice(
        where,
        pairs=max((int(row["pairs"]) for row in rows if not is_baseline(row)), default=0),
        front=tuple(str(row["label"]) for row in pareto(rows)),
        chosen=str(best["label"]) if best else "",
        loss_at_most=_loss_at_most(best) if best else math.nan,
        candidate=label,
        candidate_pairs=reached.get(label, math.nan),
        faster=len(order),
        **{f"{SPEED}{end}": float(best[f"{SPEED}{end}"]) if best else math.nan for end in ("", "_low", "_high")},
    )


def safest_first(rows: Sequence[Row]) -> list[Row]:
    """The settings in the order in which they are tested. What executes less unverified comes first, then
    what asks the target more often per step, then the study's order; none of this looks at success. A setting that is
    not faster than the baseline is no answer and is left out, unless nobody timed it."""
    paired = [row for row in rows if not is_baseline(row) and row["pairs"]]
    faster = [row for row in paired if not is_number(row[SPEED]) or row[SPEED] > 1]
    return sorted(faster, key=lambda row: (_unverified(row), -row["forwards_per_step"]))


def _unverified(row: Row) -> float:
    """Share of unverified tokens, rounded to a per cent; 1 where nothing decodes."""
    return round(float(row["unverified_share"]), 2) if is_number(row["unverified_share"]) else 1.0


def _fastest(rows: Sequence[Row]) -> Row | None:
    """The fastest of settings, which are in the order of their tests; where none is timed, the last of them."""
    return max(reversed(rows), key=lambda row: row[SPEED] if is_number(row[SPEED]) else -math.inf, default=None)


def _loss_at_most(row: Row) -> float:
    return -POINTS * float(row["difference_low"])


def _pairs_needed(row: Row, loss: float) -> float:
    counts = stats.PairedCounts(*(int(row[name]) for name in stats.PairedCounts._fields))
    return stats.pairs_to_settle(counts, loss / POINTS)


def pareto(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other one beats in speed per episode and success at once, the fastest first. The baseline's is 1."""

    def point(row: Row) -> tuple[float, float]:
        return (1.0 if is_baseline(row) else float(row[SPEED]), float(row["success"]))

    timed = [row for row in rows if is_baseline(row) or is_number(row[SPEED])]
    front = [row for row in timed if not any(_beats(point(other), point(row)) for other in timed)]
    return sorted(front, key=point, reverse=True)


def _beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a != b and a[0] >= b[0] and a[1] >= b[1]


def sentence(choice: Choice, loss: float, baseline: str) -> str:
    """The choice for the whole suite in words."""
    bound = f"loses less than {loss:g} points of success against {baseline}, with 95 % confidence"
    if choice.chosen:
        times = interval(choice.as_dict(), SPEED)
        if times == "–":
            return f"{choice.chosen} {bound} ({choice.pairs} pairs); which setting is the fastest was not timed"
        speed = f"per episode {times} times as fast as {baseline} on this machine"
        return f"the fastest setting that {bound}: {choice.chosen}, {speed} ({choice.pairs} pairs)"
    if not choice.faster:
        return f"no setting is faster per episode than {baseline} ({choice.pairs} pairs)"
    return f"{choice.pairs} pairs do not yet show a setting that is faster and {bound}; {_missing(choice)}"


def short_sentence(choice: Choice) -> str:
    """The choice for one task in a few words."""
    if choice.chosen:
        return f"{choice.where}: {choice.chosen}"
    if not choice.faster:
        return f"{choice.where}: none is faster ({choice.pairs} pairs)"
    return f"{choice.where}: undecided after {choice.pairs} pairs; {_missing(choice)}"


def _missing(choice: Choice) -> str:
    if not choice.candidate:
        return "more would not show one"
    more = max(1, math.ceil(choice.candidate_pairs - choice.pairs))
    if more > stats.MOST_PAIRS:
        return f"more than {stats.MOST_PAIRS:,} pairs would be needed to show it for {choice.candidate}"
    return f"about {more} more would show it for {choice.candidate} at the present rates"


SMALLER, LARGER, OPEN = "loss is smaller", "loss is larger", "open"

_CONSTANTS = (1.960, 2.178, 2.289, 2.361, 2.413, 2.453, 2.485, 2.512, 2.535, 2.555, 2.572, 2.588, 2.602, 2.614, 2.626,
              2.637, 2.646, 2.655, 2.663, 2.671)  # fmt: skip
"""Pocock's boundary on |z| for 1, 2, … equally spaced looks and 5 %, two-sided (Jennison and Turnbull, table 2.1)."""


def confidence_of_a_look(looks: int) -> float:
    """Confidence of the interval at each of so many looks.

    Raises:
        UsageError: more looks than the boundary is tabled for.
    """
    if not 1 <= looks <= len(_CONSTANTS):
        raise UsageError(f"until=decided with {looks} looks: 1 to {len(_CONSTANTS)}; set study.block higher")
    return float(1 - 2 * NormalDist().cdf(-_CONSTANTS[looks - 1]))


@dataclass(frozen=True)
class Verdict:
    """The answer for a setting at a look. difference: its success minus the baseline's; low, high: the interval at the
    look's confidence."""

    label: str
    verdict: str  # SMALLER, LARGER or OPEN
    pairs: int
    look: int  # from 1
    difference: float
    low: float
    high: float


def verdict_of(label: str, counts: stats.PairedCounts, margin: float, look: int, looks: int) -> Verdict:
    """Judges a setting. margin: the bound on the loss, a share of episodes."""
    difference = stats.paired_difference(counts, confidence_of_a_look(looks))
    answer = SMALLER if difference.low > -margin else LARGER if difference.high < -margin else OPEN
    return Verdict(label, answer, int(sum(counts)), look, difference.value, difference.low, difference.high)


def verdicts(data: StudyData, labels: Sequence[str], margin: float, look: int, looks: int) -> list[Verdict]:
    """Judges the settings of these labels by all their pairs with the baseline."""
    episodes = data.episodes[data.episodes["repeat"] == 0]
    baseline = episodes[episodes["label"] == data.study.baseline]
    answers = []
    for label in labels:
        counts = pair_counts(paired(episodes[episodes["label"] == label], baseline))
        answers.append(verdict_of(label, counts, margin, look, looks))
    return answers


def judge(loss: float, tell: Callable[[str], None]) -> Judge:
    """Return the `judge` of `study.run` for a bound on the loss of success.

    Args:
        loss: The bound, in points.
        tell: Takes a line of progress.
    """
    latest: dict[str, Verdict] = {}

    def ask(store: StudyStore, wanted: Sequence[Wanted], labels: Sequence[str], look: int, looks: int) -> list[str]:
        answers = verdicts(load_study(store, wanted), labels, loss / POINTS, look, looks)
        tell(f"look {look} of {looks}: {progress_line(answers)}")
        latest.update({answer.label: answer for answer in answers})
        write_verdicts(store.root, latest, loss, looks)
        return [answer.label for answer in answers if answer.verdict == OPEN]

    return ask


def write_verdicts(folder: Path, answers: Mapping[str, Verdict], loss: float, looks: int) -> None:
    """Writes decided.json into the study's folder. answers: label -> its verdict at its last look.

    Raises:
        StorageError: the disk refused.
    """
    rows = [{k: None if v != v else v for k, v in asdict(verdict).items()} for verdict in answers.values()]
    head = {"loss_points": loss, "looks": looks, "confidence_of_a_look": confidence_of_a_look(looks)}
    write_json(folder / "decided.json", {**head, "settings": rows})


def read_verdicts(folder: Path) -> pd.DataFrame | None:
    """The last answers of `until=decided` in a study's folder; None where it was swept without.

    Raises:
        CheckpointError: the file is damaged.
    """
    path = folder / "decided.json"
    return pd.DataFrame(read_json(path)["settings"]) if path.is_file() else None


def stopping_rule(loss: float, looks: int) -> str:
    """The stopping rule in one sentence."""
    confidence = 100 * confidence_of_a_look(looks)
    return (
        f"until=decided: at most {looks} looks, one per block of seeds over all tasks, each at {confidence:.1f} % "
        "(Pocock's boundary, 95 % over all looks); a setting stops when its loss of success is shown to be below or "
        f"above {loss:g} points"
    )


def progress_line(answers: Sequence[Verdict]) -> str:
    """Verdicts in one line, for progress."""
    clauses = [f"{v.label}: {v.verdict} after {v.pairs} pairs" for v in answers if v.verdict != OPEN]
    waiting = sum(v.verdict == OPEN for v in answers)
    return "; ".join([*clauses, f"{waiting} open"])
