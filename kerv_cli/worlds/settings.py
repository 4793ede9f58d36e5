"""Settings of worlds, cameras, stress, and imported demonstrations."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import find
from kerv_cli.base.settings import CommandSettings

# first one; demonstrations use smaller seeds, so training and evaluation share no initial state
EVALUATION_SEED = 100_000

MOST_STRESS = 4  # highest level of every kind


@dataclass(unsafe_hash=True)  # used as a dictionary key; not frozen, because Hydra must override it
class CameraSettings:
    """What the policy sees: one camera of the environment, or several views side by side (`views.views_of`)."""

    name: str = setting("", "camera, or several joined by + for views side by side; empty: the environment's first")
    fovy: float = number(45.0, above=0, most=179, help="vertical field of view, degrees")
    size: int = number(96, 8, 4096, help="pixels of a view, square")
    supersample: int = number(2, 1, 16, help="draw this many times as many pixels per side, then average")


@dataclass
class WorldSettings:
    """Settings of the simulated world of an episode."""

    camera: CameraSettings = setting(CameraSettings, "the policy's view")
    horizon: int = number(0, 0, 1_000_000, help="control steps of an episode; 0: the task's own")


@dataclass
class StressSettings:
    """Settings of a stress: a disturbance of known size (docs/stress.md)."""

    kind: str = setting("none", "what is disturbed: push, light or sensor")
    level: int = number(0, 0, MOST_STRESS, help="strength of the disturbance; 0: none")

    @property
    def active(self) -> bool:
        return self.kind != "none" and self.level > 0

    def check_together(self, prefix: str) -> None:
        if self.kind != "none":  # else the kinds, which import numpy, are not loaded
            find("stress", self.kind, f"{prefix}kind")
        elif self.level:
            raise UsageError(f"{prefix}level={self.level} without {prefix}kind: name what to disturb")


@dataclass
class RolloutWorldSettings(WorldSettings):
    """Settings of a rollout's world. A stress makes this world differ from that of the demonstrations."""

    stress: StressSettings = setting(StressSettings, "disturbance of the world")


@dataclass
class DemosImportSettings(CommandSettings):
    """Settings of `kerv demos import` (docs/data.md)."""

    format: str = choice("lerobot", "lerobot", help="a LeRobot dataset")
    source: str = setting("", "folder of the dataset")
    name: str | None = setting(None, "name of the demonstrations; null: the folder's")
    camera: str = setting("", "camera whose images are read; empty: the first")
    episodes: int = number(0, 0, 1_000_000, help="number of episodes, from the first; 0: all")
    environment: str = setting(
        "", "environment that the data were recorded in, such as metaworld; empty: none of kerv's"
    )
    dofs: str = choice("own", "own", "openvla", help="names of the DoFs: the dataset's own, or OpenVLA's")
    strict: list[str] | None = setting(None, "DoFs that are never relaxed; null: those with gripper in their name")
    tail: int = number(
        8, 0, 1024, help="copies of the last action after an episode, for chunks that begin near its end"
    )
