"""Settings of rollouts and of studies, which compare several settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import CommandSettings, TaskSettings
from kerv_cli.methods.settings import EXPERT, REMOTE, MethodSettings
from kerv_cli.worlds.settings import EVALUATION_SEED, RolloutWorldSettings

WAITS, REAL = "waits", "real"
MEASURED, CONSTANT, PROFILE = "measured", "constant", "profile"
# Value of `rollout.delay_compensation`. Actions of a new chunk that are already too old are then not executed.
CHUNK = "chunk"


@dataclass
class TimingSettings:
    """Settings `rollout.*`: what the world does while the policy decodes (docs/methods.md §8)."""

    clock: str = choice(WAITS, WAITS, REAL, help="whether the world waits while the policy decodes, or goes on")
    latency: str = choice(MEASURED, MEASURED, CONSTANT, PROFILE, help="clock=real: where latencies come from")
    latency_ms: float = number(0.0, 0, 600_000, help="latency=constant: milliseconds per decode")
    profile: str = setting("", "latency=profile: result file of `kerv bench`: its path, or its name in <results>/bench")
    delay_compensation: str = choice("none", "none", CHUNK, help="chunk: drop actions that come too late")

    def check_together(self, prefix: str) -> None:
        if self.clock == REAL and self.latency == PROFILE and not self.profile:
            raise UsageError(
                f"{prefix}latency=profile: name a document of 'kerv bench', such as {prefix}profile=mt10-h1-float32"
            )


DEFAULT_TASKS = ["MT10"]  # default tasks, if the target's description names none


@dataclass
class RolloutSettings(MethodSettings, TaskSettings):
    """Settings of `kerv rollout`: episodes of one method."""

    # last, because a method's file overrides the parts chosen before
    groups: ClassVar = {"policy": "vision", "world": "default", "runtime": "cpu", "method": "ar"}

    episodes: int = number(3, 1, 1_000_000, help="episodes per task")
    # equal in all settings of a study, so that episodes with the same start are compared
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1, help="first seed; episode i has seed + i")
    world: RolloutWorldSettings = setting(RolloutWorldSettings, "camera, length of an episode, stress")
    rollout: TimingSettings = setting(TimingSettings, "what the world does while the policy decodes")
    deviation_every: int = number(0, 0, 1_000_000, help="compare every n-th decode with AR's actions; 0: never")
    record: int = number(1, -1, 1_000_000, help="episodes per task that are saved as .rrd; -1: all")
    record_size: int = number(240, 8, 4096, help="pixels of the recorded camera")

    def __post_init__(self) -> None:
        if self.policy.kind == EXPERT:
            self.method = EXPERT  # the expert uses no decoding method
        if self.policy.kind == REMOTE:
            self.method = REMOTE if self.method == "ar" else self.method  # the default
            self.policy.target = self.policy.name or self.policy.url

    def check_together(self, prefix: str) -> None:
        if self.policy.kind == REMOTE and self.method != REMOTE:
            raise UsageError(f"method={self.method} with policy=remote: the server decides it, leave it out", "method")


@dataclass
class StudySettings:
    """Contents of a study's file, `conf/study/*.yaml`: which settings are compared with which baseline."""

    name: str = setting("", "name in the results; empty: the file's name")
    title: str = setting("", "title of the tables and plots")
    baseline: str = setting("ar", "label of the setting that the others are compared with")
    common: str = setting("", "overrides of every setting, e.g. task=MT10 episodes=20; the command line overrides them")
    settings: dict[str, str] = setting({}, "label -> overrides; comma lists expand into a grid")
    axis: str = setting("", "key on the plot's x axis, e.g. threshold.r")
    block: int = number(5, 1, 10_000, help="number of seeds for which the settings take turns in one process")
    seconds: float = number(
        1.0, above=0, most=86_400, help="guess of the seconds per episode, for a plan without measured ones"
    )
    first: list[str] = setting([], "commands to run once before the study, which make what it needs")
    note: str = setting("", "a sentence printed below the table, such as what to look for")
    machines: list[str] = setting([], "profiles of 'kerv bench': also estimate the study's speeds on those machines")


@dataclass
class SweepSettings(CommandSettings):
    """Settings of `kerv sweep`, which runs a study: a comparison of several settings.

    Overrides on the command line that name none of these settings apply to every setting of the study.
    """

    groups: ClassVar = {"study": "threshold"}

    study: StudySettings = setting(StudySettings, "which settings are compared: a name in conf/study, or a file")
    rerun: str = choice("never", "never", "all", help="which existing episodes run again")
    loss: float = number(3.0, above=0, most=99.9, help="largest loss of success that the verdict accepts, points")


@dataclass(kw_only=True)
class WorkSettings(CommandSettings):
    """Settings of `kerv work`, which runs episodes that a sweep has planned."""

    study: str = setting("", "name or file of the study")
    run: str = setting("", "id of the command that has started this process, and ends it by closing its input")
