"""Builds the policy of a rollout: checks that its parts and files fit together, and returns its decoder."""

from __future__ import annotations

import time
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.paths import results_dir
from kerv_cli.base.registry import DRAFTING
from kerv_cli.base.runtime import device_of, set_up
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.base.wire import packed
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.record import PHASES, DecodeRecord
from kerv_cli.episodes.cost import Profile, prices, read_profile, work_of_record
from kerv_cli.episodes.episode import Latency, RealClock
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.episodes.interface import STATE, read_interface
from kerv_cli.episodes.remote import RemoteDecoder, metadata_of
from kerv_cli.episodes.settings import MEASURED, PROFILE, REAL, WAITS, RolloutSettings
from kerv_cli.methods.artifacts import Artifacts, Use
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import EXPERT, MODEL, REMOTE
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.views import frame_shape

if TYPE_CHECKING:
    from kerv_cli.engine.decoder import Decoder

PRIVILEGED = "state (privileged)"
WARM_UP_DECODES = 6


def artifacts_of(settings: Any) -> Artifacts:
    """Return the artifacts of a command's `results` and `policy`, for its `runtime`, which is set up."""
    set_up(settings.runtime)
    return _described(settings)


def _described(settings: Any) -> Artifacts:
    # to read descriptions alone, which needs no torch
    return Artifacts(settings.results, settings.policy, device_of(settings.runtime), settings.runtime.dtype)


def check(settings: RolloutSettings, is_awaited: bool = False) -> dict[str, str]:
    """Refuse settings that cannot run, before anything slow starts. Return the setting's identity.

    The identity has hashes of weights and data, by kind, and under `observation` what the policy observes. With
    `is_awaited`, a server that does not answer is tried for two minutes.
    """
    tasks = resolve_tasks(settings.task)
    spec = spec_of(tasks[0])
    purpose = "selection" if settings.seed in spec.seeds.selection else "evaluation"
    seeds = range(settings.seed, settings.seed + settings.episodes)
    spec.seeds.check(seeds, purpose, f"seed={settings.seed} episodes={settings.episodes}")
    spec.check_stress(settings.world.stress)
    if settings.policy.kind != MODEL:
        _check_undecoded(settings)
        clock_for(settings, spec)
    if settings.policy.kind == REMOTE:
        return _check_remote(settings, spec, is_awaited)
    if settings.policy.kind == EXPERT:
        spec.check_experts(tasks)
        experts = ";".join(f"{task} {expert}" for task, expert in sorted(spec.experts.items()))
        return {"target": "", **({"expert": experts} if experts else {}), OBSERVATION: PRIVILEGED}
    artifacts = _described(settings)
    target = artifacts.description
    target.check_world(settings.policy.target, spec.name, spec.actions, settings.world.camera.size)
    camera = settings.world.camera.name
    if target.cameras and camera not in ("", spec.cameras[0], *target.cameras):
        sees = ", ".join(target.cameras)
        raise UsageError(f"world.camera.name={camera}: {settings.policy.target} sees {sees}, leave it out")
    method = Method.of(settings)
    if settings.deviation_every > 0:
        target.check_autoregressive(f"deviation_every={settings.deviation_every}", "there is no AR to differ from")
    method.check(target)
    clock_for(settings, spec)
    is_profiled = settings.rollout.clock == REAL and settings.rollout.latency == PROFILE
    profile = {"profile": sha256_of(_profile_path(settings))} if is_profiled else {}
    hashes = artifacts.check(method.needs, Use(method.settings, tasks))
    # stored with every episode, so that tables show which policies read the privileged state
    observation = str(target.settings.get(OBSERVATION, "vision"))
    observation = PRIVILEGED if observation == "state" else observation
    return {**hashes, **profile, OBSERVATION: observation}


def _check_remote(settings: RolloutSettings, spec: EnvironmentSpec, is_awaited: bool) -> dict[str, str]:
    metadata = metadata_of(settings.policy.url, is_awaited)
    interface = read_interface(settings.policy.interface).adapted(metadata, settings.policy.execute)
    interface.check(spec, settings.world)
    server = sha256(packed({"name": settings.policy.target, "metadata": metadata}))
    reads = sha256(repr(interface).encode())
    observation = PRIVILEGED if any(STATE in names for names in interface.state.values()) else "vision"
    return {"target": "", "server": server.hexdigest(), "interface": reads.hexdigest(), OBSERVATION: observation}


def _check_undecoded(settings: RolloutSettings) -> None:
    plain, default = (
        {"deviation_every": each.deviation_every, "chunk": each.chunk} | each.parts()
        for each in (settings, RolloutSettings())
    )
    for key, value in plain.items():
        if value != default[key]:
            word, kind = f"{key}={getattr(value, 'kind', value)}", settings.policy.kind
            why = "the expert decodes nothing" if kind == EXPERT else "the server decides it"
            raise UsageError(f"policy={kind} with {word}: {why}, leave it out")


def decoder_for(settings: RolloutSettings, task: str) -> Follower:
    """Return the decoder for one setting (a method with all its options) on one task, warmed up."""
    spec = spec_of(task)
    if settings.policy.kind == REMOTE:
        return RemoteDecoder(settings.policy, read_interface(settings.policy.interface), spec)
    expert = settings.policy.kind == EXPERT
    decoder: Follower = ExpertDecoder(task) if expert else method_decoder(settings, task)
    warm_up(decoder, task, spec.observation, settings.world.camera.size)
    return decoder


def method_decoder(settings: RolloutSettings, task: str = "") -> Decoder:
    """Return the decoder of a setting's method, not warmed up. Without `task`, the method must work on any task."""
    artifacts = artifacts_of(settings)
    decoder = Method.of(settings).decoder(artifacts.target, artifacts.load, task)
    decoder.deviation_every = settings.deviation_every
    return decoder


def clock_for(settings: RolloutSettings, spec: EnvironmentSpec) -> RealClock | None:
    """Return the clock of a world that goes on while the policy decodes. None if the world waits.

    `rollout.latency` chooses the source of a decode's latency: a constant, the measured time, or a profile. A profile
    is a file of `kerv bench` with the seconds that each phase of a decode (encode, prefill, …) takes on some machine.
    """
    timing = settings.rollout
    if timing.clock == WAITS:
        return None
    target = _described(settings).description if settings.policy.kind == MODEL else None
    latency: Latency | float = timing.latency_ms / 1000.0
    if timing.latency == MEASURED:
        latency = attrgetter("seconds")
    elif timing.latency == PROFILE:
        latency = _profile_latency(settings, target)
    horizon = spec.control_steps(settings.world.horizon, resolve_tasks(settings.task))
    chunk = 1 if target is None else settings.chunk or target.chunk
    return RealClock(latency, spec.actions, timing.delay_compensation, horizon, chunk)


def _profile_latency(settings: RolloutSettings, target: TargetDescription | None) -> Latency:
    if target is None:
        raise UsageError(
            f"policy={settings.policy.kind} with rollout.latency=profile: it has no forwards; use "
            "rollout.latency=constant or measured"
        )
    path, name = _profile_path(settings), settings.rollout.profile
    try:
        profile = read_profile(path)
    except CheckpointError as error:
        raise UsageError(f"rollout.profile={name}: {error}") from error
    method = Method.of(settings)
    costs = method.parts["prefill_draft"].cost, method.parts["proposer"].cost
    drafter = (DRAFTING, "feed") if DRAFTING in costs else ()
    if lacks := profile.lacks(("encode", "prefill", "verify", *drafter)):
        raise UsageError(f"rollout.profile={name}: {path} has no phase '{lacks[0]}', which this method needs")
    return profiled(profile)


def profiled(profile: Profile) -> Latency:
    return lambda decode: float(prices(work_of_record(decode), profile)[0])


def _profile_path(settings: RolloutSettings) -> Path:
    name, results = settings.rollout.profile, settings.results
    for path in (Path(name).expanduser(), results_dir(results) / "bench" / f"{name}.json"):
        if path.is_file():
            return path
    raise UsageError(f"rollout.profile={name}: no such document, nor in {results}/bench: 'kerv bench' writes one")


def still_observation(decoder: Follower, space: ObservationSpace, pixels: int) -> Observation:
    images = {name: np.zeros(frame_shape(name, pixels), dtype=np.uint8) for name in decoder.cameras}
    return Observation(np.zeros(len(space.proprioception)), np.zeros(space.state), "", images)


def warm_up(decoder: Follower, task: str, space: ObservationSpace, pixels: int, decodes: int = WARM_UP_DECODES) -> None:
    """Run a few decodes before anything is timed, because the first decodes allocate memory and choose kernels.

    The simulated hand moves, so that parts that need past actions or positions run, too.
    """
    still = still_observation(decoder, space, pixels)
    decoder.reset(task, 0, np.array([0.0, 0.0, 0.1]))
    for i in range(decodes):
        for action in decoder.decode(still).actions:
            decoder.observe(action, np.array([0.01 * i, 0.0, 0.1]))


class ExpertDecoder(Follower):
    """Returns one action at a time from the environment's scripted controller of a task.

    The controller reads the privileged simulator state, as policies with `observation=state` do. A record has no
    forwards, rounds or tokens, and its time says nothing about decoding.
    """

    def __init__(self, task: str) -> None:
        spec = spec_of(task)
        super().__init__(spec.actions, ())
        self.expert = spec.expert(task)

    def decode(self, observation: Observation) -> DecodeRecord:
        """Return a record with the action of one control step, (1, D), environment units."""
        began = time.perf_counter()
        action = self.expert(observation)
        seconds = time.perf_counter() - began
        actions = action[None].astype(np.float32)
        return DecodeRecord((), actions, 0, (), EXPERT, seconds, {**dict.fromkeys(PHASES, 0.0), "other": seconds})
