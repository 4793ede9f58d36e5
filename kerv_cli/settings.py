"""Every setting a command can take, as plain dataclasses. The YAML files under `conf/` fill them.

Nothing heavy is imported here: a wrong override must be answered before torch or MuJoCo load.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

EVALUATION_SEED = 100_000
"""First evaluation seed. Demonstrations use seeds below it, so training and evaluation never share a world."""


@dataclass
class CameraSettings:
    name: str = "corner4"
    fovy: float = 45.0
    size: int = 96  # pixels, square
    supersample: int = 2


@dataclass
class WorldSettings:
    camera: CameraSettings = field(default_factory=CameraSettings)
    horizon: int = 500  # control steps


@dataclass
class RuntimeSettings:
    device: str = "cpu"  # cpu | cuda | auto
    dtype: str = "float32"
    threads: int = 1  # torch threads of each process
    workers: int = 1  # processes


@dataclass
class ProposerSettings:
    """Who drafts (METHODS §2.2, §4, §5)."""

    kind: str = "none"  # none | drafter | hold | jacobi | ...
    depth: int = 5  # draft depth, tokens
    top_k: int = 8  # children expanded per level
    nodes: int = 50  # tree nodes kept after reranking


@dataclass
class AcceptanceSettings:
    """Which drafts are good enough (METHODS §2.1)."""

    kind: str = "strict"  # strict | relaxed | sequence
    strict_gripper: bool = False  # the gripper's tokens must equal the verdict
    group_limit: int = 30  # sequence: summed bias of a kinematic group, bins
    token_limit: int = 15  # sequence: bias of one token, bins


@dataclass
class ThresholdSettings:
    """How far a draft may be from the verdict (METHODS §3.2)."""

    kind: str = "fixed"  # fixed | kinematic | change | schedule
    r: int = 0  # bins


@dataclass
class RectifierSettings:
    """What happens after a rejection (METHODS §3.1)."""

    kind: str = "reinfer"


@dataclass
class BoundarySettings:
    """Which proposer drafts now (METHODS §4.4)."""

    kind: str = "always"


@dataclass
class MethodSettings:
    """A method is a composition of parts, never a class of its own."""

    name: str = "ar"
    proposer: ProposerSettings = field(default_factory=ProposerSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    threshold: ThresholdSettings = field(default_factory=ThresholdSettings)
    rectifier: RectifierSettings = field(default_factory=RectifierSettings)
    boundary: BoundarySettings = field(default_factory=BoundarySettings)


@dataclass
class PolicySettings:
    """Which weights: a name under results/pretrained or results/artifacts/target, or a folder."""

    target: str = "mt10-vision"
    drafter: str | None = None  # default: the drafter beside the target


@dataclass
class RolloutSettings:
    """`kerv rollout`: episodes of one method."""

    task: list[str] = field(default_factory=lambda: ["MT10"])  # task names and suites
    episodes: int = 3  # per task
    seed: int = EVALUATION_SEED  # first seed; episode i uses seed + i in every setting: that is the pairing
    policy: PolicySettings = field(default_factory=PolicySettings)
    method: str = "ar"  # name of the composition; its parts follow
    proposer: ProposerSettings = field(default_factory=ProposerSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    threshold: ThresholdSettings = field(default_factory=ThresholdSettings)
    rectifier: RectifierSettings = field(default_factory=RectifierSettings)
    boundary: BoundarySettings = field(default_factory=BoundarySettings)
    world: WorldSettings = field(default_factory=WorldSettings)
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    deviation_every: int = 0  # decodes between two deviation samples; 0: never
    record: int = 1  # episodes per task that are saved as .rrd; -1: all
    record_size: int = 240  # pixels of the logged camera
    results: str = "results"

    def parts(self) -> MethodSettings:
        """The method's parts alone: what a decoder is built from."""
        return MethodSettings(
            self.method, self.proposer, self.acceptance, self.threshold, self.rectifier, self.boundary
        )


@dataclass
class StudySettings:
    """`conf/study/*.yaml`: which settings are compared."""

    name: str = "threshold"
    title: str = ""
    baseline: str = "ar"  # label of the setting that the others are compared with
    settings: dict[str, str] = field(default_factory=dict)  # label -> overrides; comma lists expand into a grid
    axis: str = ""  # config key on the plot's x axis, e.g. threshold.r


@dataclass
class SweepSettings:
    """`kerv sweep`: a study's settings over tasks and seeds."""

    study: StudySettings = field(default_factory=StudySettings)
    rollout: RolloutSettings = field(default_factory=RolloutSettings)
    results: str = "results"


def as_plain(settings: Any) -> dict[str, Any]:
    """A settings dataclass as nested dicts and lists."""
    import dataclasses

    return dataclasses.asdict(settings)
