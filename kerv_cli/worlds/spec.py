"""Describe an environment: its constants as data (`EnvironmentSpec`) and the base class of its simulators (`World`).

Shapes: D degrees of freedom of an action, s numbers of the privileged state.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from typing import ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import load
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.worlds import Task
from kerv_cli.worlds.settings import CameraSettings, StressSettings
from kerv_cli.worlds.stress import NO_STRESS, Stress, StressPart, build
from kerv_cli.worlds.views import views_of

# scripted controller of one task: from an observation to an action (D,) within the limits, without memory
Expert: TypeAlias = Callable[[Observation], NDArray[np.float64]]


@dataclass(frozen=True)
class Seeds:
    """Three disjoint ranges of episode seeds, so that training and evaluation share no initial state.

    Attributes:
        training: Seeds for demonstrations.
        selection: Seeds for choosing settings and for calibration.
        evaluation: Seeds for reported results.
    """

    training: range = range(50_000)
    selection: range = range(50_000, 100_000)
    evaluation: range = range(100_000, 2**31)

    def check(self, seeds: Iterable[int], purpose: str, what: str) -> None:
        """Raise UsageError if a seed is outside the range for a purpose.

        Args:
            purpose: `training`, `selection` or `evaluation`.
            what: What the user typed, for the error message.
        """
        allowed: range = getattr(self, purpose)
        for seed in seeds:
            if seed not in allowed:
                kinds = (name for name in ("training", "selection", "evaluation") if seed in getattr(self, name))
                raise UsageError(
                    f"{what}: seed {seed} is for {next(kinds, 'nothing')}; "
                    f"seeds for {purpose} are {allowed.start} to {allowed.stop - 1}"
                )


@dataclass(frozen=True)
class EnvironmentSpec:
    """All constants of an environment, and the class of its simulator.

    Attributes:
        actions: Action space, with the environment's limits.
        observation: Observation space. The privileged state (all numbers of the simulator) begins with the
            proprioception.
        tasks: The tasks by full name.
        suites: The full names of each suite's tasks, by the suite's name in capitals.
        horizon: Largest number of control steps of an episode. Tasks without a horizon of their own use it.
        cameras: Names of the cameras. The first is the default.
        world_class: `module:class` of the `World`. Empty for a recorded dataset, in which nothing can be executed.
        expert_class: `module:class`, called with (spec, task) to make an `Expert`. Empty if there are no experts.
        upside_down: Cameras whose raw images must be rotated by 180 degrees.
        suffix: Ending of all full task names. Users may leave it out.
        packages: Python packages whose versions determine the physics. The first one is the simulator's.
        extra: Extra of kerv that installs the simulator (`pip install 'kerv[EXTRA]'`). Empty if no extra is needed.
        grip: Value of the gripper's DoF that closes the gripper, then the value that opens it. Empty without a gripper.
        experts: Names of kerv's experts by task, for tasks in which they replace the simulator's experts.
    """

    name: str
    actions: ActionSpace
    observation: ObservationSpace
    tasks: Mapping[str, Task]
    suites: Mapping[str, tuple[str, ...]]
    horizon: int
    cameras: tuple[str, ...]
    world_class: str = ""
    expert_class: str = ""
    upside_down: tuple[str, ...] = ()
    suffix: str = ""
    packages: tuple[str, ...] = ()
    extra: str = ""
    grip: tuple[float, float] | tuple[()] = ()
    seeds: Seeds = Seeds()
    experts: Mapping[str, str] = field(default_factory=dict)

    def full_name(self, task: str) -> str | None:
        return next((name for name in (task, task + self.suffix) if name in self.tasks), None)

    def task(self, name: str) -> Task:
        """Return the task with a full or short name, or raise UnknownName."""
        full = self.full_name(name)
        if full is None:
            raise UnknownName("task", name, self.tasks)
        return self.tasks[full]

    def expand(self, name: str) -> tuple[str, ...]:
        """Return the full names of the tasks for which `name` stands. Empty if it is neither a suite nor a task."""
        full = self.full_name(name)
        return self.suites.get(name.upper()) or ((full,) if full else ())

    def camera_name(self, name: str) -> str:
        """Check the name of a camera, or of several views joined by `+`. An empty name becomes the first camera.

        Raises:
            UnknownName: The environment has no such camera.
            UsageError: A view has an impossible field of view.
        """
        for view in views_of(name) if name else ():
            if view.camera not in self.cameras:
                raise UnknownName("camera", view.camera, self.cameras)
        return name or self.cameras[0]

    def camera(self, settings: CameraSettings | None = None) -> CameraSettings:
        """Check camera settings and return them. An empty name becomes the environment's first camera.

        Raises:
            UnknownName: The environment has no such camera.
            UsageError: A view has an impossible field of view, or a number is out of range.
        """
        settings = settings or CameraSettings()
        check_settings(settings, "camera")
        return replace(settings, name=self.camera_name(settings.name))

    def control_steps(self, horizon: int, tasks: Iterable[str] = ()) -> int:
        """Return the number of control steps of an episode.

        Args:
            horizon: The number to check. 0 stands for the default of the tasks.
            tasks: Full or short names. If there are none, the default is the environment's horizon.

        Raises:
            UsageError: The simulator cannot run that many control steps, or the tasks have different defaults.
        """
        if not 0 <= horizon <= self.horizon:
            raise UsageError(f"horizon={horizon}: {self.name} runs 1 to {self.horizon} control steps")
        found = sorted({self.task(name).horizon or self.horizon for name in tasks}) or [self.horizon]
        if not horizon and len(found) > 1:
            raise UsageError(
                f"episodes of these tasks have {' or '.join(map(str, found))} control steps: type "
                f"world.horizon={found[-1]}, or one command for each number"
            )
        return horizon or found[0]

    def check_stress(self, settings: StressSettings) -> None:
        """Raise UsageError if there is no such level, or the environment lacks something that the stress needs."""
        if not settings.active:
            return
        build(settings)
        offered = load(self.world_class).stressable if self.world_class else frozenset()
        offered |= {"position"} & {group.name for group in self.actions.groups}
        for need in StressPart.find(settings.kind).requires:
            if need not in offered:
                why = f"its worlds have no {need}" if self.world_class else "it is a recording"
                raise UsageError(f"world.stress.kind={settings.kind}: not possible in {self.name}: {why}")

    def standstill(self, opening: float) -> NDArray[np.float64]:
        """Return the action (D,) that keeps the robot where it is.

        Args:
            opening: Opening of the gripper to keep, from 0 (closed) to 1 (open).
        """
        action = self.actions.middle.copy()
        if self.grip:
            closed, opened = self.grip
            action[self.actions.is_strict] = closed + (opened - closed) * opening
        return action

    @property
    def installed(self) -> bool:
        """Whether the simulator's package is installed. True if kerv itself installs it."""
        try:
            return not self.extra or bool(version(self.packages[0]))
        except PackageNotFoundError:
            return False

    def check_installed(self, target: str = "NAME") -> None:
        """Refuse an environment whose simulator is not installed, or is installed in versions that do not work.

        Args:
            target: Name of the policy that should run in the environment, for the error message.

        Raises:
            UsageError: A package is missing or has a wrong version, or the environment is a recorded dataset.
        """
        if not self.world_class:
            raise UsageError(
                f"{self.name} is a recording: no episode can run in it. Serve the policy with 'kerv serve "
                f"policy.target={target}', or import the dataset again with environment=NAME, the simulator that "
                "recorded it"
            )
        if not self.installed:
            raise UsageError(f"{self.name} needs more packages: pip install 'kerv[{self.extra}]'")
        load(self.world_class).check_installed()

    def open_world(self, task: str, camera: CameraSettings | None = None, horizon: int = 0) -> World:
        """Return a world for a task, given by its full or short name. Its simulator is built at the first reset.

        Args:
            camera: Default view of `World.frame`. If None, the environment's first camera.
            horizon: Control steps of an episode. 0 stands for the task's default.

        Raises:
            UnknownName: There is no such task or camera.
            UsageError: The horizon is too large, the simulator is not installed, or the environment is a recorded
                dataset.
        """
        self.check_installed()
        return load(self.world_class)(self, task, camera, horizon)

    def check_experts(self, tasks: Iterable[str]) -> None:
        """Raise UsageError if a task has no scripted expert."""
        if not self.expert_class:
            raise UsageError(f"{self.name} has no scripted experts: record demonstrations with its own tools")
        alone = [name for name in tasks if not self.task(name).expert]
        if alone:
            others = f", nor for {len(alone) - 1} more of these tasks" * (len(alone) > 1)
            raise UsageError(
                f"{self.name} has no scripted expert for {alone[0]}{others}: name a policy, policy.target="
            )

    def expert(self, task: str) -> Expert:
        self.check_experts([task])
        return load(self.expert_class)(self, task)


class World(ABC):
    """Simulator of one task, used for many episodes. Open it in the process that uses it.

    A subclass implements `_start`, `_advance`, `_draw` and `initial_state`. It builds its simulator at the first reset.
    The same seed must give the same episode on every machine with the same versions of the simulator.

    Attributes:
        spec: The environment.
        task: Full name of the task.
        instruction: Sentence that the policy reads.
        camera: Default view of `frame`.
        horizon: Number of control steps of an episode.
        steps: Number of control steps since the reset.
        success: Success flag of the latest step. A later step may unset it.
        succeeded: Whether `success` was set at any step of this episode.
        stress: Disturbance of the episodes (docs/stress.md). A new value takes effect at the next reset.
        stressable: What a stress can change in this world: `actions`, `images` and `model` (the MuJoCo model).
    """

    stressable: ClassVar[frozenset[str]] = frozenset({"actions", "images"})

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        entry = spec.task(task)
        self.spec, self.task, self.instruction = spec, entry.name, entry.instruction
        self.camera, self.horizon = spec.camera(camera), spec.control_steps(horizon, [entry.name])
        self.steps, self.success, self.succeeded = 0, False, False
        self.stress: Stress = NO_STRESS
        self._observation: Observation | None = None

    @classmethod  # noqa: B027 - most simulators come with kerv
    def check_installed(cls) -> None:
        """Raise UsageError if a package of the simulator is missing or has a version that does not work."""

    @abstractmethod
    def _start(self, seed: int) -> NDArray[np.float64]:
        """Put the simulator into the initial state for a seed. Return the privileged state (s,)."""

    @abstractmethod
    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        """Execute an action (D,) within the limits.

        Return the privileged state (s,) after the step, and the success flag.
        """

    @abstractmethod
    def _draw(self, camera: CameraSettings) -> NDArray[np.uint8]:
        """Return the image (size, size, 3) of one camera as uint8 RGB, upright."""

    def _readings(self) -> Mapping[str, NDArray[np.float64]]:
        """Return the robot's own measurements by name, for `Observation.readings`."""
        return {}

    @property
    @abstractmethod
    def initial_state(self) -> NDArray[np.float64]:
        """Numbers (n,) that, with the task, determine the episode's start, such as the object's position."""

    @property
    def observation(self) -> Observation:
        """Latest observation, without images. Raises KervError before the first reset."""
        if self._observation is None:
            raise KervError(f"{self.task}: reset the world before using it")
        return self._observation

    @property
    def done(self) -> bool:
        """Whether the episode has succeeded at any step, or has reached the horizon."""
        self.observation  # noqa: B018 - raises before the first reset
        return self.succeeded or self.steps >= self.horizon

    @property
    def end_effector(self) -> NDArray[np.float64]:
        """Position (3,) of the end effector in metres: the first three numbers of the proprioception."""
        return self.observation.proprioception[:3].copy()

    @property
    def grip_point(self) -> NDArray[np.float64]:
        """Position (3,) where the hand grips, in metres. The default is `end_effector`."""
        return self.end_effector

    @property
    def object_position(self) -> NDArray[np.float64]:
        """Position (3,) of the object, in metres. NaN if the state does not contain the object's position."""
        for place in self.spec.observation.places:
            if place.name == "object":
                return self.observation.state[place.first : place.first + 3].copy()
        return np.full(3, math.nan)

    @property
    def gripper(self) -> float:
        """Opening of the gripper, from 0 (closed) to 1 (open). 1 if there is no gripper."""
        names, values = self.spec.observation.proprioception, self.observation.proprioception
        return float(values[names.index("gripper")]) if "gripper" in names else 1.0

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`, which is at least 0, and return the first observation.

        A stress draws a new disturbance.
        """
        if seed < 0:
            raise UsageError(f"episode seed must be 0 or more, not {seed}")
        self.stress.begin(self.task, seed, self.spec.actions)
        state = self._start(seed)
        self.steps, self.success, self.succeeded = 0, False, False
        return self._observe_state(state)

    def step(self, action: ArrayLike) -> Observation:
        """Execute one control step and return the observation after it.

        Args:
            action: (D,) in environment units. It is clipped to the limits. Then a stress may change it.

        Raises:
            KervError: The episode has not begun or has reached its horizon, or the action is not D finite numbers.
        """
        executed = np.asarray(action, dtype=np.float64)
        space = self.spec.actions
        if executed.shape != (space.dofs,) or not np.isfinite(executed).all():
            raise KervError(f"{self.task}: an action is {space.dofs} finite numbers, not {action!r}")
        self.observation  # noqa: B018 - raises before the first reset
        if self.steps >= self.horizon:
            raise KervError(f"{self.task}: the episode ended at step {self.steps}, the horizon: reset the world")
        executed = self.stress.act(np.clip(executed, space.low, space.high), self.steps)
        state, self.success = self._advance(executed)
        self.succeeded = self.succeeded or self.success
        self.steps += 1
        return self._observe_state(state)

    def _observe_state(self, state: NDArray[np.float64]) -> Observation:
        proprioception = state[: len(self.spec.observation.proprioception)]
        self._observation = Observation(proprioception, state, self.instruction, readings=self._readings())
        return self._observation

    def frame(self, camera: CameraSettings | None = None) -> NDArray[np.uint8]:
        """Return the current image (size, size x views, 3) as uint8 RGB, for a recording.

        The image is sharp and current even if a stress disturbs the images that the policy sees.

        Args:
            camera: The view to draw. If None, the world's own view.

        Raises:
            RenderingUnavailable: This machine cannot draw.
        """
        self.observation  # noqa: B018 - raises before the first reset
        return self._picture(self.camera if camera is None else self.spec.camera(camera), stressed=False)

    def observe(self, cameras: Sequence[str]) -> Observation:
        """Return the latest observation with new images of these views. No other view is drawn."""
        seen = self.observation
        own = {name: self.spec.camera(replace(self.camera, name=name)) for name in cameras}
        return seen.with_images({name: self._picture(camera, stressed=True) for name, camera in own.items()})

    def _picture(self, camera: CameraSettings, stressed: bool) -> NDArray[np.uint8]:
        parts = []
        for view in views_of(camera.name):
            image = self._draw(replace(camera, name=view.camera, fovy=view.fovy or camera.fovy))
            parts.append(self.stress.see(view.name, image, self.steps) if stressed else image)
        return np.concatenate(parts, axis=1)

    def close(self) -> None:
        """End the episode. A subclass also frees its simulator, which a later reset builds again."""
        self._observation = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
