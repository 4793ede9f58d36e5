"""Settings of the commands that record demonstrations, train, build or calibrate, and the `Plan` of a command."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import owned
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.settings import REPLACE, TaskSettings, chosen
from kerv_cli.episodes.settings import DEFAULT_TASKS
from kerv_cli.methods.settings import POLICY, MethodSettings, PolicySettings
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds.settings import WorldSettings

T = TypeVar("T")

DEMOS = "name of the demonstrations"
QUICK = "a first policy in minutes: adds the settings in conf/quick.yaml"
FIRST_EPISODES = "episodes used per task, lowest seeds first; 0: all"


# Takes the title of a stage of the work. Returns a context manager that yields a progress function (done, total).
Stage = Callable[[str], AbstractContextManager[Callable[..., None]]]


def quietly(title: str) -> AbstractContextManager[Callable[..., None]]:
    return nullcontext(lambda *done: None)


@dataclass(frozen=True)
class Plan(Generic[T]):
    """A plan to make an artifact, with settings that were checked. Nothing is made until `make` is called.

    Attributes:
        kind: Kind of the artifact.
        path: Folder of the artifact, or the file of a calibration.
        text: What would be made, for `--plan`.
        work: Function that makes the artifact, and shows its stages.
        check: Function that refuses to replace existing files. It is called at once, and by `make` before `work`.
        seconds: Function that estimates the seconds of `work`, for `--plan`. None if they cannot be estimated.
        source: What the estimate is based on, or why there is none.
    """

    kind: str
    path: Path
    text: str
    work: Callable[[Stage], T]
    check: Callable[[], object]
    seconds: Callable[[], float] | None = None
    source: str = "from a few steps, measured now"

    def __post_init__(self) -> None:
        self.check()

    @property
    def folder(self) -> Path:
        return self.path.parent if self.kind == "calibration" else self.path

    def make(self, stage: Stage = quietly) -> T:
        with owned(self.path, self.check):
            return self.work(stage)


@dataclass
class TrainSettings:
    """Settings of the optimisation."""

    steps: int = number(20_000, 1, 10**9, help="optimisation steps")
    batch: int = number(64, 1, 65_536, help="samples per step")
    lr: float = number(1e-3, 0, 10, help="highest learning rate")
    warmup: int = number(300, 0, 10**9, help="number of first steps in which the learning rate rises")
    weight_decay: float = number(0.02, 0, 100, help="weight decay of AdamW")
    clip: float = number(1.0, above=0, most=1e9, help="maximum norm of the gradient")
    ema: float = number(0.999, 0, 0.999999, help="decay of the moving average of the weights; the average is saved")
    init: str | None = setting(None, "target whose weights training starts from; its chunk length may differ")
    label_sigma: float = number(1.0, 0, 1000, help="Gaussian label smoothing: standard deviation in bins; 0: one-hot")
    balance: float = number(0.0, 0, 1, help="0: all samples are equally likely; 1: all tasks are")
    scene_weight: float = number(1.0, 0, 1e6, help="weight of the loss on estimated positions (vision only)")
    places: str = choice(
        "state",
        "state",
        "path",
        help="positions to estimate: state: of object and goal; path: of the hand later, also if the state holds none",
    )
    colour: float = number(0.0, 0, 3, help="random light on training images: largest spread of log brightness; 0: none")
    scene_steps: int = number(0, 0, 10**9, help="first steps, which train only the vision encoder, on positions")
    held_out: float = number(0.1, above=0, most=0.5, help="share of episodes kept for validation")
    validate_every: int = number(2_000, 1, 10**9, help="steps between two validations")
    undisturbed: bool = setting(False, "train only on chunks whose actions were all executed as the expert chose them")
    closed_loop: int = number(0, 0, 100_000, help="simulated episodes per task at every validation; 0: none")
    seed: int = number(0, 0, 2**31 - 1, help="seed of the initial weights and of the order of samples")
    bf16: bool = setting(True, "train in bfloat16 on a GPU or a CPU with AMX or AVX512-BF16; else float32")
    stored: str = choice("float32", "float32", "float16", "int8", help="number format of the weights on disk")


@dataclass
class TrainTargetSettings(TaskSettings):
    """Settings of `kerv train target`, which trains a policy on demonstrations."""

    groups: ClassVar = {"target": "small", "train": "target", "world": "default", "runtime": "auto"}

    name: str = setting("mine", "name of the new folder in <results>/artifacts/target")
    replace: bool = setting(False, REPLACE)
    task: list[str] = setting([], "tasks and suites; empty: all tasks of the demonstrations")
    demos: str = setting("", f"{DEMOS}; empty: the name that `kerv demos` gives to these tasks")
    quick: bool = setting(False, QUICK)
    target: TargetSettings = setting(TargetSettings, "shapes: nano, tiny, slim, small, … (conf/target)")
    train: TrainSettings = setting(TrainSettings, "optimisation")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@dataclass
class DemosSettings(MethodSettings, TaskSettings):
    """Settings of `kerv demos`, which records demonstrations.

    `policy` acts in the environment. The default is the scripted expert. If another policy acts, the expert labels the
    states that this policy visits (DAgger).
    """

    groups: ClassVar = {"policy": "expert", "world": "default", "runtime": "workers", "method": "ar"}

    task: list[str] = setting(DEFAULT_TASKS, "tasks and suites: reach, drawer-open, MT10, …")
    name: str | None = setting(None, "name of the demonstrations; default: the names in `task`, in small letters")
    episodes: int = number(100, 1, 100_000, help="episodes per task")
    seed: int = number(0, 0, 2**31 - 1, help="first seed of every task; must be a training seed")
    perturbed: float = number(0.5, 0, 1, help="share of episodes in which the expert is disturbed")
    quiet: int = number(0, 0, 10_000, help="control steps between two disturbances; 0: noise in every step")
    expert_share: float = number(0.3, 0, 1, help="if a policy acts: share of chunks in which the expert acts instead")
    frame_stride: int = number(2, 1, 10_000, help="control steps between two stored images")
    tail: int = number(8, 0, 1024, help="control steps recorded after the success, for chunks that begin near it")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@dataclass(kw_only=True)
class DemonstrationSettings(TaskSettings):
    """Settings shared by commands that make an artifact from a target and its demonstrations."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu"}

    policy: PolicySettings = setting(PolicySettings, POLICY)
    demos: str = setting("", f"{DEMOS}; empty: the ones that the target was trained on")
    replace: bool = setting(False, REPLACE)


@dataclass
class TrainDrafterSettings(DemonstrationSettings):
    """Settings of `kerv train drafter`.

    The drafter learns to imitate `policy.target`. The setting `policy.artifacts.KIND` gives the new drafter's name; for
    kind `drafter` it is `policy.artifacts.drafter`.
    """

    # drafter comes after train, because drafter=early overrides some of train's settings
    groups: ClassVar = {"policy": "vision", "train": "drafter", "drafter": "drafter", "runtime": "auto"}

    drafter: Any = setting(chosen("drafter", "drafter"), "kind, with shapes and loss: drafter (EAGLE-2), early")
    train: TrainSettings = setting(TrainSettings, "optimisation")

    def check_together(self, prefix: str) -> None:
        unused = ("init", "balance", "undisturbed", "closed_loop", "colour", "places")
        refuse_unused(self.train, unused, ": only the training of a target has this setting")


@dataclass
class PrepareSettings(DemonstrationSettings):
    """Settings of `kerv prepare`, which makes every missing artifact that the methods need for `policy.target`."""

    groups: ClassVar = {"policy": "vision", "runtime": "auto"}

    quick: bool = setting(False, QUICK)
    methods: list[str] = setting([], "names of the methods; empty: all")
    steps: int = number(0, 0, 10**9, help="optimisation steps of each drafter; 0: as kerv train drafter")


@dataclass
class BuildDatastoreSettings(DemonstrationSettings):
    """Settings of `kerv build datastore`, which stores demonstrated chunks for retrieval (docs/methods.md §4.1).

    `policy.target` encodes the observations, which become the search keys. The expert's next actions are stored as
    action tokens.
    """

    episodes: int = number(0, 0, 100_000, help=FIRST_EPISODES)
    half: bool = setting(False, "store keys in float16, half the size")
    components: int = number(0, 0, 65_536, help="project keys onto this many leading directions; 0: no projection")
    key: list[str] = setting(["scene"], "parts of the prompt that make the key: scene, vision, proprioception")


@dataclass
class CalibrateSettings(DemonstrationSettings):
    """Settings of `kerv calibrate`, which measures on demonstrations what KERV and HeiSD need (docs/methods.md §3, §4).

    It measures four things: the noise of the kinematic predictors; each task's reference level K_S of the kinematic
    variability; the ranges of the hand's curvature and path length, with which HeiSD chooses between retrieval and
    drafter; and for each task the smallest similarity at which a retrieved draft is executed without verification.
    """

    episodes: int = number(0, 0, 100_000, help=FIRST_EPISODES)
    window: int = number(10, 4, 10, help="control steps of history that the predictors see; an episode keeps 10")
    epsilon: float = number(
        0.1, above=0, most=1e6, help="verify-skip: largest mean absolute error of a good chunk, normalised units"
    )
    confidence: float = number(0.9, 0.5, 0.999999, help="verify-skip: share of skipped chunks that must be good")
    boundary_windows: list[int] = setting(
        [5, 15, 30], "window lengths w of the boundary, in positions", **limits(3, 10_000)
    )
    decodes: int = number(60, 0, 100_000, help="decodes per task from which K_S is measured; 0: no K_S")

    def check_together(self, prefix: str) -> None:
        if not self.boundary_windows:
            raise UsageError(f"{prefix}boundary_windows=[]: name at least one number of positions")


def refuse_unused(train: TrainSettings, keys: Sequence[str], why: str) -> None:
    """Refuse optimisation settings that the training would ignore."""
    for key in keys:
        if (value := getattr(train, key)) != getattr(TrainSettings(), key):
            raise UsageError(f"train.{key}={str(value).lower()}{why}")
