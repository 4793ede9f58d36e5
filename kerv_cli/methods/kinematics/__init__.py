"""KERV (docs/methods.md §3): kinematic predictions as drafts, a prediction instead of decoding on after a rejection,
and thresholds that follow the motion. Settings and registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, NoSettings, add, find

_PREDICTION = "kerv_cli.methods.kinematics.prediction:"
_THRESHOLDS = "kerv_cli.methods.kinematics.thresholds:"

add("artifact", "calibration", "kerv_cli.methods.calibration:CalibrationArtifact")

# --- predictors, and proposers that draft by them (§3.1, §6)

for _name, _fitted, _colour in (
    ("hold", False, 0xE69F00),
    ("linear", False, 0x0072B2),
    ("kalman", True, 0xD55E00),  # a filter reads the noise that `kerv calibrate` fitted
    ("damped", True, 0xA0522D),
    ("acceleration", True, 0x4C9F70),
):
    add("predictor", _name, _PREDICTION + "predictor_of", fitted=_fitted)
    _drafts = (_PREDICTION + "PredictionProposer.build", NoSettings, ("calibration",) if _fitted else ())
    add("proposer", _name, *_drafts, colour=_colour, when=PREFILL, chains=True)
add("predictor", "draft", fitted=False)  # of a rectifier only: the rejected draft's remaining tokens


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


def check_compensate(settings: CompensateSettings) -> None:
    """Raises UnknownName for a predictor that does not exist, UsageError for one that lacks the target's token."""
    find("predictor", settings.predictor, "rectifier.predictor")
    if settings.predictor == "draft" and not settings.use_target_token:
        raise UsageError(
            "rectifier.predictor=draft goes on behind the target's token: leave rectifier.use_target_token=true"
        )


def needs_of_compensation(settings: CompensateSettings) -> tuple[str, ...]:
    """What the predictor reads."""
    return ("calibration",) if find("predictor", settings.predictor).traits.get("fitted") else ()


_compensation = (_PREDICTION + "Compensation.build", CompensateSettings)
add("rectifier", "compensate", *_compensation, needs_of_compensation, check_compensate)


# --- thresholds: r, in bins (§3.2)


@dataclass
class KinematicThresholdSettings:
    """KERV: the radius follows the kinematic variability K of the decode before. `change`: it moves against the change
    of K (ablation)."""

    kind: str = "kinematic"
    r_min: int = number(5, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(2.0, above=0, most=50)
    k_s: float | None = number(None, above=0, most=1e9)  # reference level of K; None: the task's, from the calibration


@dataclass
class ScheduleThresholdSettings:
    """KERV's public code, r = 3 + 12 exp(−(t / τ)³) in decode t: open loop, K is not used."""

    kind: str = "schedule"
    r_min: int = number(3, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(3.0, above=0, most=50)
    tau: float = number(20.0, above=0, most=1e9)  # decodes


def check_radii(settings: KinematicThresholdSettings | ScheduleThresholdSettings) -> None:
    """Raises UsageError for radii that are negative or not in order."""
    if not 0 <= settings.r_min <= settings.r_max:
        raise UsageError(
            f"threshold.r_min={settings.r_min} threshold.r_max={settings.r_max}: bins from 0 on, r_min not above r_max"
        )


def needs_of_variability(settings: KinematicThresholdSettings) -> tuple[str, ...]:
    """The calibration, where no reference level is given."""
    return ("calibration",) if settings.k_s is None else ()


for _name, _class in (("kinematic", "Kinematic"), ("change", "Change")):
    _kinematic = (f"{_THRESHOLDS}{_class}.build", KinematicThresholdSettings, needs_of_variability, check_radii)
    add("threshold", _name, *_kinematic)
add("threshold", "schedule", _THRESHOLDS + "Schedule.build", ScheduleThresholdSettings, check=check_radii)
