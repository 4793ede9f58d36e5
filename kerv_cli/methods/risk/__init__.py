"""Risk-controlled verification (docs/methods.md §4.6, ours): settings and registration of the gate, the scores that
it may look at, and the recording that certifies its level."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from kerv_cli.base.files import sha256_of
from kerv_cli.base.limits import MOST_DECODES, number
from kerv_cli.base.registry import add, find

_SCORES = "kerv_cli.methods.risk.scores:"
CERTIFICATE = 2  # raised where the same recording certifies another level or raises the alarm elsewhere


@dataclass
class RiskSkipSettings:
    """A gate on a score, calibrated so that the risk of what it trusts is at most epsilon, and audited (§4.6). The
    draft is the in-prefill one, of `merged` its first source's; without one, what the method retrieves."""

    kind: str = "risk"
    score: str = "odds"
    epsilon: float = number(0.15, above=0, most=0.99)  # mean loss of unverified drafts
    delta: float = number(0.1, above=0, most=0.5)  # probability that the calibration, or an alarm, errs
    level: float | None = number(None, -1e9, 1e9)  # least score that is trusted; None: the certified one
    audit: float = number(0.05, 0, 1)  # p_a, share of trusted drafts that are verified all the same
    opening: int = number(1, 0, MOST_DECODES)  # first decodes of an episode that are verified
    doubt: float = number(
        1.0, above=0, most=2
    )  # a verified draft of this loss or more has the next one verified; 2: none


def check_risk(settings: RiskSkipSettings) -> None:
    """Raises UnknownName for a score that does not exist."""
    find("score", settings.score, "skip.score")


def needs_of_risk(settings: RiskSkipSettings) -> tuple[str, ...]:
    """What the score reads, and the recording that certifies a level, unless one is given."""
    certified = ("risk",) if settings.level is None else ()
    return (*certified, *find("score", settings.score, "skip.score").needs(None))


def hash_of_recording(path: Path) -> str:
    """Hash of a recording's description and of what is made of it: another certificate is other work."""
    return hashlib.sha256(f"{sha256_of(path)} {CERTIFICATE}".encode()).hexdigest()


add("artifact", "risk", "kerv_cli.methods.risk.recording:RiskArtifact")
add("artifact", "score", _SCORES + "ScoreArtifact")
_gate = ("kerv_cli.methods.risk.gate:RiskSkip.build", RiskSkipSettings, needs_of_risk, check_risk)
add("skip", "risk", *_gate, colour=0x3B6FB6, takes_draft=True, merges=True, retrieves=True)
for _name, _score, _needs in (
    ("odds", "Odds", ("early",)),
    ("entropy", "Entropy", ("early",)),
    ("familiarity", "Familiarity", ("early",)),
    ("steadiness", "Steadiness", ()),
    ("agreement_hold", "agreement_hold", ()),
    ("agreement_retrieval", "agreement_retrieval", ("datastore",)),
    ("similarity", "Similarity", ("datastore",)),
    ("learned", "Learned", ("early", "score")),
):
    add("score", _name, _SCORES + _score, needs=_needs)
