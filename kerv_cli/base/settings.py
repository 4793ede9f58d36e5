"""The settings of every command, as plain dataclasses: name, type, default, range and description of each, once.

`groups` names the folders of `conf/` that a command's settings choose from, and the choice without a word. Nothing
heavy is imported here: a wrong override is answered before torch or MuJoCo load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

from kerv_cli.base import manifests
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.registry import METHOD_KINDS, SETTINGS_GROUPS, find, part_of

S = TypeVar("S")

EVALUATION_SEED = 100_000
"""First evaluation seed. Demonstrations use seeds below it, so training and evaluation never share a world."""

MOST_STRESS = 4
"""The highest level of every kind of stress."""


def chosen(kind: str, name: str = "none") -> Callable[[], Any]:
    """Makes the settings of the part `name`: the default of a group."""
    return lambda: find(kind, name).default


def part(kind: str, name: str = "none", help: str = "") -> Any:
    """A field with the settings of one of the parts of a kind; the field's name is a group of conf/."""
    return setting(chosen(kind, name), help, group=name)


@dataclass(unsafe_hash=True)  # worlds keep cameras by it; Hydra could not override a frozen one
class CameraSettings:
    """The policy's view: a camera of the environment, or several side by side (`views.views_of`)."""

    name: str = setting("", "empty: the environment's first camera; joined names are several views side by side")
    fovy: float = number(45.0, above=0, most=179, help="vertical field of view, degrees")
    size: int = number(96, 8, 4096, help="pixels of a view, square")
    supersample: int = number(2, 1, 16, help="pixels that are drawn per side of one that is shown")


@dataclass
class WorldSettings:
    """The simulated world of an episode."""

    camera: CameraSettings = setting(CameraSettings, "the policy's view")
    horizon: int = number(0, 0, 1_000_000, help="control steps of an episode; 0: the environment's")


WAITS, REAL = "waits", "real"
MEASURED, CONSTANT, PROFILE = "measured", "constant", "profile"


@dataclass
class TimingSettings:
    """What the world does while the policy decodes (docs/methods.md §8)."""

    clock: str = choice(WAITS, WAITS, REAL, help="while the policy decodes, the world stands still, or goes on")
    latency: str = choice(MEASURED, MEASURED, CONSTANT, PROFILE, help="how long a decode takes for the world")
    latency_ms: float = number(0.0, 0, 600_000, help="latency=constant: milliseconds of a decode")
    profile: str = setting("", "latency=profile: a document of `kerv bench`, its path or its name in <results>/bench")
    ar_ms: float = number(
        0.0, 0, 600_000, help="an autoregressive decode takes so long, others in proportion; 0: as measured or profiled"
    )
    delay_compensation: str = choice("none", "none", "chunk", help="chunk: leave a new chunk's stale actions out")
    batch: int = number(1, 1, 1024, help="episodes that are decoded together; above 1: for success, without times")

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

    kind: str = setting("none", "what is shifted: push, actuation, sensor, light, colour, camera, object")
    level: int = number(0, 0, MOST_STRESS, help="how far; 0: not at all")

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

    stress: StressSettings = setting(StressSettings, "a shift of the world")


@dataclass
class RuntimeSettings:
    """Device, number format and parallelism of a process."""

    device: str = setting("cpu", "cpu, cuda or auto")
    dtype: str = choice("float32", "float32", "bfloat16", "float16", help="number format of the models")
    threads: int = number(1, 1, 256, help="torch's threads in each process")
    executor: str = setting("local", "sweeps: what runs the blocks: local (processes here), slurm, ray")
    workers: int = number(1, 1, 4096, help="sweeps: blocks that run at the same time")
    executor_options: dict[str, Any] = setting({}, "see kerv_cli/lab/executors/__init__.py")


@dataclass(kw_only=True)
class CommandSettings:
    """Settings of every command."""

    groups: ClassVar[Mapping[str, str]] = {}
    """Groups of conf/ -> the choice without a word, in the order of composition: a later one outranks an earlier."""

    results: str = setting("results", "folder of everything that kerv makes")
    store: str = setting(
        "", "database, postgresql://USER@HOST/DB; empty: $KERV_STORE, else SQLite in the results folder"
    )


@dataclass(kw_only=True)
class RunSettings(CommandSettings):
    """Settings of every command that computes."""

    groups: ClassVar = {"runtime": "cpu"}

    runtime: RuntimeSettings = setting(RuntimeSettings, "device, number format, threads, processes")


@dataclass(kw_only=True)
class TaskSettings(RunSettings):
    """Settings of every command that works on tasks."""

    task: list[str] = setting([], "tasks and suites: reach, drawer-open, MT10, …; empty: those that the target knows")


DEFAULT_TASKS = ["MT10"]
"""Where neither a word nor a target names any."""
MODEL, EXPERT = "model", "expert"
DERIVED_FROM = ("policy.kind",)
"""Keys of settings that others are derived from when a dataclass is made."""


@dataclass
class PolicySettings:
    """What chooses the actions. Weights are named by folders of results/pretrained or results/artifacts, or paths."""

    kind: str = choice(MODEL, MODEL, EXPERT, help="expert: the environment's script, privileged, no decoding")
    target: str = setting("mt10-vision", "the policy's weights")
    drafter: str | None = setting(None, "default: the one beside the target")
    early: str | None = setting(None, "the early drafter; default: the one beside the target")
    scout: str | None = setting(None, "the drafter with eyes of its own; default: the one beside the target")
    certificate: str | None = setting(None, "of success; default: the one beside the target")
    datastore: str | None = setting(None, "default: the one beside the target")
    calibration: str | None = setting(None, "default: the one beside the target")
    others: dict[str, str] = setting({}, "artifacts of parts that are not kerv's: kind -> name")

    def named(self, kind: str) -> str | None:
        """The name given for the artifact of this kind, None without one."""
        return self.others.get(kind) or getattr(self, kind, None)


# descriptions of settings that several commands have
POLICY = "what chooses the actions: vision, state, expert, … (conf/policy)"
DEMOS = "demonstrations, by name"
TARGET_DEMOS = f"{DEMOS}; empty: those that the target was trained on"
TRACKERS = ("none", "trackio", "wandb", "tensorboard")
LOG = "where the curves are drawn while it trains"
FIRST_EPISODES = "per task, the first ones by seed; 0: all"


@dataclass(kw_only=True)
class MethodSettings(RunSettings):
    """A policy and the method by which it decodes. The parts are settings of the classes in kerv_cli/methods."""

    policy: PolicySettings = setting(PolicySettings, POLICY)
    method: str = setting("ar", "how it decodes: ar, spec_vla, kerv, heisd, one_pass, … (conf/method)")
    prefill_draft: Any = part("proposer", help="what drafts before the prefill")
    proposer: Any = part("proposer", help="what drafts behind the prefill: none, drafter, retrieval, hold, …")
    acceptance: Any = part("acceptance", "strict", "which drafted tokens count as right: strict, relaxed, …")
    threshold: Any = part("threshold", "fixed", "how many bins a relaxed acceptance forgives: threshold.r")
    rectifier: Any = part("rectifier", "reinfer", "what becomes of rejected tokens")
    boundary: Any = part("boundary", "always", "where retrieved drafts are used")
    skip: Any = part("skip", help="which drafts are executed without verification")
    chunk: int = number(0, 0, 1024, help="H, control steps decoded at once; 0: as many as the target was trained for")
    datastore: Any = part("datastore", "exact", "what searches the stored chunks")

    def parts(self) -> dict[str, Any]:
        """Kind -> settings, for every part of the method."""
        return {kind: getattr(self, kind) for kind in METHOD_KINDS}


@dataclass
class RolloutSettings(MethodSettings, TaskSettings):
    """`kerv rollout`: episodes of one method."""

    # the method's parts are overridden by its file, so that it comes last
    groups: ClassVar = {"policy": "vision", "world": "default", "runtime": "cpu", "method": "ar"}

    episodes: int = number(3, 1, 1_000_000, help="episodes per task")
    # in every setting: that is the pairing
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1, help="first seed; episode i has seed + i")
    world: RolloutWorldSettings = setting(RolloutWorldSettings, "camera, length of an episode, stress")
    rollout: TimingSettings = setting(TimingSettings, "what the world does while the policy decodes")
    deviation_every: int = number(0, 0, 1_000_000, help="decodes between two deviation samples; 0: never")
    record: int = number(1, -1, 1_000_000, help="episodes per task that are saved as .rrd; -1: all")
    record_size: int = number(240, 8, 4096, help="pixels of the recorded camera")

    def __post_init__(self) -> None:
        if self.policy.kind == EXPERT:
            self.method = EXPERT  # it decodes nothing, so that no method's name fits


@dataclass
class ServeSettings(MethodSettings):
    """`kerv serve`: a policy and a method for clients over websockets (docs/serving.md)."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu", "method": "ar"}

    protocol: str = choice(
        "openpi", "openpi", "vla_eval", help="what clients speak: robots openpi, benchmarks vla_eval"
    )
    host: str = setting("127.0.0.1", "address to listen on; there is no password")
    port: int = number(8000, 0, 65_535, help="port to listen on; 0: a free one")
    log_every: int = number(100, 0, 10**9, help="answers between two lines of latencies; 0: at a connection's end only")
    gripper: str = choice(
        "as_is", "as_is", "signed", "signed_inverted", help="how strict DoFs (0 closed to 1 open) are sent"
    )
    task_name: str = setting("", "the task, for parts whose levels differ between tasks; empty: vla_eval's clients say")
    batch: int = number(1, 1, 1024, help="clients that are decoded together; above 1: without times")
    origins: list[str] = setting([], "web pages that may connect; programs, which name no origin, always may")
    outside: str = choice(
        "refuse", "refuse", "hold", help="a state that the policy was not trained on: an error, or the last action"
    )
    margin: float = number(1.0, 0, 1e6, help="by how many widths a state may exceed the demonstrations' range")


@dataclass(kw_only=True)
class ImportSettings(CommandSettings):
    """`kerv runs import`: recordings of vla-eval as a study (docs/vla_eval.md)."""

    name: str = setting("", "of the study; empty: that of its benchmarks")
    baseline: str = setting("", "label of the setting that the others are compared with; empty: ar, else the first")
    labels: list[str] = setting([], "of the recordings, in their order; empty: methods, or names of servers")


@dataclass
class StudySettings:
    """`conf/study/*.yaml`: which settings are compared."""

    name: str = setting("", "of its folder in <results>/studies; empty: that of its file")
    title: str = setting("", "of its tables and plots")
    baseline: str = setting("ar", "label of the setting that the others are compared with")
    common: str = setting("", "overrides of every setting, e.g. task=MT10 episodes=20; the command line's outrank them")
    settings: dict[str, str] = setting({}, "label -> overrides; comma lists expand into a grid")
    axis: str = setting("", "key on the plot's x axis, e.g. threshold.r")
    block: int = number(5, 1, 10_000, help="seeds for which the settings take turns in one process")
    repeats: int = number(1, 1, 1_000, help="how often every episode is measured")
    note: str = setting("", "a sentence that says what to see, printed below the table")


@dataclass
class SweepSettings(CommandSettings):
    """`kerv sweep`: a study. Everything else on the command line goes to each of its settings."""

    groups: ClassVar = {"study": "threshold"}

    study: StudySettings = setting(StudySettings, "which settings are compared: a name of conf/study, or a file")
    until: str = choice(
        "done", "done", "decided", help="every planned episode, or until each setting's question is answered"
    )
    # timed: settings whose times were not taken in turn with the baseline; changed: episodes of other code
    rerun: str = choice("never", "never", "timed", "changed", "all", help="what is run again although it is there")
    loss: float = number(3.0, above=0, most=99.9, help="until=decided: is the loss of success below so many points?")


@dataclass
class TargetSettings:
    """Shapes of the target (docs/methods.md §0). `conf/target/*.yaml` are the sizes."""

    size: str = setting("small", "name of these shapes")
    observation: str = choice("vision", "vision", "state", help="state: privileged, the places' positions are given")
    width: int = number(192, 2, 65_536, help="of the hidden states")
    layers: int = number(8, 1, 1024, help="decoder layers")
    heads: int = number(6, 1, 1024, help="attention heads")
    feed_forward: int = number(512, 1, 262_144, help="hidden units of a layer's feed-forward part")
    chunk: int = number(4, 1, 1024, help="H, control steps per decode")
    grid: int = number(4, 1, 512, help="vision tokens per side")
    keypoints: int = number(32, 1, 4096, help="spatial soft-argmax points of the vision encoder")
    channels: int = number(24, 1, 4096, help="width of the vision encoder's first stage")
    norm: str = choice("group", "group", "instance", help="of the vision encoder; instance: light changes it least")
    scene_tokens: int = number(4, 1, 1024, help="tokens with the places' positions, estimated or given")
    instruction_tokens: int = number(10, 1, 1024, help="longest instruction")
    image_size: int = number(96, 8, 4096, help="pixels of a view, square")
    parallel: bool = setting(False, "decode all tokens of a chunk at once (docs/methods.md §6)")

    def check_together(self, prefix: str) -> None:
        """Raises UsageError for a width that the heads do not divide, or an image that the grid does not divide."""
        if self.width % (2 * self.heads):
            raise UsageError(f"{prefix}width={self.width} must be a multiple of 2 x {prefix}heads={self.heads}")
        if self.observation == "vision" and self.image_size % (8 * self.grid):
            raise UsageError(f"{prefix}image_size={self.image_size} must be a multiple of 8 x {prefix}grid={self.grid}")


@dataclass
class TrainSettings:
    """Optimisation. The batch of step s depends on (seed, s) alone, so a resumed run repeats the uninterrupted one."""

    steps: int = number(20_000, 1, 10**9, help="optimisation steps")
    batch: int = number(64, 1, 65_536, help="samples per step")
    lr: float = number(1e-3, 0, 10, help="highest learning rate")
    warmup: int = number(300, 0, 10**9, help="first steps, in which the learning rate rises")
    weight_decay: float = number(0.02, 0, 100, help="AdamW's")
    clip: float = number(1.0, above=0, most=1e9, help="largest norm of the gradient")
    ema: float = number(0.999, 0, 0.999999, help="moving average of the weights, which is what is kept")
    init: str | None = setting(None, "target that gives the initial weights; its chunk may be shorter or longer")
    freeze: list[str] = setting([], "modules of the target that keep the weights of `init`")
    label_sigma: float = number(1.0, 0, 1000, help="bins over which a label is spread (Gaussian); 0: one-hot")
    balance: float = number(0.0, 0, 1, help="0: every sample is drawn as often as any other; 1: every task")
    scene_weight: float = number(1.0, 0, 1e6, help="weight of the position loss (vision only)")
    places: str = choice(
        "state", "state", "path", help="positions learnt: of object and goal; path: of the hand, later in the episode"
    )
    colour: float = number(0.0, 0, 3, help="random light on the images (target only): spread of its logarithm")
    scene_steps: int = number(0, 0, 10**9, help="first steps that train only the vision encoder, on positions")
    held_out: float = number(0.1, above=0, most=0.5, help="share of episodes kept for validation")
    validate_every: int = number(2_000, 1, 10**9, help="steps between two validations")
    closed_loop: int = number(0, 0, 100_000, help="episodes per task and validation, closed loop")
    seed: int = number(0, 0, 2**31 - 1, help="of initial weights and order of samples")
    bf16: bool = setting(True, "training forward in bfloat16, on a GPU or a CPU with AMX")
    stored: str = choice(
        "float32", "float32", "float16", "int8", help="weights on disk: for shipping, a half or a quarter"
    )


@dataclass
class TrainTargetSettings(TaskSettings):
    """`kerv train target`."""

    groups: ClassVar = {"target": "small", "train": "target", "world": "default", "runtime": "auto"}

    name: str = setting("mt10-vision", "folder below <results>/artifacts/target, or a path")
    task: list[str] = setting([], "tasks and suites; empty: those of the demonstrations")
    demos: str = setting("", f"{DEMOS}; empty: those that `kerv demos` makes of the same tasks")
    log: str = choice("none", *TRACKERS, help=LOG)
    target: TargetSettings = setting(TargetSettings, "shapes: nano, tiny, small, base, … (conf/target)")
    train: TrainSettings = setting(TrainSettings, "optimisation")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@dataclass
class DemosSettings(MethodSettings, TaskSettings):
    """`kerv demos`. policy: what acts; expert, or a policy that the expert labels (DAgger)."""

    groups: ClassVar = {"policy": "expert", "world": "default", "runtime": "workers", "method": "ar"}

    task: list[str] = setting(DEFAULT_TASKS, "tasks and suites: reach, drawer-open, MT10, …")
    name: str | None = setting(None, "default: the tasks' names, in small letters")
    episodes: int = number(100, 1, 100_000, help="episodes per task")
    seed: int = number(0, 0, 2**31 - 1, help="first seed")
    perturbed: float = number(0.5, 0, 1, help="share of episodes in which the expert is disturbed")
    expert_share: float = number(0.3, 0, 1, help="of a policy's chunks: those that the expert executes")
    frame_stride: int = number(2, 1, 10_000, help="control steps between two images that are kept")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@dataclass
class DemosExportSettings(CommandSettings):
    """`kerv demos export`: demonstrations for other tools."""

    format: str = choice("lerobot", "lerobot", help="a LeRobot dataset of version 3")
    demos: str = setting("mt10", DEMOS)
    to: str = setting("", "folder; empty: <results>/lerobot/<demos>")


@dataclass
class DemosImportSettings(CommandSettings):
    """`kerv demos import`: recorded episodes of another tool as demonstrations (docs/data.md)."""

    format: str = choice("lerobot", "lerobot", help="a LeRobot dataset")
    source: str = setting("", "folder of the dataset")
    name: str | None = setting(None, "default: the folder's")
    camera: str = setting("", "which of its images; empty: the first")
    episodes: int = number(0, 0, 1_000_000, help="the first ones; 0: all")
    dofs: str = choice("own", "own", "openvla", help="names of the DoFs")
    strict: list[str] | None = setting(None, "DoFs that are never relaxed; null: those with gripper in their name")
    tail: int = number(8, 0, 1024, help="copies of the last action behind an episode, for chunks at its end")


@dataclass(kw_only=True)
class DemonstrationSettings(TaskSettings):
    """Settings of every command that makes something of a target and its demonstrations."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu"}

    policy: PolicySettings = setting(PolicySettings, POLICY)
    demos: str = setting("", TARGET_DEMOS)


@dataclass
class TrainDrafterSettings(DemonstrationSettings):
    """`kerv train drafter`: policy.target is imitated; policy.drafter, policy.early: name of the new one."""

    # drafter=early has optimisation settings of its own, so that it comes behind train
    groups: ClassVar = {"policy": "vision", "train": "drafter", "drafter": "eagle", "runtime": "auto"}

    log: str = choice("none", *TRACKERS, help=LOG)
    drafter: Any = setting(chosen("drafter", "eagle"), "its shapes and loss: eagle, early, scout")
    train: TrainSettings = setting(TrainSettings, "optimisation")


@dataclass
class PrepareSettings(DemonstrationSettings):
    """`kerv prepare`: everything that methods need of policy.target."""

    groups: ClassVar = {"policy": "vision", "runtime": "auto"}

    methods: list[str] = setting([], "their names; empty: all")
    steps: int = number(0, 0, 10**9, help="optimisation steps of each drafter; 0: those of kerv train drafter")


@dataclass
class DoctorSettings(RunSettings):
    """`kerv doctor`. With a target or an environment it checks that alone."""

    groups: ClassVar = {"world": "default", "runtime": "cpu"}

    policy: PolicySettings = setting(lambda: PolicySettings(target=""), "the target to check")
    environment: str | None = setting(None, "the environment to check")
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1, help="of the world that is drawn")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


PROJECTIONS = {"A100 80GB": [2039.0, 312.0], "H100 SXM": [3350.0, 989.0], "RTX 4090": [1008.0, 165.0]}


@dataclass
class BenchSettings(RunSettings):
    """`kerv bench`: how far a target is from what the device can do."""

    model: str = setting("mt10-vision", "a policy, or a shape of conf/target with random weights")
    dtype: str = choice(
        "auto",
        "auto",
        "float32",
        "bfloat16",
        "float16",
        help="of a shape; auto: the faster one",
    )
    repeats: int = number(30, 3, 100_000, help="of every measurement, for medians and 95th percentiles")
    tokens: list[int] = setting([7, 16], "N, tokens of a chunk; of a shape: at most", **limits(4, 256))
    projected: str = setting("", "a shape of conf/target whose profiles on `projections` are written too")
    projections: dict[str, list[float]] = setting(PROJECTIONS, "device -> published GB/s and dense bfloat16 TFLOP/s")

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

    only: str | None = setting(None, "one study, by name or file; default: all that are there")
    on: list[str] = setting([], "profiles of 'kerv bench' that price the study's decodes")
    loss: float = number(3.0, above=0, most=99.9, help="--choose: bound on the loss of success, points")


@dataclass
class BuildTargetSettings(RunSettings):
    """`kerv build target`: a published checkpoint as a target of ours. Nothing is copied: it stays where it lies."""

    checkpoint: str = setting("", "folder of a Hugging Face checkpoint")
    family: str = setting("openvla", "kind of target")
    name: str = setting("openvla", "folder below <results>/artifacts/target, or a path")
    statistics: str | None = setting(None, "data set whose actions it emits; null: the only one")
    environment: str | None = setting(None, "whose DoFs, control rate and camera it has; null: OpenVLA's own")
    control_hz: float = number(5.0, above=0, most=10_000, help="control steps per second, without an environment")
    camera: str = setting("", "image it is shown; empty: the environment's first camera, else primary")
    prompt: str = choice("openvla", "openvla", "openvla_v01", help="text around the instruction")
    crop: bool = setting(False, "show the central 90 %: for checkpoints fine-tuned with augmented images (LIBERO's)")
    libero: bool = setting(False, "before that a JPEG round trip and Lanczos, as OpenVLA's evaluation on LIBERO does")
    int8: bool = setting(False, "the language model's layers with one byte per weight")
    prompt_tokens: int = number(64, 1, 65_536, help="longest prompt, without the vision tokens")


@dataclass
class BuildPolicySettings(CommandSettings):
    """`kerv build policy`: a policy of a release, which a wheel leaves out."""

    source: str = setting("", "archive of the policy's folder (.tar.gz), by URL or path")
    sha256: str = setting("", "of the archive; of a policy of kerv's the weights' hashes suffice")


@dataclass
class BuildDrafterSettings(RunSettings):
    """`kerv build drafter`: a drafter in the public EAGLE or Spec-VLA layout. policy.drafter: its new name."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu"}

    policy: PolicySettings = setting(PolicySettings, POLICY)
    checkpoint: str = setting("", "folder with config.json and model.safetensors")
    positions: str = choice("sequence", "sequence", "text", help="docs/methods.md §2.2")
    mask: str = choice("causal", "causal", "prompt", help="docs/methods.md §2.2")


@dataclass
class BuildDatastoreSettings(DemonstrationSettings):
    """`kerv build datastore` (docs/methods.md §4.1): policy.target gives the features and the tokens."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu"}

    name: str | None = setting(None, "default: datastore/ beside the target")
    episodes: int = number(0, 0, 100_000, help=FIRST_EPISODES)
    stride: int = number(1, 1, 10_000, help="every so many of an episode's observations become entries")
    half: bool = setting(False, "keys on disk in float16: half the size, for shipping")
    components: int = number(0, 0, 65_536, help="directions that keys are projected onto; 0: keys stay as they are")
    key: list[str] = setting(["scene"], "pooled parts of the prompt: scene, vision, proprioception")


@dataclass
class CalibrateSettings(DemonstrationSettings):
    """`kerv calibrate` (docs/methods.md §3, §4): noise of the predictors, K_S, boundary ranges and skip levels."""

    name: str | None = setting(None, "default: beside the target")
    episodes: int = number(0, 0, 100_000, help=FIRST_EPISODES)
    held_out: float = number(0.1, above=0, most=0.5, help="share of episodes that the errors are measured on")
    window: int = number(10, 4, 10_000, help="control steps of history; predictors need four")
    epsilon: float = number(
        0.1, above=0, most=1e6, help="verify-skip: mean abs error of a chunk that is good enough, normalised units"
    )
    confidence: float = number(0.9, 0.5, 0.999999, help="verify-skip: share of skipped chunks below epsilon")
    boundary_windows: list[int] = setting([5, 15, 30], "positions; each has ranges of its own", **limits(3, 10_000))
    decodes: int = number(60, 0, 100_000, help="per task: decodes whose median variability is K_S; 0: none")
    proposer: Any = part("proposer", "drafter", "of the pre-sampling's decodes")
    acceptance: Any = part("acceptance", "relaxed", "of the pre-sampling's decodes")
    threshold: Any = part("threshold", "fixed", "of the pre-sampling's decodes")

    def check_together(self, prefix: str) -> None:
        """Raises UsageError without a window, or for a pre-sampling that drafts nothing."""
        if not self.boundary_windows:
            raise UsageError(f"{prefix}boundary_windows=[]: name at least one number of positions")
        if self.decodes and self.proposer.kind == "none":
            raise UsageError("proposer.kind=none drafts nothing to compare: choose a proposer, or decodes=0")


@dataclass
class CalibrateSuccessSettings(SweepSettings):
    """`kerv calibrate success` (docs/methods.md §4.6): all words but these go to the study's settings."""

    groups: ClassVar = {"study": "certify"}

    margin: float = number(5.0, above=0, most=99.9, help="points of success that may be lost against AR")
    delta: float = number(0.1, above=0, most=0.5, help="the certificate holds with probability 1 - delta")


def choices_of(schema: type) -> dict[str, str]:
    """The groups that these settings choose from -> the choice without a word, in the order of composition."""
    parts = {at.name: str(at.metadata["group"]) for at in fields(schema) if "group" in at.metadata}
    return parts | dict(getattr(schema, "groups", {}))


def settings_from(plain: Mapping[str, Any]) -> RolloutSettings:
    """The settings of a rollout from nested dicts and lists: `read_settings` with its class."""
    return read_settings(RolloutSettings, plain)


def read_settings(schema: type[S], plain: Mapping[str, Any]) -> S:
    """Settings of the class `schema` from nested dicts and lists, the inverse of `asdict`. The settings of a part get
    the class that its registration names.

    Raises:
        CheckpointError: not such settings. UnknownName: a part that is not registered here.
    """
    settings = manifests.read(schema, plain, "a stored setting")
    for group in SETTINGS_GROUPS:
        value = getattr(settings, group, None)
        if not isinstance(value, Mapping):
            continue  # the settings name no such part: its default
        part_settings = part_of(group, value["kind"]).settings
        setattr(settings, group, manifests.read(part_settings, value, f"a stored setting's {group}"))
    return settings
