"""Every setting a command can take, as plain dataclasses. The YAML files under `conf/` fill them.

Nothing heavy is imported here: a wrong override must be answered before torch or MuJoCo load.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

EVALUATION_SEED = 100_000
"""First evaluation seed. Demonstrations use seeds below it, so training and evaluation never share a world."""

SPARE = "?"
"""Behind a source of an opening: it drafts only where the others are not sure of their chunk."""


def opening_sources(sources: Iterable[str]) -> list[str]:
    """Names of an opening's sources, spare ones included, in their order."""
    return [name.removesuffix(SPARE) for name in sources]


@dataclass
class CameraSettings:
    name: str = ""  # empty: the environment's first camera
    fovy: float = 45.0
    size: int = 96  # pixels, square
    supersample: int = 2


@dataclass
class WorldSettings:
    camera: CameraSettings = field(default_factory=CameraSettings)
    horizon: int = 0  # control steps; 0: the environment's


@dataclass
class RuntimeSettings:
    device: str = "cpu"  # cpu | cuda | auto
    dtype: str = "float32"
    threads: int = 1  # torch threads of each process
    workers: int = 1  # processes


@dataclass
class ProposerSettings:
    """Who drafts (METHODS §2.2, §4, §5)."""

    kind: str = "none"  # none | drafter | retrieval | hybrid | early | jacobi | hold | linear | kalman | … | expert
    depth: int = 5  # draft depth, tokens
    top_k: int = 8  # drafter: children expanded per level
    nodes: int = 50  # tree nodes kept after reranking
    neighbours: int = 5  # retrieval, hybrid: stored chunks


@dataclass
class AcceptanceSettings:
    """Which drafts are good enough (METHODS §2.1)."""

    kind: str = "strict"  # strict | relaxed | sequence | hybrid (sequence for retrieved drafts, relaxed for others)
    strict_gripper: bool = False  # the gripper's tokens must equal the verdict
    group_limit: int = 30  # sequence: summed bias of a kinematic group, bins
    token_limit: int = 15  # sequence: bias of one token, bins


@dataclass
class ThresholdSettings:
    """How far a draft may be from the verdict (METHODS §3.2)."""

    kind: str = "fixed"  # fixed | kinematic | change | schedule
    r: int = 0  # fixed: bins
    r_min: int = 5  # others: bins, as r_max
    r_max: int = 15
    phi: float = 2.0  # exponent of the level (kinematic), the move (change) or the time (schedule)
    k_s: float | None = None  # reference level K_S of K; None: the task's, from the calibration
    tau: float = 20.0  # schedule: decodes


@dataclass
class RectifierSettings:
    """What happens after a rejection (METHODS §3.1)."""

    kind: str = "reinfer"  # reinfer | compensate
    predictor: str = "hold"  # compensate: hold | linear | kalman | … | draft (the rejected draft's own values, ours)
    steps: int = 1  # PL: control steps that a prediction may fill
    use_verdict: bool = True  # the verdict at the rejected position is kept (ours); false: predicted too (KERV)
    min_verified: int = 1  # DoFs of a step that must be known for it to be filled
    rest: int = 0  # decodes without compensation after one (KERV: 4)
    max_dropped: int = -1  # control steps of the chunk that a compensation may drop; -1: any number (KERV)


@dataclass
class BoundarySettings:
    """Which proposer drafts now (METHODS §4.4)."""

    kind: str = "always"  # always (the method's only proposer) | always_retrieval | always_drafter | fused | random
    alpha: float = 0.5  # weight of the radius of curvature against the path length
    window: int = 15  # newest measured positions that are looked at
    f_star: float = 0.5  # fused metric from which retrieval drafts
    p: float = 0.5  # random: probability of retrieval
    seed: int = 0  # random


@dataclass
class SkipSettings:
    """When a retrieved chunk is executed without a verification (METHODS §4.3)."""

    kind: str = "none"  # none | similarity
    s_min: float | None = None  # least similarity; None: the task's, from the calibration
    max_skips: int = 2  # decodes in a row without a verification
    up: float = 0.25  # share of the calibrated range that s_min rises after a failed episode
    down: float = 0.05  # and falls after a successful one


@dataclass
class OpeningSettings:
    """What is drafted before the prefill and verified inside it (METHODS §5, ours)."""

    sources: list[str] = field(default_factory=list)  # early | retrieval | a predictor; with "?": a spare
    nodes: int = 64  # tree nodes at most; what is named last is dropped first
    neighbours: int = 3  # retrieval: stored chunks


@dataclass
class MethodSettings:
    """A method is a composition of parts, never a class of its own."""

    name: str = "ar"
    proposer: ProposerSettings = field(default_factory=ProposerSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    threshold: ThresholdSettings = field(default_factory=ThresholdSettings)
    rectifier: RectifierSettings = field(default_factory=RectifierSettings)
    boundary: BoundarySettings = field(default_factory=BoundarySettings)
    opening: OpeningSettings = field(default_factory=OpeningSettings)
    skip: SkipSettings = field(default_factory=SkipSettings)
    chunk: int = 0  # H, control steps decoded at once; 0: as many as the target was trained for


@dataclass
class PolicySettings:
    """Which weights: a name under results/pretrained or results/artifacts/target, or a folder."""

    target: str = "mt10-vision"
    drafter: str | None = None  # default: the drafter beside the target
    early: str | None = None  # default: the early drafter beside the target


@dataclass
class DatastoreSettings:
    """Who searches the datastore (METHODS §4.1): every backend gives the same neighbours."""

    backend: str = "exact"  # exact (in process, numpy) | qdrant (optional)
    url: str | None = None  # qdrant: a server; None: the engine in this process


@dataclass
class RolloutSettings:
    """`kerv rollout`: episodes of one method."""

    task: list[str] = field(default_factory=lambda: ["MT10"])  # task names and suites
    episodes: int = 3  # per task
    seed: int = EVALUATION_SEED  # first seed; episode i uses seed + i in every setting: that is the pairing
    policy: PolicySettings = field(default_factory=PolicySettings)
    method: str = "ar"  # name of the composition; its parts follow
    opening: OpeningSettings = field(default_factory=OpeningSettings)
    proposer: ProposerSettings = field(default_factory=ProposerSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    threshold: ThresholdSettings = field(default_factory=ThresholdSettings)
    rectifier: RectifierSettings = field(default_factory=RectifierSettings)
    boundary: BoundarySettings = field(default_factory=BoundarySettings)
    skip: SkipSettings = field(default_factory=SkipSettings)
    chunk: int = 0  # H, control steps decoded at once; 0: as many as the target was trained for
    datastore: DatastoreSettings = field(default_factory=DatastoreSettings)
    world: WorldSettings = field(default_factory=WorldSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    deviation_every: int = 0  # decodes between two deviation samples; 0: never
    record: int = 1  # episodes per task that are saved as .rrd; -1: all
    record_size: int = 240  # pixels of the logged camera
    results: str = "results"

    def parts(self) -> MethodSettings:
        """The method's parts alone: what a decoder is built from."""
        return MethodSettings(
            name=self.method,
            proposer=self.proposer,
            acceptance=self.acceptance,
            threshold=self.threshold,
            rectifier=self.rectifier,
            boundary=self.boundary,
            opening=self.opening,
            skip=self.skip,
            chunk=self.chunk,
        )


@dataclass
class StudySettings:
    """`conf/study/*.yaml`: which settings are compared."""

    name: str = "threshold"
    title: str = ""
    baseline: str = "ar"  # label of the setting that the others are compared with
    common: str = ""  # overrides of every setting, e.g. task=MT10 episodes=20; the command line's outrank them
    settings: dict[str, str] = field(default_factory=dict)  # label -> overrides; comma lists expand into a grid
    axis: str = ""  # config key on the plot's x axis, e.g. threshold.r


@dataclass
class SweepSettings:
    """`kerv sweep`: a study. Everything else on the command line goes to each of its settings."""

    study: StudySettings = field(default_factory=StudySettings)
    results: str = "results"


@dataclass
class TargetSettings:
    """Shapes of the target (METHODS §0). `conf/target/*.yaml` are the sizes."""

    size: str = "small"
    observation: str = "vision"  # vision | state (privileged: the places' positions are given)
    width: int = 192
    layers: int = 8
    heads: int = 6
    feed_forward: int = 512
    chunk: int = 4  # H, control steps per decode
    grid: int = 4  # vision tokens per side
    keypoints: int = 32  # spatial soft-argmax points of the vision encoder
    channels: int = 24  # width of the vision encoder's first stage
    scene_tokens: int = 4  # tokens that carry the places' positions, estimated (vision) or given (state)
    instruction_tokens: int = 10
    image_size: int = 96


@dataclass
class TrainSettings:
    """Optimisation. The batch of step s depends on (seed, s) alone, so a resumed run repeats the uninterrupted one."""

    steps: int = 20_000
    batch: int = 64
    lr: float = 1e-3
    warmup: int = 300
    weight_decay: float = 0.02
    clip: float = 1.0
    ema: float = 0.999
    init: str | None = None  # target whose weights the run begins with; its chunk may be shorter or longer
    label_sigma: float = 1.0  # bins; neighbouring bins share probability (Gaussian); 0: one-hot
    scene_weight: float = 1.0  # weight of the position loss (vision only)
    scene_steps: int = 0  # first steps that train only the vision encoder, on positions
    held_out: float = 0.1  # share of episodes kept for validation
    validate_every: int = 2_000
    closed_loop: int = 0  # episodes per task and validation, closed loop
    seed: int = 0
    bf16: bool = True  # autocast the training forward to bfloat16
    half: bool = False  # weights on disk in float16: half the size, for shipping


@dataclass
class TrainTargetSettings:
    """`kerv train target`."""

    name: str = "mt10-vision"
    demos: str = "mt10"
    task: list[str] = field(default_factory=lambda: ["MT10"])
    target: TargetSettings = field(default_factory=TargetSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    world: WorldSettings = field(default_factory=WorldSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


@dataclass
class DemosSettings:
    """`kerv demos`."""

    name: str | None = None  # default: the tasks' names, in small letters
    task: list[str] = field(default_factory=lambda: ["MT10"])
    episodes: int = 100  # per task
    seed: int = 0
    perturbed: float = 0.5
    frame_stride: int = 2
    world: WorldSettings = field(default_factory=WorldSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


@dataclass
class DrafterSettings:
    """Shapes of a drafter. eagle: decoder layers of the target's width, behind its states (METHODS §2.2). early: a
    residual network from the prompt and the last actions to the whole chunk, before the target runs (METHODS §5)."""

    kind: str = "eagle"  # eagle | early
    layers: int = 1
    width: int = 512  # early: hidden units
    rank: int = 64  # early: features per token in front of the bins
    history: int = 2  # early: last executed actions it is shown
    noise: float = 0.0  # uniform noise on the input states, training only
    unroll: int = 3  # passes that feed the drafter its own predicted states, as drafting does; 1: the paper's
    samples: int = 12_000  # observations whose greedy decodes it is trained on
    state_weight: float = 1.0  # smooth-L1 on the hidden state
    token_weight: float = 0.1  # soft cross-entropy with the target's distribution


@dataclass
class TrainDrafterSettings:
    """`kerv train drafter`."""

    policy: PolicySettings = field(default_factory=PolicySettings)  # policy.drafter: where the drafter is put
    demos: str = "mt10"
    drafter: DrafterSettings = field(default_factory=DrafterSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


@dataclass
class DoctorSettings:
    """`kerv doctor`."""

    seed: int = EVALUATION_SEED
    world: WorldSettings = field(default_factory=WorldSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


@dataclass
class ReportSettings:
    """`kerv report`."""

    only: str | None = None  # name of one study (study=NAME on the command line); default: all that are there
    results: str = "results"


@dataclass
class ViewSettings:
    """`kerv view`."""

    results: str = "results"


@dataclass
class BuildDatastoreSettings:
    """`kerv build datastore` (METHODS §4.1)."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: datastore/ beside the target
    demos: str = "mt10"
    task: list[str] = field(default_factory=lambda: ["MT10"])
    episodes: int = 0  # per task, the first ones by seed; 0: all
    stride: int = 1  # of an episode's observations every so many become entries
    half: bool = False  # keys on disk in float16: half the size, for shipping
    key: list[str] = field(default_factory=lambda: ["scene"])  # pooled parts of the prompt; also vision, proprioception
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


@dataclass
class CalibrateSettings:
    """`kerv calibrate`: noise of the kinematic predictors, and the reference level K_S of each task (METHODS §3)."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: beside the target
    demos: str = "mt10"
    task: list[str] = field(default_factory=lambda: ["MT10"])
    episodes: int = 0  # per task, the first ones by seed; 0: all
    held_out: float = 0.1  # share of episodes that the errors are measured on
    history: str = "labels"  # what predictions are made from: labels (clean) | executed (perturbed episodes: noisy)
    window: int = 10  # control steps of history
    fit_steps: int = 0  # steps ahead whose mean error is fitted; 0: the target's chunk
    epsilon: float = 0.1  # verify-skip: mean abs error of a retrieved chunk that is good enough, normalised units
    confidence: float = 0.9  # verify-skip: share of skipped chunks whose error stays below epsilon
    boundary_windows: list[int] = field(default_factory=lambda: [5, 15, 30])  # positions; each has ranges of its own
    decodes: int = 60  # pre-sampling, per task: decodes whose median variability is K_S; 0: none
    proposer: ProposerSettings = field(default_factory=ProposerSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    threshold: ThresholdSettings = field(default_factory=ThresholdSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    results: str = "results"


def as_plain(settings: Any) -> dict[str, Any]:
    """A settings dataclass as nested dicts and lists."""
    return asdict(settings)
