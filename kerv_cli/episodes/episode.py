"""Runs one episode: a decoder acts in a world (an open environment), which may go on while the decoder works."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.record import DecodeRecord, Delay, EpisodeRecord
from kerv_cli.episodes.settings import CHUNK
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import World

# Distance in metres. Once the fingertips were this close to the object, they count as the cause of its motion.
AT_OBJECT = 0.05


# Function that takes a decode's record and returns the seconds from its observation to its first action.
Latency = Callable[[DecodeRecord], float]


def steps_during(seconds: float, control_hz: float) -> int:
    """Convert a latency to control steps, rounded up. Rounding errors just above a whole number are ignored."""
    if not 0 <= seconds < math.inf:
        raise KervError(f"the latency of a decode is {seconds} seconds, which cannot be")
    return math.ceil(round(seconds * control_hz, 6))


class RealClock:
    """Tells an episode how long each decode takes, and how many of the decoded actions are then too old to execute.

    A constant latency (seconds) is refused if it is as long as an episode (`horizon` control steps), or, with
    compensation, as long as a chunk (`chunk` control steps). `expected` is the number of control steps that the last
    decode took.
    """

    def __init__(
        self, latency: Latency | float, space: ActionSpace, compensation: str = "none", horizon: int = 0, chunk: int = 0
    ) -> None:
        self.space, self.compensation, self.expected = space, compensation, 0
        self.latency: Latency = latency if callable(latency) else lambda decode: latency
        if callable(latency):
            return
        late, typed = steps_during(latency, space.control_hz), f"rollout.latency_ms={1000 * latency:g}"
        if late >= horizon:
            raise UsageError(f"{typed}: {late} control steps, but an episode has {horizon}")
        if compensation == CHUNK and late >= chunk:
            raise UsageError(
                f"{typed} with rollout.delay_compensation=chunk: all {chunk} control steps of a chunk are stale after "
                f"{late}"
            )

    def delay(self, decode: DecodeRecord, observed: int) -> Delay:
        """Return the delay of a decode whose observation was taken at the control step `observed`."""
        seconds = self.latency(decode)
        steps = self.expected = steps_during(seconds, self.space.control_hz)
        stale = min(steps, len(decode.actions) - 1) if self.compensation == CHUNK else 0
        return Delay(seconds, steps, observed, dropped=stale)


def moved_after_approach(distances: Sequence[float], objects: Sequence[np.ndarray]) -> float:
    """Return the object's largest displacement, in metres, since the fingertips first came within AT_OBJECT of it.

    Earlier motion is ignored, because some objects fall into place at the start. 0 if the fingertips never came so
    close, NaN if the task has no object.
    """
    if math.isnan(distances[0]):
        return math.nan
    first = next((step for step, distance in enumerate(distances) if distance < AT_OBJECT), None)
    return 0.0 if first is None else float(np.linalg.norm(np.stack(objects[first:]) - objects[first], axis=1).max())


class _Execution:
    """Executes actions in the world, and collects the data for the episode's record.

    It executes the current chunk, one action per control step. When the chunk is used up, its last action is repeated.
    Before the first chunk the robot stands still.
    """

    def __init__(self, world: World, follower: Follower, camera: CameraSettings | None) -> None:
        self.world, self.follower, self.camera = world, follower, camera
        self.chunk: deque[np.ndarray] = deque()
        self.last = world.spec.standstill(world.gripper)
        self.actions: list[np.ndarray] = []  # (D,) float32, within the limits
        self.path: list[np.ndarray] = []
        self.gripper: list[float] = []
        self.distances: list[float] = []  # between hand and object, after each step, metres; NaN without an object
        self.objects: list[np.ndarray] = []  # (3,) position of the object, after each step
        self.frames: dict[int, np.ndarray] = {}
        self.places: dict[str, list[np.ndarray]] = {}
        self._collect()

    def _collect(self) -> None:
        self.path.append(self.world.end_effector)
        self.gripper.append(self.world.gripper)
        if self.camera:
            self.frames[len(self.actions)] = self.world.frame(self.camera)
            state = np.asarray(self.world.observe(()).state)
            for place in self.world.spec.observation.places:
                self.places.setdefault(place.name, []).append(state[place.first : place.first + 3])

    def step(self) -> None:
        if self.chunk:
            self.last = self.chunk.popleft()
        self.world.step(self.last)
        space = self.world.spec.actions
        self.actions.append(np.clip(self.last, space.low, space.high).astype(np.float32))
        self._collect()
        self.objects.append(self.world.object_position)
        self.distances.append(float(np.linalg.norm(self.world.grip_point - self.objects[-1])))
        self.follower.observe(self.actions[-1], self.path[-1])

    def until(self, rest: int) -> None:
        while len(self.chunk) > rest and not self.world.done:
            self.step()

    def during(self, delay: Delay) -> Delay:
        # carried: steps that executed the rest of the previous chunk; held: steps that repeated the last action
        before, in_chunk, planned = len(self.actions), len(self.chunk), list(self.follower.planned)
        while len(self.actions) < before + delay.steps and not self.world.done:
            self.step()
        self.follower.starts(planned[delay.dropped :], delay.dropped)
        carried = in_chunk - len(self.chunk)
        return dataclasses.replace(delay, carried=carried, held=len(self.actions) - before - carried)


def run_episode(
    world: World,
    decoder: Follower,
    seed: int,
    camera: CameraSettings | None = None,
    clock: RealClock | None = None,
) -> EpisodeRecord:
    """Run one episode until the task is solved or the horizon is reached, and return its record.

    Simulation and rendering do not count as inference time. `camera` is recorded in every control step, None records
    nothing. `clock` gives the latency of each decode if the world goes on during it (docs/methods.md §8).
    """
    began = time.perf_counter()
    world.reset(seed)
    decoder.reset(world.task, seed, world.end_effector)
    execution = _Execution(world, decoder, camera)
    decodes: list[DecodeRecord] = []
    decode_steps: list[int] = []
    if clock is not None:
        clock.expected = 0
    while not world.done:
        decode = decoder.decode(world.observe(decoder.cameras))
        if clock is not None:
            delay = clock.delay(decode, len(execution.actions))
            decode = dataclasses.replace(decode, delay=execution.during(delay))
        decodes.append(decode)
        decode_steps.append(len(execution.actions))
        execution.chunk = deque(decode.actions[decode.delay.dropped if decode.delay else 0 :])
        execution.until(0 if clock is None else clock.expected)
    decoder.finish(world.succeeded)
    return EpisodeRecord(
        environment=world.spec.name,
        space=world.spec.actions,
        task=world.task,
        instruction=world.instruction,
        seed=seed,
        success=world.succeeded,
        steps=len(execution.actions),
        decodes=tuple(decodes),
        decode_steps=tuple(decode_steps),
        actions=np.stack(execution.actions),
        path=np.stack(execution.path).astype(np.float32),
        gripper=np.asarray(execution.gripper, dtype=np.float32),
        initial_state=world.initial_state,
        closest_approach=min(execution.distances),
        object_moved=moved_after_approach(execution.distances, execution.objects),
        frames=execution.frames,
        places={name: np.asarray(path, dtype=np.float32) for name, path in execution.places.items()},
        wall_seconds=time.perf_counter() - began,
    )
