"""The demonstrations of a command: open and check them, or choose who acts while `kerv demos` records them.

The scripted expert or a policy acts. If a policy acts, with any method, the expert labels the states that it visits
(DAgger; Ross, Gordon, Bagnell 2011).
"""

from __future__ import annotations

import functools
import shlex
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.durations import count
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import visible
from kerv_cli.base.paths import artifact, artifact_or_path
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.identity import hash_of
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.episodes.settings import DEFAULT_TASKS
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import EXPERT, PolicySettings
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.training.settings import DemonstrationSettings, DemosSettings, Plan, Stage
from kerv_cli.worlds import resolve_tasks, spec_of, specs, stands_for_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset, DemoManifest
from kerv_cli.worlds.demos.recording import DemoConfig, check_recording, record
from kerv_cli.worlds.spec import EnvironmentSpec, World
from kerv_cli.worlds.views import views_of

S = TypeVar("S", bound=DemonstrationSettings)


def name_of(tasks: Sequence[str]) -> str:
    return "-".join(tasks or DEFAULT_TASKS).lower()


def open_demos(database: Database, names: str, tasks: Sequence[str] = (), episodes: int = 0) -> DemoDataset:
    """Open a dataset, or join several datasets, such as `mt50+mt50-dagger`."""
    results, parts = str(database.results), names.split("+")
    if artifact_or_path(results, "demos", names).is_dir():  # its name may contain a plus
        parts = [names]
    opened = []
    for name in parts:
        folder = artifact_or_path(results, "demos", name)
        try:
            opened.append(DemoDataset.open(folder))
        except CheckpointError as error:
            if (folder / "manifest.json").exists():
                raise
            if command := command_to_go_on(database, "demos", folder):
                line = shlex.join(["kerv", *command])
                raise CheckpointError(f"the demonstrations in {folder} are unfinished: run '{line}'") from error
            remedy = _remedy(database.results / "artifacts/demos", folder, tasks, episodes)
            raise CheckpointError(f"no complete demonstrations in {folder}: {remedy}") from error
    return DemoDataset.joined(opened)


def _remedy(parent: Path, folder: Path, tasks: Sequence[str], episodes: int) -> str:
    if folder.parent != parent:
        return "name a folder that holds manifest.json"
    tasks = [folder.name] if stands_for_tasks(folder.name) else tasks
    command = ["kerv demos"]
    if folder.name != name_of(tasks):
        command.append(f"name={folder.name}")
    if tasks:
        command.append(f"task={tasks[0]}" if len(tasks) == 1 else f"task=[{','.join(tasks)}]")
    if episodes:
        command.append(f"episodes={episodes}")
    stored = sorted(path.parent.name for path in parent.glob("*/manifest.json"))
    others = f", or name others: demos={' or demos='.join(stored)}" if stored else ""
    return f"record them with '{' '.join(command)}'{others}"


def demos_for(settings: S, target: TargetDescription, database: Database) -> tuple[S, DemoDataset]:
    """Open the demonstrations named in the settings, or by default those that the target was trained on.

    The returned settings name the demonstrations. Tasks that the target was not trained on are left out, unless `task`
    names tasks.
    """
    name, tasks = settings.demos or target.demos or name_of(()), settings.task
    if settings.demos:
        dataset = open_demos(database, name, tasks or target.tasks)
    else:  # if the dataset is missing, the error message says how to record all tasks of the target
        config = target.provenance.get("demos", {}).get("config", {})
        dataset = open_demos(database, name, target.tasks, config.get("episodes", 0))
    check_spaces(dataset, target.actions, target.observation, "the target")
    if target.family == "compact" and target.cameras:
        camera = specs()[dataset.manifest.environment].camera_name(target.cameras[0])
        dataset = seen_by(dataset, camera, "the target sees", f"record them with world.camera.name={camera}")
    if dataset.manifest.environment == target.environment:
        check_tasks(dataset, resolve_tasks(tasks) if tasks else ())
    if target.tasks and not tasks:
        recorded, trained = dataset.manifest.tasks, resolve_tasks(target.tasks)
        if set(recorded) - set(trained):
            tasks = [task for task in recorded if task in trained]
    return replace(settings, demos=name, task=tasks), dataset


def check_tasks(dataset: DemoDataset, names: Sequence[str]) -> None:
    for task in names:
        if not dataset.of_tasks(task):
            recorded = ", ".join(dataset.manifest.tasks)
            raise CheckpointError(
                f"the demonstrations in {dataset.path} hold no episode of {task}: leave task= out for those of "
                f"{recorded}, or record others with 'kerv demos task={task}' and name them by demos="
            )


def check_spaces(dataset: DemoDataset, actions: ActionSpace, observation: ObservationSpace, owner: str) -> None:
    """Refuse demonstrations with another action space or observation space than expected.

    Demonstrations without object positions need only the same proprioception.
    """
    where = f"the demonstrations in {dataset.path}"
    dataset.manifest.actions.check_same(actions, where, owner)
    recorded = dataset.manifest.observation
    same = recorded == observation or (not recorded.places and recorded.proprioception == observation.proprioception)
    if observation.state and not same:  # a target without a state reads only images
        raise CheckpointError(f"{where} have other observations than {owner}: they are of another environment")


def seen_by(dataset: DemoDataset, camera: str, who: str, remedy: str) -> DemoDataset:
    """Return the dataset with only the views of `camera`, which must be the leftmost views in each image."""
    recorded = dataset.manifest.config["camera"]["name"]
    if recorded == camera:
        return dataset
    if recorded.startswith(f"{camera}+"):
        return replace(dataset, views=len(views_of(camera)))
    raise CheckpointError(f"the demonstrations in {dataset.path} show camera {recorded}, {who} {camera}: {remedy}")


# --- who acts while demonstrations are recorded


class PolicyActor:
    """Chooses the actions that a recording executes: for each chunk, either the policy's or the expert's.

    Task and seed determine the choice. The decoder is never told whether an episode succeeded, so no episode depends on
    earlier ones.
    """

    def __init__(self, decoder_of: Callable[[str], Decoder], expert_share: float) -> None:
        self.decoder_of, self.share = functools.cache(decoder_of), expert_share

    def reset(self, world: World, seed: int) -> None:
        self.world = world
        self.random = np.random.default_rng([seed, *world.task.encode()])
        # actions of the current chunk that are not executed yet; None: the expert acts
        self.actions: deque[NDArray[np.float64] | None] = deque()
        self.executed: NDArray[np.float32] | None = None
        self.decoder = self.decoder_of(world.task)
        self.decoder.reset(world.task, seed, world.end_effector)

    def act(self, label: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (D,) to execute now. `label` (D,) is the expert's action in this state."""
        if self.executed is not None:
            self.decoder.observe(self.executed, self.world.end_effector)
        if not self.actions and self.random.random() < self.share:
            self.actions.extend([None] * self.decoder.steps)
        elif not self.actions:
            self.actions.extend(self.decoder.decode(self.world.observe(self.decoder.cameras)).actions)
        chosen = self.actions.popleft()
        action = label if chosen is None else chosen
        self.executed = np.asarray(action, dtype=np.float32)
        return np.asarray(action, dtype=np.float64)


@dataclass(frozen=True)
class PolicyActs:
    """Is sent to the process that records, and makes a `PolicyActor` there. It holds no weights itself.

    Attributes:
        sha256: Hash of the method and all its weights.
    """

    settings: DemosSettings
    sha256: str

    @classmethod
    def of(cls, settings: DemosSettings, spec: EnvironmentSpec) -> PolicyActs:
        """Check that the policy can act in an environment. Recordings may have more views than the target sees."""
        name, world = settings.policy.target, settings.world
        description = artifacts_of(settings).description
        description.check_world(name, spec.name, spec.actions, world.camera.size)
        views = [spec.camera_name(view) for view in description.cameras]
        camera = spec.camera_name(world.camera.name)
        if views and not f"{camera}+".startswith(f"{views[0]}+"):
            raise UsageError(
                f"policy.target={name} sees {views[0]}, the recording would show {camera}: set "
                f"world.camera.name={views[0]}, or add further views after it"
            )
        Method.of(settings).check(description)
        return cls(settings, _hash(settings))

    def __call__(self, config: DemoConfig) -> PolicyActor:
        if _hash(self.settings) != self.sha256:
            raise CheckpointError(
                f"the policy {self.settings.policy.target} has changed since the recording began: record under another "
                "name="
            )
        artifacts, method = artifacts_of(self.settings), Method.of(self.settings)
        return PolicyActor(lambda task: method.decoder(artifacts.target, artifacts.load, task), config.expert_share)


def _hash(settings: DemosSettings) -> str:
    hashes = artifacts_of(settings).check(Method.of(settings).needs)
    format = [] if settings.runtime.dtype == "float32" else [settings.runtime.dtype]
    return hash_of([hashes, {kind: asdict(part) for kind, part in settings.parts().items()}, settings.chunk, *format])


RATES = {"metaworld": 0.42, "libero": 7.2}
"""Seconds that one core takes for a demonstration, by environment (conf/quick.yaml, docs/libero.md)."""


def plan_demos(settings: DemosSettings) -> Plan[tuple[Path, DemoManifest]]:
    config, actor = recording_of(settings)
    config.spec.check_installed()
    folder = artifact(settings.results, "demos", settings.name or name_of(settings.task))

    def check() -> None:
        if folder.is_dir() and visible(folder) and not (folder / "recording.json").is_file():
            raise UsageError(f"{folder} holds other demonstrations: choose another name=; demos=A+B joins both")
        check_recording(config, folder)

    def work(stage: Stage) -> tuple[Path, DemoManifest]:
        with stage("demonstrations") as advance:
            return folder, record(config, folder, advance, actor)

    text = f"{count(len(config.tasks), 'task')} x {count(settings.episodes, 'episode')} -> {folder}"
    rate, processes = RATES.get(config.spec.name), config.workers
    if rate is None or actor is not None:
        source = "a policy acts" if actor else f"no rate of {config.spec.name} is known"
        return Plan("demos", folder, text, work, check, source=source)
    seconds = rate * len(config.tasks) * settings.episodes / processes
    source = f"{rate:g} s each on one core, {processes} at once"
    return Plan("demos", folder, text, work, check, lambda: seconds, source)


def recording_of(settings: DemosSettings) -> tuple[DemoConfig, PolicyActs | None]:
    """Return the description of a recording, and the policy that acts in it. The policy is None if the expert acts."""
    tasks, target = resolve_tasks(settings.task), settings.policy.target
    actor = None
    if settings.policy.kind != EXPERT:
        actor = PolicyActs.of(settings, spec_of(tasks[0]))
        if settings.quiet:
            raise UsageError(f"quiet={settings.quiet}: a policy acts, and nothing disturbs it; leave it out")
    elif target != PolicySettings().target:
        raise UsageError(f"policy.target={target}: the expert acts, set policy=vision (or state) too")
    config = DemoConfig(
        tasks=tasks,
        episodes=settings.episodes,
        first_seed=settings.seed,
        perturbed=settings.perturbed,
        quiet=settings.quiet,
        camera=settings.world.camera,
        frame_stride=settings.frame_stride,
        tail=settings.tail,
        workers=settings.runtime.workers,
        horizon=settings.world.horizon,
        policy=actor.sha256 if actor else "",
        expert_share=settings.expert_share if actor else 0.0,
    )
    return config, actor
