"""The settings of every command, as plain dataclasses; the YAML files under `conf/` hold what differs from them.

Nothing heavy is imported here: a wrong override is answered before torch or MuJoCo load.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from kerv_cli import manifests, parts
from kerv_cli.registry import NoSettings

EVALUATION_SEED = 100_000
"""First evaluation seed. Demonstrations use seeds below it, so training and evaluation never share a world."""


@dataclass
class CameraSettings:
    """The policy's view: a camera of the environment, vertical field of view in degrees, pixels, supersampling."""

    name: str = ""  # empty: the environment's first camera
    fovy: float = 45.0
    size: int = 96  # pixels, square
    supersample: int = 2


@dataclass
class WorldSettings:
    """The simulated world of an episode."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    horizon: int = 0  # control steps; 0: the environment's


@dataclass
class RuntimeSettings:
    """Device, number format and parallelism of a process."""

    device: str = "cpu"  # cpu | cuda | auto
    dtype: str = "float32"
    threads: int = 1  # torch threads of each process
    executor: str = "local"  # sweeps: what runs the blocks: local (processes here) | slurm | ray
    workers: int = 1  # sweeps: blocks that run at the same time
    executor_options: dict[str, Any] = field(default_factory=dict)  # see SlurmOptions, RayOptions in parts.py


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


@dataclass
class PolicySettings:
    """What chooses the actions. Weights are named by folders of results/pretrained or results/artifacts, or paths."""

    kind: str = MODEL  # model | expert (the environment's scripted policy: privileged, the reference of success)
    target: str = "mt10-vision"
    drafter: str | None = None  # these: default the one beside the target
    early: str | None = None
    datastore: str | None = None
    calibration: str | None = None
    others: dict[str, str] = field(default_factory=dict)  # artifacts of parts that are not kerv's: kind -> name

    def named(self, kind: str) -> str | None:
        """The name given for the artifact of this kind, None without one."""
        return self.others.get(kind) or getattr(self, kind, None)


@dataclass
class RolloutSettings(TaskSettings):
    """`kerv rollout`: episodes of one method. Its parts are settings of the classes in kerv_cli/parts.py."""

    episodes: int = 3  # per task
    seed: int = EVALUATION_SEED  # first seed; episode i uses seed + i in every setting: that is the pairing
    policy: PolicySettings = field(default_factory=PolicySettings)
    method: str = "ar"  # name of the composition; its parts follow
    prefill_draft: Any = field(default_factory=NoSettings)  # a proposer, before the prefill
    proposer: Any = field(default_factory=NoSettings)
    acceptance: Any = field(default_factory=lambda: NoSettings("strict"))
    threshold: Any = field(default_factory=parts.FixedThresholdSettings)
    rectifier: Any = field(default_factory=lambda: NoSettings("reinfer"))
    boundary: Any = field(default_factory=lambda: NoSettings("always"))
    skip: Any = field(default_factory=NoSettings)
    chunk: int = 0  # H, control steps decoded at once; 0: as many as the target was trained for
    datastore: Any = field(default_factory=lambda: NoSettings("exact"))
    world: WorldSettings = field(default_factory=WorldSettings)
    deviation_every: int = 0  # decodes between two deviation samples; 0: never
    record: int = 1  # episodes per task that are saved as .rrd; -1: all
    record_size: int = 240  # pixels of the logged camera

    def __post_init__(self) -> None:
        if self.policy.kind == EXPERT:
            self.method = EXPERT  # it decodes nothing, so that no method's name fits

    def parts(self) -> dict[str, Any]:
        """Kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in parts.METHOD_KINDS}


@dataclass
class StudySettings:
    """`conf/study/*.yaml`: which settings are compared."""

    name: str = "threshold"
    title: str = ""
    baseline: str = "ar"  # label of the setting that the others are compared with
    common: str = ""  # overrides of every setting, e.g. task=MT10 episodes=20; the command line's outrank them
    settings: dict[str, str] = field(default_factory=dict)  # label -> overrides; comma lists expand into a grid
    axis: str = ""  # config key on the plot's x axis, e.g. threshold.r
    block: int = 5  # seeds for which the settings take turns in one process, episode by episode
    repeats: int = 1  # how often every episode is measured
    note: str = ""  # a sentence that says what to see, printed below the table


@dataclass
class SweepSettings(CommandSettings):
    """`kerv sweep`: a study. Everything else on the command line goes to each of its settings."""

    study: StudySettings = field(default_factory=StudySettings)
    until: str = "done"  # done: every planned episode | decided: settings stop when their question is answered
    loss: float = 3.0  # until=decided: is the loss of success against the baseline below so many points?


@dataclass
class TargetSettings:
    """Shapes of the target (docs/methods.md §0). `conf/target/*.yaml` are the sizes."""

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
    parallel: bool = False  # decodes all tokens of a chunk at once, each without the others (docs/methods.md §6)


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
    init: str | None = None  # target that gives the initial weights; its chunk may be shorter or longer
    freeze: list[str] = field(default_factory=list)  # modules of the target that keep the weights of `init`
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
class TrainTargetSettings(TaskSettings):
    """`kerv train target`."""

    name: str = "mt10-vision"
    demos: str = "mt10"
    target: TargetSettings = field(default_factory=TargetSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class DemosSettings(TaskSettings):
    """`kerv demos`."""

    name: str | None = None  # default: the tasks' names, in small letters
    episodes: int = 100  # per task
    seed: int = 0
    perturbed: float = 0.5
    frame_stride: int = 2
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class DrafterSettings:
    """Shapes of a drafter (docs/methods.md). eagle: decoder layers of the target's width, behind its states (§2.2).
    early: a residual network from the prompt and the last actions to the whole chunk, before the target runs (§5)."""

    kind: str = "eagle"  # eagle | early
    layers: int = 1
    width: int = 512  # early: hidden units
    rank: int = 64  # early: features per token in front of the bins
    history: int = 2  # early: last executed actions it reads
    noise: float = 0.0  # uniform noise on the input states, training only
    unroll: int = 3  # passes that feed the drafter its own predicted states, as drafting does; 1: the paper's
    samples: int = 12_000  # observations whose greedy decodes it is trained on
    state_weight: float = 1.0  # smooth-L1 on the hidden state
    token_weight: float = 0.1  # soft cross-entropy with the target's distribution


@dataclass
class TrainDrafterSettings(RunSettings):
    """`kerv train drafter`."""

    policy: PolicySettings = field(default_factory=PolicySettings)  # policy.drafter: name of the new drafter
    demos: str = "mt10"
    drafter: DrafterSettings = field(default_factory=DrafterSettings)
    train: TrainSettings = field(default_factory=TrainSettings)


@dataclass
class DoctorSettings(RunSettings):
    """`kerv doctor`."""

    seed: int = EVALUATION_SEED
    world: WorldSettings = field(default_factory=WorldSettings)


@dataclass
class ReportSettings(CommandSettings):
    """`kerv report`."""

    only: str | None = None  # name of one study (study=NAME on the command line); default: all that are there
    against: str | None = None  # results folder with another run of that study: how far the two agree
    loss: float = 3.0  # --choose: bound on the loss of success against the baseline, points


@dataclass
class ViewSettings(CommandSettings):
    """`kerv view`."""


@dataclass
class BuildDatastoreSettings(TaskSettings):
    """`kerv build datastore` (docs/methods.md §4.1)."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: datastore/ beside the target
    demos: str = "mt10"
    episodes: int = 0  # per task, the first ones by seed; 0: all
    stride: int = 1  # of an episode's observations every so many become entries
    half: bool = False  # keys on disk in float16: half the size, for shipping
    components: int = 0  # directions that keys are projected onto; 0: keys stay as they are
    key: list[str] = field(default_factory=lambda: ["scene"])  # pooled parts of the prompt; also vision, proprioception


@dataclass
class CalibrateSettings(TaskSettings):
    """`kerv calibrate` (docs/methods.md §3, §4): noise of the predictors, K_S, boundary ranges and skip levels."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    name: str | None = None  # default: beside the target
    demos: str = "mt10"
    episodes: int = 0  # per task, the first ones by seed; 0: all
    held_out: float = 0.1  # share of episodes that the errors are measured on
    history: str = "labels"  # what predictions are made from: labels (clean) | executed (perturbed episodes: noisy)
    window: int = 10  # control steps of history
    fit_steps: int = 0  # steps ahead whose mean error is fitted; 0: the target's chunk
    epsilon: float = 0.1  # verify-skip: mean abs error of a retrieved chunk that is good enough, normalised units
    confidence: float = 0.9  # verify-skip: share of skipped chunks whose error stays below epsilon
    boundary_windows: list[int] = field(default_factory=lambda: [5, 15, 30])  # positions; each has ranges of its own
    decodes: int = 60  # pre-sampling, per task: decodes whose median variability is K_S; 0: none
    proposer: Any = field(default_factory=parts.DrafterProposerSettings)  # pre-sampling decodes with these parts
    acceptance: Any = field(default_factory=parts.RelaxedAcceptanceSettings)
    threshold: Any = field(default_factory=parts.FixedThresholdSettings)


def as_plain(settings: Any) -> dict[str, Any]:
    """A settings dataclass as nested dicts and lists."""
    return asdict(settings)


def settings_from(plain: Mapping[str, Any]) -> RolloutSettings:
    """The inverse of `as_plain` for a rollout; every part's settings become their own class.

    Raises:
        CheckpointError: not such settings. UnknownName: a part that is not registered here.
    """
    settings = manifests.read(RolloutSettings, dict(plain), "a stored setting")
    for group in parts.PART_GROUPS:
        value = dict(getattr(settings, group))
        schema = parts.part_of(group, value["kind"]).settings
        setattr(settings, group, manifests.read(schema, value, f"a stored setting's {group}"))
    return settings
