"""The specification of an environment, as data, and the protocols of its simulator: a world and an expert.

Imports nothing heavy, so that completion can read the tables of tasks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import load
from kerv_cli.base.views import views_of
from kerv_cli.worlds.settings import CameraSettings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace


@dataclass(frozen=True)
class Task:
    """One manipulation task.

    name: unique over all environments. instruction: given to the policy. difficulty: the group of tasks that are
    averaged together.
    """

    name: str
    instruction: str
    difficulty: str


@dataclass(frozen=True)
class Seeds:
    """Three disjoint ranges of episode seeds, so that training, tuning and reported episodes never share an initial
    state.
    """

    training: range = range(50_000)
    selection: range = range(50_000, 100_000)
    evaluation: range = range(100_000, 2**31)

    def check(self, seeds: Iterable[int], purpose: str, what: str) -> None:
        """Refuses seeds that are not for `purpose`: training, selection or evaluation. what: their name in the message.

        Raises:
            UsageError: the first seed outside the range.
        """
        allowed: range = getattr(self, purpose)
        wrong = next((seed for seed in seeds if seed not in allowed), None)
        if wrong is None:
            return
        kinds = [name for name in ("training", "selection", "evaluation") if wrong in getattr(self, name)]
        kind = f"is for {kinds[0]}" if kinds else "is none"
        raise UsageError(f"{what}: seed {wrong} {kind}; seeds for {purpose} are {allowed.start} to {allowed.stop - 1}")


class World(Protocol):
    """One task's simulator, reused over episodes. Open it in the process that uses it.

    spec: its environment. task: full name. instruction: given to the policy. camera: the default view of `frame`.
    horizon: control steps per episode. steps: executed since the reset. success: the task's flag at this step; it may
    be lost again. succeeded: whether it was set at any step of this episode.
    """

    spec: EnvironmentSpec
    task: str
    instruction: str
    camera: CameraSettings
    horizon: int
    steps: int
    success: bool
    succeeded: bool

    def reset(self, seed: int) -> Observation:
        """Starts the episode of `seed`, the same on every machine with the same simulator versions.

        Raises:
            UsageError: a negative seed.
        """

    def step(self, action: ArrayLike) -> Observation:
        """Executes one control step of an action (D,) in environment units, clipped to the action space's limits.

        Raises:
            KervError: past the horizon, before the first reset, or an action that is not D finite numbers.
        """

    def frame(self, camera: CameraSettings | None = None) -> NDArray[np.uint8]:
        """(size, size, 3) uint8 RGB, upright, of the current state; several views lie side by side, `frame_shape`.
        camera: another view than the world's own.

        Raises:
            RenderingUnavailable: nothing can be drawn here.
        """

    def observe(self, cameras: Sequence[str]) -> Observation:
        """The latest observation with a new image of each of `cameras`; no other camera is drawn."""

    @property
    def observation(self) -> Observation:
        """The latest observation, without images. Raises KervError before the first reset."""

    @property
    def done(self) -> bool:
        """Whether the episode succeeded at any step so far, or reached the horizon."""

    @property
    def initial_state(self) -> NDArray[np.float64]:
        """(n,) numbers that, with the task, rebuild the episode's start, e.g. the object's position."""

    @property
    def end_effector(self) -> NDArray[np.float64]:
        """(3,) metres, in the simulator's world frame."""

    @property
    def gripper(self) -> float:
        """Opening, 0 closed to 1 open; 1 where there is no gripper."""

    def close(self) -> None:
        """Frees simulator and graphics; a later reset builds them anew."""

    def __enter__(self) -> World: ...

    def __exit__(self, *exception: object) -> None: ...


class Expert(Protocol):
    """A scripted controller of one task. It reads the privileged state and keeps none of its own."""

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        """The action (D,) in environment units, within the action space's limits."""


@dataclass(frozen=True)
class EnvironmentSpec:
    """The specification of an environment: all its constants, and where its simulator is.

    name: as registered. actions: with the environment's limits as normalisation. observation: the privileged state
    begins with the proprioception. tasks: by full name. suites: name in capitals -> full task names. difficulties:
    groups of tasks, in the order of tables. horizon: control steps of an episode, the most that the simulator runs.
    cameras: names; the first is the default. seeds: see `Seeds`. world_class, expert_class: `module:class`, called
    with (spec, task, camera, horizon) and with (spec, task); a recording has no world, an environment may have no
    experts. upside_down: cameras whose raw images are rotated by 180 degrees. suffix: ending of all full task names,
    which users may leave out. packages: those whose versions determine the physics. grip: actions of the strict DoFs
    that close and that open the gripper; empty where there is none. experts: task -> name of its expert, where that is
    another than the simulator's own: it determines what a recording holds and what policy=expert does.
    """

    name: str
    actions: ActionSpace
    observation: ObservationSpace
    tasks: Mapping[str, Task]
    suites: Mapping[str, tuple[str, ...]]
    difficulties: tuple[str, ...]
    horizon: int
    cameras: tuple[str, ...]
    world_class: str = ""
    expert_class: str = ""
    upside_down: tuple[str, ...] = ()
    suffix: str = ""
    packages: tuple[str, ...] = ()
    grip: tuple[float, float] | tuple[()] = ()
    seeds: Seeds = Seeds()
    experts: Mapping[str, str] = field(default_factory=dict)

    def full_name(self, task: str) -> str | None:
        """The task's full name; None when it is none of this environment's."""
        return next((name for name in (task, task + self.suffix) if name in self.tasks), None)

    def task(self, name: str) -> Task:
        """The task of that full or short name.

        Raises:
            UnknownName: there is none; the message names the nearest ones.
        """
        full = self.full_name(name)
        if full is None:
            raise UnknownName("task", name, self.tasks)
        return self.tasks[full]

    def expand(self, name: str) -> tuple[str, ...]:
        """Full names of the suite's tasks, or of the one task; empty when the environment knows neither."""
        suite = self.suites.get(name.upper())
        full = self.full_name(name)
        return suite or ((full,) if full else ())

    def camera_name(self, name: str) -> str:
        """`name`, or the environment's first camera where it is empty. Several views are joined, see `views_of`.

        Raises:
            UnknownName: the environment has no such camera. UsageError: an impossible view.
        """
        for view in views_of(name) if name else ():
            if view.camera not in self.cameras:
                raise UnknownName("camera", view.camera, self.cameras)
        return name or self.cameras[0]

    def camera(self, settings: CameraSettings | None = None) -> CameraSettings:
        """A copy of the settings with the name of a camera of this environment, by default its first.

        Raises:
            UnknownName: the environment has no such camera. UsageError: an impossible view, or a number out of range.
        """
        settings = settings or CameraSettings()
        check_settings(settings, "camera")
        return replace(settings, name=self.camera_name(settings.name))

    def control_steps(self, horizon: int) -> int:
        """Control steps of an episode; 0: the environment's own horizon.

        Raises:
            UsageError: more than the simulator runs.
        """
        if not 0 <= horizon <= self.horizon:
            raise UsageError(f"horizon must lie between 1 and {self.horizon} control steps in {self.name}: {horizon}")
        return horizon or self.horizon

    def standstill(self, opening: float) -> NDArray[np.float64]:
        """The action (D,), environment units, that leaves the robot where it is: the middle of every DoF's limits, and
        of the strict ones the present opening of the gripper (0 closed to 1 open)."""
        action = self.actions.middle.copy()
        if self.grip:
            closed, opened = self.grip
            action[self.actions.is_strict] = closed + (opened - closed) * opening
        return action

    def open_world(self, task: str, camera: CameraSettings | None = None, horizon: int = 0) -> World:
        """A world of the task; its simulator is built at the first reset.

        Raises:
            UnknownName: no such task or camera. UsageError: a horizon that the simulator cannot run, or a recording.
        """
        if not self.world_class:
            raise UsageError(f"{self.name} is a recording: nothing can be executed in it")
        return load(self.world_class)(self, task, camera, horizon)

    def expert(self, task: str) -> Expert:
        """The scripted expert of the task.

        Raises:
            UnknownName: a task that does not exist. UsageError: the environment has no experts.
        """
        if not self.expert_class:
            raise UsageError(f"{self.name} has no scripted experts: record demonstrations with its own tools")
        return load(self.expert_class)(self, task)
