"""Settings of demonstrations, trainings and what is built or calibrated from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.settings import RunSettings, TaskSettings, chosen, part
from kerv_cli.episodes.settings import DEFAULT_TASKS, SweepSettings
from kerv_cli.methods.settings import POLICY, MethodSettings, PolicySettings
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.worlds.settings import WorldSettings

DEMOS = "demonstrations, by name"
TARGET_DEMOS = f"{DEMOS}; empty: those that the target was trained on"
TRACKERS = ("none", "trackio", "wandb", "tensorboard")
LOG = "where the curves are drawn while it trains"
FIRST_EPISODES = "per task, the first ones by seed; 0: all"


@dataclass
class TrainSettings:
    """Optimisation. The batch of step s depends only on (seed, s), so a resumed run repeats the uninterrupted one."""

    steps: int = number(20_000, 1, 10**9, help="optimisation steps")
    batch: int = number(64, 1, 65_536, help="samples per step")
    lr: float = number(1e-3, 0, 10, help="highest learning rate")
    warmup: int = number(300, 0, 10**9, help="first steps, while the learning rate rises")
    weight_decay: float = number(0.02, 0, 100, help="AdamW's")
    clip: float = number(1.0, above=0, most=1e9, help="largest norm of the gradient")
    ema: float = number(0.999, 0, 0.999999, help="decay of the moving average of the weights, which is what is saved")
    init: str | None = setting(None, "target whose weights it begins with; its chunk may be shorter or longer")
    label_sigma: float = number(1.0, 0, 1000, help="bins over which a label is spread (Gaussian); 0: one-hot")
    balance: float = number(0.0, 0, 1, help="0 draws all samples alike, 1 all tasks")
    scene_weight: float = number(1.0, 0, 1e6, help="weight of the position loss (vision only)")
    places: str = choice(
        "state",
        "state",
        "path",
        help="positions learnt: state: of object and goal; path: of the hand, later in the episode",
    )
    colour: float = number(0.0, 0, 3, help="random light on the images: spread of its logarithm")
    scene_steps: int = number(0, 0, 10**9, help="first steps, which train only the vision encoder, on positions")
    held_out: float = number(0.1, above=0, most=0.5, help="share of episodes kept for validation")
    validate_every: int = number(2_000, 1, 10**9, help="steps between two validations")
    closed_loop: int = number(0, 0, 100_000, help="closed-loop episodes per task at every validation")
    seed: int = number(0, 0, 2**31 - 1, help="of initial weights and order of samples")
    bf16: bool = setting(True, "training forward in bfloat16, on a GPU or a CPU with AMX")
    stored: str = choice("float32", "float32", "float16", "int8", help="number format of the weights on disk")


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
    expert_share: float = number(0.3, 0, 1, help="share of a policy's chunks in which the expert acts")
    frame_stride: int = number(2, 1, 10_000, help="control steps between two images that are kept")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@dataclass(kw_only=True)
class DemonstrationSettings(TaskSettings):
    """Settings of every command that makes something of a target and its demonstrations."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu"}

    policy: PolicySettings = setting(PolicySettings, POLICY)
    demos: str = setting("", TARGET_DEMOS)


@dataclass
class TrainDrafterSettings(DemonstrationSettings):
    """`kerv train drafter`: policy.target is imitated; policy.artifacts.KIND: name of the new one."""

    # after train, because drafter=early has optimisation settings of its own
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
class BuildDrafterSettings(RunSettings):
    """`kerv build drafter`: a drafter in the public EAGLE or Spec-VLA layout, named policy.artifacts.drafter."""

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
    stride: int = number(1, 1, 10_000, help="observations between two entries")
    half: bool = setting(False, "store keys in float16, half the size")
    components: int = number(0, 0, 65_536, help="directions onto which keys are projected; 0: none")
    key: list[str] = setting(["scene"], "pooled parts of the prompt: scene, vision, proprioception")


@dataclass
class CalibrateSettings(DemonstrationSettings):
    """`kerv calibrate` (docs/methods.md §3, §4): noise of the predictors, K_S, boundary ranges and skip levels."""

    name: str | None = setting(None, "default: beside the target")
    episodes: int = number(0, 0, 100_000, help=FIRST_EPISODES)
    held_out: float = number(0.1, above=0, most=0.5, help="share of episodes that the errors are measured on")
    window: int = number(10, 4, 10_000, help="control steps of history; predictors need four")
    epsilon: float = number(
        0.1, above=0, most=1e6, help="verify-skip: largest mean absolute error of a good chunk, normalised units"
    )
    confidence: float = number(0.9, 0.5, 0.999999, help="verify-skip: share of skipped chunks that must be good")
    boundary_windows: list[int] = setting([5, 15, 30], "positions; each has ranges of its own", **limits(3, 10_000))
    decodes: int = number(60, 0, 100_000, help="per task: decodes whose median variability is K_S; 0: none")
    proposer: Any = part("proposer", "drafter", "of the pre-sampling's decodes")
    acceptance: Any = part("acceptance", "relaxed", "of the pre-sampling's decodes")
    threshold: Any = part("threshold", "fixed", "of the pre-sampling's decodes")

    def check_together(self, prefix: str) -> None:
        """Refuse a calibration without a window, or pre-sampling that drafts nothing."""
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
