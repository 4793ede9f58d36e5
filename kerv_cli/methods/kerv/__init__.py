"""KERV (docs/methods.md §3): a kinematic prediction after a rejection, and thresholds that follow the motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, NoSettings, Part, add, parts

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context

_PREDICTION = "kerv_cli.methods.kerv.prediction:"

_sources = ("drafter", "datastore")  # each has a section
add(
    "artifact",
    "calibration",
    "kerv_cli.methods.calibration:CalibrationArtifact",
    needs=_sources,
    by_task=True,
    needs_task=True,
)

# --- predictors, and proposers that draft by them (§3.1, §6)

for _name, _fitted, _colour in (
    ("hold", False, 0xE69F00),
    ("linear", False, 0x0072B2),
    ("kalman", True, 0xD55E00),  # a filter reads the noise that `kerv calibrate` fitted
    ("damped", True, 0xA0522D),
):
    _drafts = (_PREDICTION + "PredictionProposer.build", NoSettings, ("calibration",) if _fitted else ())
    _predictor = _PREDICTION + "predictor_of"
    add("proposer", _name, *_drafts, colour=_colour, when=PREFILL, chains=True, predictor=_predictor)

DRAFT = "draft"
"""`rectifier.predictor` that fills from the rejected draft instead of from a kinematic predictor."""


def find_predictor(name: str) -> Part:
    """Return the proposer whose predictor has this name.

    Raises:
        UnknownName: There is none.
    """
    predictors = {key: part for key, part in parts("proposer").items() if "predictor" in part.traits}
    if name not in predictors:
        raise UnknownName("rectifier.predictor", name, [*predictors, DRAFT])
    return predictors[name]


# --- what happens after a rejection (§3.1)


@dataclass
class CompensateSettings:
    """KERV: predict the rest of the rejected control step, drop the rest of the chunk."""

    kind: str = "compensate"
    predictor: str = "hold"  # a predictor, or draft: the rejected draft's remaining tokens (ours)
    steps: int = number(1, 1, MOST_TOKENS)  # PL: control steps that a prediction may fill
    use_target_token: bool = True  # ours: the target's token at the rejected position is kept; false: predicted (KERV)
    min_verified: int = number(1, 0, MOST_TOKENS)  # DoFs of a step that must be known for it to be filled
    rest: int = number(0, 0, MOST_DECODES)  # decodes without compensation after one (KERV: 4)
    max_dropped: int = number(-1, -1, MOST_TOKENS)  # control steps that a compensation may drop; -1: any (KERV)

    def check_together(self, prefix: str) -> None:
        """Refuse a predictor that does not exist, and a draft without the target's token before it."""
        if self.predictor != DRAFT:
            find_predictor(self.predictor)
        elif not self.use_target_token:
            raise UsageError(
                "rectifier.predictor=draft goes on after the target's token: leave rectifier.use_target_token=true"
            )


def needs_of_compensation(settings: CompensateSettings) -> tuple[str, ...]:
    """Return what the predictor reads."""
    return () if settings.predictor == DRAFT else find_predictor(settings.predictor).needs(None)


_compensation = (_PREDICTION + "Compensation.build", CompensateSettings)
add("rectifier", "compensate", *_compensation, needs_of_compensation)


# --- thresholds: the acceptance radius r, in bins (§3.2), kept as a real number and rounded for use


class RadiusRange:
    """Settings with a smallest and a largest radius."""

    r_min: int
    r_max: int

    def check_together(self, prefix: str) -> None:
        """Refuse radii that are not in order."""
        if self.r_min > self.r_max:
            raise UsageError(
                f"threshold.r_min={self.r_min} threshold.r_max={self.r_max}: r_min must not be above r_max"
            )


@dataclass
class KinematicThresholdSettings(RadiusRange):
    """KERV: the radius follows the kinematic variability K of the decode before.

    `change` is an ablation: the radius moves against the change of K.
    """

    kind: str = "kinematic"
    r_min: int = number(5, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(2.0, above=0, most=50)
    k_s: float | None = number(None, above=0, most=1e9)  # reference level of K; None: the task's, from the calibration


@dataclass
class ScheduleThresholdSettings(RadiusRange):
    """KERV's public code, r = 3 + 12 exp(−(t / τ)³) in decode t: open loop, K is not used."""

    kind: str = "schedule"
    r_min: int = number(3, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(3.0, above=0, most=50)
    tau: float = number(20.0, above=0, most=1e9)  # decodes


def needs_of_variability(settings: KinematicThresholdSettings) -> tuple[str, ...]:
    """Return the calibration if no reference level is given."""
    return ("calibration",) if settings.k_s is None else ()


class Kinematic:
    """KERV, level form: r = r_min + (r_max − r_min) · exp(−(K / K_S)^φ), K of the last decode that compared anything.

    An episode begins at K = K_S, the reference level.
    """

    def __init__(self, settings: KinematicThresholdSettings, context: Context) -> None:
        """Take K_S of the task from the calibration, if the settings give none.

        Raises:
            UsageError: A radius above the largest distance of two tokens.
        """
        context.check_radius("r_max", settings.r_max)
        self.r_min, self.r_max, self.phi = settings.r_min, settings.r_max, settings.phi
        self.k_s = settings.k_s if settings.k_s is not None else context.calibration.k_s(context.task)
        self.reset()

    def reset(self) -> None:
        """Set r as after a decode with K = K_S."""
        self.r = self.level(self.k_s)

    def level(self, variability: float) -> float:
        """Return r, not rounded, for K in normalised action units."""
        return falling(self.r_min, self.r_max, variability / self.k_s, self.phi)

    def radius(self) -> int:
        """Return r rounded to the nearest bin."""
        return nearest(self.r)

    def update(self, variability: float | None) -> None:
        """Set r from K. A decode without K leaves it."""
        if variability is not None:
            self.r = self.level(variability)


class Change(Kinematic):
    """Ablation: r shrinks when K grows and grows when K shrinks.

    r ← clamp(r − (r_max − r_min) · sign(Δ) · (1 − exp(−|Δ / K_S|^φ)), r_min, r_max), Δ = K_t − K_{t−1} over decodes
    that compared something. An episode begins with K_{t−1} = K_S.
    """

    def reset(self) -> None:
        """Set r as after a decode with K = K_S, which is also the K to compare with."""
        super().reset()
        self.last = self.k_s

    def update(self, variability: float | None) -> None:
        """Move r against the change of K. A decode without K leaves it."""
        if variability is None:
            return
        change = (variability - self.last) / self.k_s
        move = (self.r_max - self.r_min) - falling(0, self.r_max - self.r_min, abs(change), self.phi)
        self.r = min(self.r_max, max(self.r_min, self.r - math.copysign(move, change)))
        self.last = variability


class Quoted(Change):
    """KERV's threshold as quoted (arXiv 2603.01581): r ← min(r + (r_max − r_min) · exp(−(|ΔK| / K_S)^φ), r_max).

    The addend is never negative, so r climbs from r_min to r_max and stays there.
    """

    def reset(self) -> None:
        """Begin at r_min."""
        self.r, self.last = float(self.r_min), self.k_s

    def update(self, variability: float | None) -> None:
        """Raise r by the less the more K changed. A decode without K leaves it."""
        if variability is not None:
            change = abs(variability - self.last) / self.k_s
            self.r = min(self.r_max, self.r + falling(0, self.r_max - self.r_min, change, self.phi))
            self.last = variability


class Schedule:
    """Open loop: r(t) = r_min + (r_max − r_min) · exp(−(t / τ)^φ), t decodes into the episode.

    The defaults are KERV's public code: 3 + 12 · exp(−(t / τ)^3).
    """

    def __init__(self, settings: ScheduleThresholdSettings, context: Context) -> None:
        """Take the settings. The errors are those of `Kinematic`."""
        context.check_radius("r_max", settings.r_max)
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Start again at t = 0."""
        self.decodes = 0

    def radius(self) -> int:
        """Return r(t) rounded to the nearest bin."""
        s = self.settings
        return nearest(falling(s.r_min, s.r_max, self.decodes / s.tau, s.phi))

    def update(self, variability: float | None) -> None:
        """Increase t. K is not used."""
        self.decodes += 1


def falling(low: float, high: float, x: float, phi: float) -> float:
    """Return low + (high − low) · exp(−x^φ): `high` at x ≤ 0, falling to `low`."""
    if x <= 0:
        return float(high)
    power = math.exp(min(700.0, phi * math.log(x)))  # x^φ without overflow; exp(−e^700) is zero
    return low + (high - low) * math.exp(-power)


def nearest(r: float) -> int:
    """Return r rounded to the nearest bin, halves up."""
    return math.floor(r + 0.5)


_kinematic = (KinematicThresholdSettings, needs_of_variability)
add("threshold", "kinematic", f"{__name__}:Kinematic", *_kinematic)
add("threshold", "change", f"{__name__}:Change", *_kinematic)
add("threshold", "quoted", f"{__name__}:Quoted", *_kinematic)
add("threshold", "schedule", f"{__name__}:Schedule", ScheduleThresholdSettings)
