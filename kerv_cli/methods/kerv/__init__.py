"""KERV (docs/methods.md §3): after a rejection, predict actions from the motion; adapt the threshold to the motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, choice, number
from kerv_cli.base.registry import PREFILL, NoSettings, ProposerPart, RectifierPart, ThresholdPart
from kerv_cli.engine.decisions import Rectified
from kerv_cli.engine.parts import Rectifier, Threshold

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.methods.context import Context
    from kerv_cli.methods.kerv.prediction import Predictor


# --- predictors, and proposers that draft with them (§3.1, §6)


@dataclass(frozen=True, kw_only=True)
class PredictorPart(ProposerPart):
    """A registered predictor of the next actions. It serves as a proposer, and as `rectifier.predictor`.

    The registered function builds a `Predictor` (`prediction.py`), or another object with the attribute `name` and the
    method `predict` of a `Predictor`.
    """

    when: Literal["prefill", "states"] = PREFILL
    chains: bool = True

    def built(self, settings: Any, context: Any) -> Any:
        from kerv_cli.methods.kerv.prediction import PredictionProposer

        return PredictionProposer(self.predictor(context))

    def predictor(self, context: Context) -> Predictor:
        return super().built(self.default, context)


def predictor(settings: NoSettings, context: Context) -> Predictor:
    """Build kerv's own predictor `settings.kind`, with a horizon of all control steps of a chunk."""
    from kerv_cli.methods.kerv.prediction import PREDICTORS, Kalman

    kind, held, horizon = PREDICTORS[settings.kind], context.target.actions.is_strict, context.target.chunk
    if not issubclass(kind, Kalman):
        return kind(held, horizon=horizon)
    fitted = context.calibration
    return kind(held, fitted.noise[kind.name], window=fitted.window, horizon=horizon)


_noise = ("calibration",)  # Kalman filters need the noise that `kerv calibrate` fitted
PredictorPart("hold", colour=0xE69F00)(predictor)
PredictorPart("linear", colour=0x0072B2)(predictor)
PredictorPart("kalman", needs=_noise, colour=0xD55E00)(predictor)
PredictorPart("walk", colour=0x999933)(predictor)

ACCEPTED = "accepted"
DRAFT = "draft"  # value of `rectifier.predictor`: the rejected draft's tokens fill the gap


def find_predictor(name: str) -> PredictorPart:
    predictors = PredictorPart.every()
    if name not in predictors:
        raise UnknownName("rectifier.predictor", name, [*predictors, DRAFT])
    return predictors[name]


# --- what happens after a rejection (§3.1)


@dataclass
class CompensateSettings:
    """KERV: after a rejected draft token, predict the rest of the token's control step."""

    kind: str = "compensate"
    # kalman, hold, linear (ours); walk (public code); draft: the rejected draft's remaining tokens (ours)
    predictor: str = "hold"
    hold_strict: bool = True  # true: strict DoFs keep their last value (ours); false: predicted like others (summary)
    steps: int = number(1, 1, MOST_TOKENS)  # control steps that a prediction may fill (paper: predict length PL)
    use_target_token: bool = True  # true: keep the target's token at the rejected position (ours); false: predict it
    drop: bool = True  # true: end the chunk after the filled steps (ours); false: decode the later steps (paper)
    min_verified: int = number(1, 0, MOST_TOKENS)  # fill a control step only if it has this many committed DoFs
    rest: int = number(0, 0, MOST_DECODES)  # after a compensation, compensate nothing for this many decodes (KERV: 4)

    def check_together(self, prefix: str) -> None:
        if self.predictor != DRAFT:
            find_predictor(self.predictor)
        elif not self.use_target_token:
            raise UsageError(
                "rectifier.predictor=draft goes on after the target's token: leave rectifier.use_target_token=true"
            )

    def needs(self) -> tuple[str, ...]:
        return () if self.predictor == DRAFT else find_predictor(self.predictor).needed(self)


@RectifierPart("compensate", CompensateSettings, needs=CompensateSettings.needs)
class Compensation(Rectifier):
    """KERV: after a rejected draft token, keeps the tokens before it and predicts the rest of the control step.

    `CompensateSettings` say what else is kept and predicted. With `predictor=draft` (ours) the remaining tokens of the
    rejected draft are used first: a draft depends on the observation, a prediction only on past actions.
    """

    def __init__(self, settings: CompensateSettings, predictor: Predictor) -> None:
        self.settings, self.predictor = settings, predictor
        self.uses_target_token = settings.use_target_token
        self.resting = 0

    @classmethod
    def build(cls, settings: CompensateSettings, context: Context) -> Compensation:
        name = "hold" if settings.predictor == DRAFT else settings.predictor
        predictor = find_predictor(name).predictor(context)
        return cls(settings, predictor if settings.hold_strict else predictor.released())

    def reset(self) -> None:
        self.resting = 0

    def next_decode(self) -> None:
        self.resting = max(0, self.resting - 1)

    def rectify(self, chunk: Chunk) -> Rectified | None:
        from kerv_cli.methods.kerv.prediction import assemble

        if self.resting:
            return None
        tokens = chunk.tokens if self.settings.use_target_token else chunk.tokens[:-1]
        rest = chunk.judged.rest[1:] if self.settings.predictor == DRAFT else []
        drafted = [chunk.judged.tree.tokens[node] for node in rest]
        values = assemble(tokens, chunk, self.predictor, self.settings, drafted)
        if values is None or (not self.settings.drop and values.size <= len(tokens)):
            return None
        # + 1, because `next_decode` also counts the decode that compensated
        self.resting = self.settings.rest + 1
        return Rectified(values, self.settings.drop)


# --- thresholds: the acceptance radius r in bins (§3.2). It is stored as a real number and rounded for use


class RadiusRange:
    """Settings with a smallest and a largest acceptance radius, in bins."""

    r_min: int
    r_max: int

    def check_together(self, prefix: str) -> None:
        if self.r_min > self.r_max:
            raise UsageError(
                f"threshold.r_min={self.r_min} threshold.r_max={self.r_max}: r_min must not be above r_max"
            )


@dataclass
class KinematicThresholdSettings(RadiusRange):
    """KERV: the acceptance radius r follows the variability K, the distance of the last drafts to the target's tokens.

    KERV's authors leave open how Δr = (r_max − r_min) · exp(−(ΔK / K_S)^φ) changes r (docs/methods.md §3.2). Each
    interpretation is one kind of threshold:

    - `offset`: r = r_min + Δr, as KERV's README says. r shrinks when K changes.
    - `quoted`: r ← r + Δr, as the formula is printed. r never shrinks.
    - `change`: r shrinks when K has risen.
    """

    kind: str = "offset"
    r_min: int = number(5, 0, MOST_BINS)  # smallest radius, bins
    r_max: int = number(15, 0, MOST_BINS)  # largest radius, bins
    phi: float = number(2.0, above=0, most=50)  # exponent φ of K / K_S
    k_s: float | None = number(None, above=0, most=1e9)  # reference level K_S of K; None: the task's calibrated value
    over: str = choice(
        "compared",
        "compared",
        ACCEPTED,
        help="draft tokens that count for K: with the rejected ones, or without (README)",
    )
    total: bool = False  # true: K is the sum of the differences (summary); false: their mean (ours)

    @property
    def measure(self) -> str:
        return f"{'sum' if self.total else 'mean'} of {self.over}"

    def needs(self) -> tuple[str, ...]:
        return ("calibration",) if self.k_s is None else ()


@dataclass
class ScheduleThresholdSettings(RadiusRange):
    """KERV's public code: the acceptance radius falls with the number t of decodes in the episode.

    r(t) = r_min + (r_max − r_min) · exp(−(t / τ)^φ). The robot's motion does not change r.
    """

    kind: str = "schedule"
    r_min: int = number(3, 0, MOST_BINS)  # smallest radius, bins
    r_max: int = number(15, 0, MOST_BINS)  # radius of the first decode, bins
    phi: float = number(3.0, above=0, most=50)  # exponent φ of t / τ
    tau: float = number(20.0, above=0, most=1e9)  # time constant τ, in decodes


class Variable(Threshold):
    """KERV: the acceptance radius r follows the variability K, the distance of draft tokens to target tokens.

    Let f(x) = r_min + (r_max − r_min) · exp(−(x / K_S)^φ), and let ΔK be the change of K since the last decode that
    compared drafts. After each such decode, r becomes:

    - `change`: r ± (r_max − f(|ΔK|)). r shrinks if K has risen, and grows if K has fallen.
    - `offset` (KERV's README): f(|ΔK|). So r is large while K is steady.
    - `quoted` (arXiv 2603.01581): r + f(|ΔK|) − r_min. r never shrinks: it rises from r_min to r_max and stays.

    r is limited to r_min … r_max. K_S is the task's reference level. An episode begins with r = f(K_S), for `quoted`
    with r = r_min. The first ΔK is K − K_S.

    Attributes:
        r: The radius of the next decode, in bins, not rounded.
        last: K of the last decode in which drafts were compared.
    """

    def __init__(self, settings: KinematicThresholdSettings, context: Context) -> None:
        self.settings, self.measure = settings, settings.measure
        if settings.k_s is not None:
            self.k_s = settings.k_s
        else:
            self.k_s = context.calibration.k_s(context.task, self.measure)
            if settings.total and context.chunk:  # a sum over fewer control steps than the calibration's
                self.k_s *= context.chunk / context.target.chunk
        self.reset()

    def reset(self) -> None:
        self.last = self.k_s
        self.r = float(self.settings.r_min) if self.settings.kind == "quoted" else self.falling(self.k_s)

    def falling(self, x: float) -> float:
        s = self.settings
        return falling(s.r_min, s.r_max, x / self.k_s, s.phi)

    def radius(self) -> int:
        return nearest(self.r)

    def update(self, variability: float | None) -> None:
        if variability is None:
            return
        s, change = self.settings, variability - self.last
        if s.kind == "change":
            r = self.r - math.copysign(s.r_max - self.falling(abs(change)), change)
        elif s.kind == "quoted":
            r = self.r + self.falling(abs(change)) - s.r_min
        else:
            r = self.falling(abs(change))
        self.r, self.last = min(s.r_max, max(s.r_min, r)), variability


for _kind in ("offset", "change", "quoted"):
    ThresholdPart(_kind, KinematicThresholdSettings, radius="r_max", needs=KinematicThresholdSettings.needs)(Variable)


@ThresholdPart("schedule", ScheduleThresholdSettings, radius="r_max")
class Schedule(Threshold):
    """The acceptance radius falls with the number t of decodes in the episode. The robot's motion does not change it.

    The default settings are those of KERV's public code: r(t) = 3 + 12 · exp(−(t / 20)³).
    """

    def __init__(self, settings: ScheduleThresholdSettings, context: Context) -> None:
        self.settings, self.decodes = settings, 0

    def reset(self) -> None:
        self.decodes = 0

    def radius(self) -> int:
        s = self.settings
        return nearest(falling(s.r_min, s.r_max, self.decodes / s.tau, s.phi))

    def update(self, variability: float | None) -> None:
        self.decodes += 1


def falling(low: float, high: float, x: float, phi: float) -> float:
    """Return low + (high − low) · exp(−x^φ). It is `high` for x ≤ 0, and falls to `low` for large x."""
    if x <= 0:
        return float(high)
    power = math.exp(min(700.0, phi * math.log(x)))  # x^φ without overflow; exp(−e^700) is zero
    return low + (high - low) * math.exp(-power)


def nearest(r: float) -> int:
    return math.floor(r + 0.5)  # halves up
