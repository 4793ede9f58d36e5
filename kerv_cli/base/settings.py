"""The settings of every command, as plain dataclasses; the YAML files under `conf/` hold what differs from them.

Nothing heavy is imported here: a wrong override is answered before torch or MuJoCo load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from kerv_cli.base import manifests
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number
from kerv_cli.base.registry import METHOD_KINDS, PART_GROUPS, find, part_of

EVALUATION_SEED = 100_000
"""First evaluation seed. Demonstrations use seeds below it, so training and evaluation never share a world."""

MOST_STRESS = 4
"""The highest level of every kind of stress."""

LOSS_SCALE = 0.1
"""ε_a: mean abs difference of two chunks that counts as a whole loss, normalised action units."""


def chosen(kind: str, name: str = "none") -> Callable[[], Any]:
    """Makes the settings of the part `name`: the default of a group."""
    return lambda: find(kind, name).settings(kind=name)


@dataclass
class CameraSettings:
    """The policy's view: a camera of the environment, vertical field of view in degrees, pixels, supersampling."""

    name: str = ""  # empty: the environment's first camera; joined names are several views side by side
    fovy: float = number(45.0, above=0, most=179)
    size: int = number(96, 8, 4096)  # pixels of a view, square
    supersample: int = number(2, 1, 16)


@dataclass
class WorldSettings:
    """The simulated world of an episode."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    horizon: int = number(0, 0, 1_000_000)  # control steps; 0: the environment's


WAITS, REAL = "waits", "real"
MEASURED, CONSTANT, PROFILE = "measured", "constant", "profile"


@dataclass
class TimingSettings:
    """What the world does while the policy decodes (docs/methods.md §8)."""

    clock: str = choice(WAITS, WAITS, REAL)  # waits: it stands still; real: it goes on for as long as the decode takes
    latency: str = choice(MEASURED, MEASURED, CONSTANT, PROFILE)  # of a decode
    latency_ms: float = number(0.0, 0, 600_000)  # latency=constant
    profile: str = ""  # latency=profile: a document of `kerv bench`, its path or its name in <results>/bench
    # an autoregressive decode of the same target takes so long, all others in proportion; 0: as measured or profiled
    ar_ms: float = number(0.0, 0, 600_000)
    delay_compensation: str = choice("none", "none", "chunk", "hold", "linear", "kalman", "position")
    batch: int = number(1, 1, 1024)  # episodes whose decodes are computed together; above 1: for success, without times

    def check_together(self, prefix: str) -> None:
        """Raises UsageError for latency=profile without a profile, and for a batch in a world that feels its time."""
        if self.batch > 1 and self.clock == REAL:
            raise UsageError(
                f"{prefix}batch={self.batch} with {prefix}clock=real: decodes of a batch have no times, use one of them"
            )
        if self.clock == REAL and self.latency == PROFILE and not self.profile:
            raise UsageError(
                f"{prefix}latency=profile: name a document of 'kerv bench', {prefix}profile=mt10-vision-float32"
            )


@dataclass
class StressSettings:
    """A shift of a stated size, drawn per episode from task, seed, kind and level (docs/stress.md)."""

    kind: str = "none"  # push | actuation | sensor | light | colour | camera | object
    level: int = number(0, 0, MOST_STRESS)  # 0: none

    @property
    def active(self) -> bool:
        """Whether anything is shifted."""
        return self.kind != "none" and self.level > 0

    def check_together(self, prefix: str) -> None:
        """Raises UnknownName for a kind that is not registered, UsageError for a level without a kind."""
        find("stress", self.kind, f"{prefix}kind")
        if self.kind == "none" and self.level:
            raise UsageError(f"{prefix}level={self.level} without {prefix}kind: name what is shifted")


@dataclass
class RolloutWorldSettings(WorldSettings):
    """The world of a rollout, which may be shifted from the one that the policy was trained in."""

    stress: StressSettings = field(default_factory=StressSettings)


@dataclass
class RuntimeSettings:
    """Device, number format and parallelism of a process."""

    device: str = "cpu"  # cpu | cuda | auto
    dtype: str = choice("float32", "float32", "bfloat16", "float16")
    threads: int = number(1, 1, 256)  # torch threads of each process
    executor: str = "local"  # sweeps: what runs the blocks: local (processes here) | slurm | ray
    workers: int = number(1, 1, 4096)  # sweeps: blocks that run at the same time
    executor_options: dict[str, Any] = field(default_factory=dict)  # see lab/executors/registration.py


@dataclass(kw_only=True)
class CommandSettings:
    """Settings of every command."""

    results: str = "results"


@dataclass(kw_only=True)
class RunSettings(CommandSettings):
    """Settings of every command that computes."""

    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)


@dataclass(kw_only=True)
class TaskSettings(RunSettings):
    """Settings of every command that works on tasks."""

    task: list[str] = field(default_factory=lambda: ["MT10"])  # task names and suites


MODEL, EXPERT = "model", "expert"
DERIVED_FROM = ("policy.kind",)
"""Keys of settings that others are derived from when a dataclass is made."""


@dataclass
class PolicySettings:
    """What chooses the actions. Weights are named by folders of results/pretrained or results/artifacts, or paths."""

    kind: str = choice(MODEL, MODEL, EXPERT)  # expert: the environment's script, privileged, the reference of success
    target: str = "mt10-vision"
    drafter: str | None = None  # these: default the one beside the target
    early: str | None = None
    datastore: str | None = None
    calibration: str | None = None
    risk: str | None = None
    score: str | None = None
    others: dict[str, str] = field(default_factory=dict)  # artifacts of parts that are not kerv's: kind -> name

    def named(self, kind: str) -> str | None:
        """The name given for the artifact of this kind, None without one."""
        return self.others.get(kind) or getattr(self, kind, None)


@dataclass
class RolloutSettings(TaskSettings):
    """`kerv rollout`: episodes of one method. Its parts are settings of the classes in kerv_cli/methods."""

    episodes: int = number(3, 1, 1_000_000)  # per task
    # first seed; episode i uses seed + i in every setting: that is the pairing
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1)
    policy: PolicySettings = field(default_factory=PolicySettings)
    method: str = "ar"  # name of the composition; its parts follow
    prefill_draft: Any = field(default_factory=chosen("proposer"))  # a proposer, before the prefill
    proposer: Any = field(default_factory=chosen("proposer"))
    acceptance: Any = field(default_factory=chosen("acceptance", "strict"))
    threshold: Any = field(default_factory=chosen("threshold", "fixed"))
    rectifier: Any = field(default_factory=chosen("rectifier", "reinfer"))
    boundary: Any = field(default_factory=chosen("boundary", "always"))
    skip: Any = field(default_factory=chosen("skip"))
    chunk: int = number(0, 0, 1024)  # H, control steps decoded at once; 0: as many as the target was trained for
    datastore: Any = field(default_factory=chosen("datastore", "exact"))
    world: RolloutWorldSettings = field(default_factory=RolloutWorldSettings)
    rollout: TimingSettings = field(default_factory=TimingSettings)
    deviation_every: int = number(0, 0, 1_000_000)  # decodes between two deviation samples; 0: never
    record: int = number(1, -1, 1_000_000)  # episodes per task that are saved as .rrd; -1: all
    record_size: int = number(240, 8, 4096)  # pixels of the logged camera

    def __post_init__(self) -> None:
        if self.policy.kind == EXPERT:
            self.method = EXPERT  # it decodes nothing, so that no method's name fits

    def parts(self) -> dict[str, Any]:
        """Kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}


@dataclass
class ServeSettings(RunSettings):
    """`kerv serve`: a policy and a method, as in `kerv rollout`, for a client over websockets (docs/serving.md)."""

    host: str = "127.0.0.1"  # nobody but this machine; there is no password
    port: int = number(8000, 0, 65_535)  # 0: a free one
    max_mb: int = number(16, 1, 4096)  # largest message, MiB
    log_every: int = number(100, 0, 10**9)  # answers between two lines of latencies; 0: only at the end of a connection
    gripper: str = "as_is"  # as_is | signed | signed_inverted: how strict DoFs (0 closed to 1 open) are sent
    task_name: str = ""  # task=NAME: the task, for parts whose levels differ between tasks
    policy: PolicySettings = field(default_factory=PolicySettings)
    method: str = "ar"
    prefill_draft: Any = field(default_factory=chosen("proposer"))
    proposer: Any = field(default_factory=chosen("proposer"))
    acceptance: Any = field(default_factory=chosen("acceptance", "strict"))
    threshold: Any = field(default_factory=chosen("threshold", "fixed"))
    rectifier: Any = field(default_factory=chosen("rectifier", "reinfer"))
    boundary: Any = field(default_factory=chosen("boundary", "always"))
    skip: Any = field(default_factory=chosen("skip"))
    chunk: int = number(0, 0, 1024)
    datastore: Any = field(default_factory=chosen("datastore", "exact"))

    def parts(self) -> dict[str, Any]:
        """Kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}


@dataclass
class StudySettings:
    """`conf/study/*.yaml`: which settings are compared."""

    name: str = "threshold"
    title: str = ""
    baseline: str = "ar"  # label of the setting that the others are compared with
    common: str = ""  # overrides of every setting, e.g. task=MT10 episodes=20; the command line's outrank them
    settings: dict[str, str] = field(default_factory=dict)  # label -> overrides; comma lists expand into a grid
    axis: str = ""  # config key on the plot's x axis, e.g. threshold.r
    block: int = number(5, 1, 10_000)  # seeds for which the settings take turns in one process, episode by episode
    repeats: int = number(1, 1, 1_000)  # how often every episode is measured
    note: str = ""  # a sentence that says what to see, printed below the table


@dataclass
class SweepSettings(CommandSettings):
    """`kerv sweep`: a study. Everything else on the command line goes to each of its settings."""

    study: StudySettings = field(default_factory=StudySettings)
    # done: every planned episode; decided: settings stop when their question is answered
    until: str = choice("done", "done", "decided")
    # what is run again although it is there: nothing | settings whose times were not taken in turn with the baseline |
    # cells of other code | everything
    rerun: str = choice("never", "never", "timed", "changed", "all")
    # until=decided: is the loss of success against the baseline below so many points?
    loss: float = number(3.0, above=0, most=99.9)


@dataclass
class TargetSettings:
    """Shapes of the target (docs/methods.md §0). `conf/target/*.yaml` are the sizes."""

    size: str = "small"
    observation: str = choice("vision", "vision", "state")  # state: privileged, the places' positions are given
    width: int = number(192, 2, 65_536)
    layers: int = number(8, 1, 1024)
    heads: int = number(6, 1, 1024)
    feed_forward: int = number(512, 1, 262_144)
    chunk: int = number(4, 1, 1024)  # H, control steps per decode
    grid: int = number(4, 1, 512)  # vision tokens per side
    keypoints: int = number(32, 1, 4096)  # spatial soft-argmax points of the vision encoder
    channels: int = number(24, 1, 4096)  # width of the vision encoder's first stage
    scene_tokens: int = number(4, 1, 1024)  # they carry the places' positions, estimated (vision) or given (state)
    instruction_tokens: int = number(10, 1, 1024)
    image_size: int = number(96, 8, 4096)
    parallel: bool = False  # decodes all tokens of a chunk at once, each without the others (docs/methods.md §6)

    def check_together(self, prefix: str) -> None:
        """Raises UsageError for a width that the heads do not divide, or an image that the grid does not divide."""
        if self.width % (2 * self.heads):
            raise UsageError(f"{prefix}width={self.width} must be a multiple of 2 x {prefix}heads={self.heads}")
        if self.observation == "vision" and self.image_size % (8 * self.grid):
            raise UsageError(f"{prefix}image_size={self.image_size} must be a multiple of 8 x {prefix}grid={self.grid}")


@dataclass
class TrainSettings:
    """Optimisation. The batch of step s depends on (seed, s) alone, so a resumed run repeats the uninterrupted one."""

    steps: int = number(20_000, 1, 10**9)
    batch: int = number(64, 1, 65_536)
    lr: float = number(1e-3, 0, 10)
    warmup: int = number(300, 0, 10**9)
    weight_decay: float = number(0.02, 0, 100)
    clip: float = number(1.0, above=0, most=1e9)
    ema: float = number(0.999, 0, 0.999999)
    init: str | None = None  # target that gives the initial weights; its chunk may be shorter or longer
    freeze: list[str] = field(default_factory=list)  # modules of the target that keep the weights of `init`
    label_sigma: float = number(1.0, 0, 1000)  # bins; neighbouring bins share probability (Gaussian); 0: one-hot
    balance: float = number(0.0, 0, 1)  # 0: every sample is drawn as often as any other; 1: every task
    scene_weight: float = number(1.0, 0, 1e6)  # weight of the position loss (vision only)
    scene_steps: int = number(0, 0, 10**9)  # first steps that train only the vision encoder, on positions
    held_out: float = number(0.1, above=0, most=0.5)  # share of episodes kept for validation
    validate_every: int = number(2_000, 1, 10**9)
    closed_loop: int = number(0, 0, 100_000)  # episodes per task and validation, closed loop
    seed: int = number(0, 0, 2**31 - 1)
    bf16: bool = True  # autocast the training forward to bfloat16
    stored: str = choice("float32", "float32", "float16", "int8")  # weights on disk: for shipping, a half or a quarter


@dataclass
class TrainTargetSettings(TaskSettings):
    """`kerv train target`."""

    name: str = "mt10-vision"  # of the folder below results/artifacts/target, or a path
    demos: str = "mt10"
    target: TargetSettings = field(default_factory=TargetSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class DemosSettings(TaskSettings):
    """`kerv demos`."""

    name: str | None = None  # default: the tasks' names, in small letters
    episodes: int = number(100, 1, 100_000)  # per task
    seed: int = number(0, 0, 2**31 - 1)
    perturbed: float = number(0.5, 0, 1)
    policy: PolicySettings = field(default_factory=PolicySettings)  # what acts; the expert labels (DAgger)
    expert_share: float = number(0.3, 0, 1)  # of a target's chunks: those that the expert executes
    frame_stride: int = number(2, 1, 10_000)
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class DemosExportSettings(CommandSettings):
    """`kerv demos export`: demonstrations for other tools."""

    format: str = "lerobot"  # a LeRobot dataset of version 3
    demos: str = "mt10"
    to: str = ""  # folder; empty: <results>/lerobot/<demos>


@dataclass
class DemosImportSettings(CommandSettings):
    """`kerv demos import`: recorded episodes of another tool as demonstrations (docs/data.md)."""

    format: str = "lerobot"
    source: str = ""  # folder of the dataset
    name: str | None = None  # default: the folder's
    camera: str = ""  # which of its images; empty: the first
    episodes: int = number(0, 0, 1_000_000)  # the first ones; 0: all
    dofs: str = "own"  # own | openvla: names of the DoFs
    strict: list[str] | None = None  # DoFs that are never relaxed; None: those with gripper in their name
    tail: int = number(8, 0, 1024)  # copies of the last action behind an episode, for chunks that begin near its end


@dataclass
class DrafterSettings:
    """Shapes of a drafter (docs/methods.md). eagle: decoder layers of the target's width, behind its states (§2.2).
    early: a residual network from the prompt and the last actions to the whole chunk, before the target runs (§5)."""

    kind: str = "eagle"  # eagle | early
    layers: int = number(1, 0, 1024)
    width: int = number(512, 1, 65_536)  # early: hidden units
    rank: int = number(64, 1, 65_536)  # early: features per token in front of the bins
    history: int = number(2, 0, 1024)  # early: last executed actions it reads
    noise: float = number(0.0, 0, 100)  # uniform noise on the input states, training only
    unroll: int = number(3, 1, 64)  # passes fed with its own predicted states, as drafting does; 1: the paper's
    samples: int = number(12_000, 1, 10**8)  # observations whose greedy decodes it is trained on
    state_weight: float = number(1.0, 0, 1e6)  # smooth-L1 on the hidden state
    token_weight: float = number(0.1, 0, 1e6)  # soft cross-entropy with the target's distribution


@dataclass
class TrainDrafterSettings(RunSettings):
    """`kerv train drafter`."""

    policy: PolicySettings = field(default_factory=PolicySettings)  # policy.drafter: name of the new drafter
    demos: str = "mt10"
    task: list[str] = field(default_factory=list)  # tasks and suites whose demonstrations are used; empty: all
    starts: str = choice("all", "all", "half")  # half: of every task, the episodes that begin on one side
    drafter: DrafterSettings = field(default_factory=DrafterSettings)
    train: TrainSettings = field(default_factory=TrainSettings)


@dataclass
class TrainScoreSettings(RunSettings):
    """`kerv train score`: the learned score, on what `kerv calibrate risk features=true` recorded."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    inputs: list[str] = field(default_factory=lambda: ["odds", "entropy", "familiarity", "steadiness"])
    steps: int = number(300, 1, 10**6)
    lr: float = number(3e-3, 0, 10)
    weight_decay: float = number(1.0, 0, 100)
    held_out: float = number(0.25, above=0, most=0.9)  # share of the episodes that it is measured on
    seed: int = number(0, 0, 2**31 - 1)


@dataclass
class DoctorSettings(RunSettings):
    """`kerv doctor`. With a target or an environment it checks that alone."""

    policy: PolicySettings = field(default_factory=lambda: PolicySettings(target=""))  # target=NAME says policy.target
    environment: str | None = None
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1)
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class BenchSettings(RunSettings):
    """`kerv bench`: how far a target is from what the device can do."""

    model: str = "mt10-vision"  # target=: a policy, or a shape of conf/target with random weights
    dtype: str = "auto"  # of a shape: float32 | bfloat16 | auto, the faster one here; a policy has runtime.dtype
    repeats: int = number(30, 3, 100_000)  # of every measurement; medians and 95th percentiles are over them
    tokens: list[int] = field(
        default_factory=lambda: [7, 16], metadata=limits(4, 256)
    )  # N, of a chunk; a shape's: most
    projected: str = ""  # a shape of conf/target whose profiles on `projections` are written too
    projections: dict[str, list[float]] = field(  # device -> published GB/s and dense bfloat16 TFLOP/s
        default_factory=lambda: {"A100 80GB": [2039.0, 312.0], "H100 SXM": [3350.0, 989.0], "RTX 4090": [1008.0, 165.0]}
    )

    def check_together(self, prefix: str) -> None:
        """Raises UsageError without a chunk to measure, and for a device without its two figures."""
        if not self.tokens:
            raise UsageError(f"{prefix}tokens=[]: name at least one N")
        for name, figures in self.projections.items():
            if len(figures) != 2 or min(figures) <= 0:
                raise UsageError(f"{prefix}projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")


@dataclass
class ReportSettings(CommandSettings):
    """`kerv report`."""

    only: str | None = None  # name of one study (study=NAME on the command line); default: all that are there
    against: str | None = None  # results folder with another run of that study: how far the two agree
    on: list[str] = field(default_factory=list)  # profiles of 'kerv bench' that price the study's decodes
    loss: float = number(3.0, above=0, most=99.9)  # --choose: bound on the loss of success against the baseline, points


@dataclass
class ViewSettings(CommandSettings):
    """`kerv view`."""


@dataclass
class BuildTargetSettings(RunSettings):
    """`kerv build target`: a published checkpoint as a target of ours. Nothing is copied: it stays where it lies."""

    checkpoint: str = ""  # folder of a Hugging Face checkpoint
    family: str = "openvla"  # target=openvla says the same
    name: str = "openvla"
    statistics: str | None = None  # data set whose actions it emits; None: the only one
    environment: str | None = None  # whose DoFs, control rate and camera it has; None: OpenVLA's own
    control_hz: float = number(5.0, above=0, most=10_000)  # control steps per second, without an environment
    camera: str = ""  # name of the image it is shown; empty: the environment's first camera, else primary
    prompt: str = "openvla"  # openvla | openvla_v01
    crop: bool = False  # show the central 90 %: for checkpoints fine-tuned with augmented images (LIBERO's)
    int8: bool = False  # the language model's layers with one byte per weight
    prompt_tokens: int = number(64, 1, 65_536)  # longest prompt, without the vision tokens


@dataclass
class BuildDrafterSettings(RunSettings):
    """`kerv build drafter`: a drafter in the public EAGLE or Spec-VLA layout, for one of our targets."""

    policy: PolicySettings = field(default_factory=PolicySettings)  # policy.target, and policy.drafter: its new name
    checkpoint: str = ""  # folder with config.json and model.safetensors
    positions: str = "sequence"  # sequence | text (docs/methods.md §2.2)
    mask: str = "causal"  # causal | prompt


@dataclass
class BuildDatastoreSettings(TaskSettings):
    """`kerv build datastore` (docs/methods.md §4.1)."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: datastore/ beside the target
    demos: str = "mt10"
    episodes: int = number(0, 0, 100_000)  # per task, the first ones by seed; 0: all
    starts: str = choice("all", "all", "half")  # half: of every task, the episodes that begin on one side
    stride: int = number(1, 1, 10_000)  # of an episode's observations every so many become entries
    half: bool = False  # keys on disk in float16: half the size, for shipping
    components: int = number(0, 0, 65_536)  # directions that keys are projected onto; 0: keys stay as they are
    key: list[str] = field(default_factory=lambda: ["scene"])  # pooled parts of the prompt; also vision, proprioception


@dataclass
class CalibrateSettings(TaskSettings):
    """`kerv calibrate` (docs/methods.md §3, §4): noise of the predictors, K_S, boundary ranges and skip levels."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: beside the target
    demos: str = "mt10"
    episodes: int = number(0, 0, 100_000)  # per task, the first ones by seed; 0: all
    held_out: float = number(0.1, above=0, most=0.5)  # share of episodes that the errors are measured on
    # what predictions are made from; labels: clean, executed: noisy in perturbed episodes
    history: str = choice("labels", "labels", "executed")
    window: int = number(10, 4, 10_000)  # control steps of history; predictors need four
    fit_steps: int = number(0, 0, 1024)  # steps ahead whose mean error is fitted; 0: the target's chunk
    # verify-skip: mean abs error of a retrieved chunk that is good enough, normalised units
    epsilon: float = number(0.1, above=0, most=1e6)
    confidence: float = number(0.9, 0.5, 0.999999)  # verify-skip: share of skipped chunks with an error below epsilon
    # positions; each has ranges of its own
    boundary_windows: list[int] = field(default_factory=lambda: [5, 15, 30], metadata=limits(3, 10_000))
    decodes: int = number(60, 0, 100_000)  # pre-sampling, per task: decodes whose median variability is K_S; 0: none
    proposer: Any = field(default_factory=chosen("proposer", "drafter"))  # pre-sampling decodes with these parts
    acceptance: Any = field(default_factory=chosen("acceptance", "relaxed"))
    threshold: Any = field(default_factory=chosen("threshold", "fixed"))

    def check_together(self, prefix: str) -> None:
        """Raises UsageError without a window, or for a pre-sampling that drafts nothing."""
        if not self.boundary_windows:
            raise UsageError(f"{prefix}boundary_windows=[]: name at least one number of positions")
        if self.decodes and self.proposer.kind == "none":
            raise UsageError("proposer.kind=none drafts nothing to compare: choose a proposer, or decodes=0")


@dataclass
class CalibrateRiskSettings(TaskSettings):
    """`kerv calibrate risk` (docs/methods.md §4.6): drafts, their scores and losses in closed loop, selection seeds."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: risk/ beside the target
    episodes: int = number(20, 1, 100_000)  # per task
    seed: int = number(50_100, 0, 2**31 - 1)  # first one, a selection seed
    sources: list[str] = field(default_factory=lambda: ["early"])  # what drafts; the first one's drafts are executed
    scores: list[str] = field(default_factory=lambda: ["odds", "entropy", "familiarity", "steadiness"])
    unverified: float = number(0.8, 0, 1)  # share of the decodes in which the draft is executed, else verified first
    scale: float = number(LOSS_SCALE, above=0, most=1e6)  # ε_a, normalised action units
    epsilon: float = number(0.15, above=0, most=0.99)  # of the table that is printed
    delta: float = number(0.1, above=0, most=0.5)
    features: bool = False  # keep the pooled prompts, for `kerv train score`
    world: RolloutWorldSettings = field(default_factory=RolloutWorldSettings)

    def check_together(self, prefix: str) -> None:
        """Raises UsageError without a source or a score."""
        for name in ("sources", "scores"):
            if not getattr(self, name):
                raise UsageError(f"{prefix}{name}=[]: name at least one")


def as_plain(settings: Any) -> dict[str, Any]:
    """A settings dataclass as nested dicts and lists."""
    return asdict(settings)


def settings_from(plain: Mapping[str, Any], tolerant: bool = False) -> RolloutSettings:
    """The inverse of `as_plain` for a rollout; every part's settings become their own class. tolerant: as
    `manifests.read`.

    Raises:
        CheckpointError: not such settings. UnknownName: a part that is not registered here.
    """
    settings = manifests.read(RolloutSettings, dict(plain), "a stored setting", tolerant)
    for group in PART_GROUPS:
        value = getattr(settings, group)
        if not isinstance(value, Mapping):
            continue  # a kind of part that is younger than these settings: its default
        schema = part_of(group, value["kind"]).settings
        setattr(settings, group, manifests.read(schema, value, f"a stored setting's {group}", tolerant))
    return settings
