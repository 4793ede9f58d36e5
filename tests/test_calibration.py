"""Calibration: windows, fits and errors on data made to order; K by hand; the file and its refusals; the command."""

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import kerv

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import read_json, sha256_of, write_json
from kerv_cli.engine.chunk import ActionHistory, Chunk, Situation
from kerv_cli.engine.record import Round
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.calibration import (
    BoundarySection,
    Calibration,
    CalibrationArtifact,
    Demonstrations,
    SkipLevel,
    SkipSection,
    Variability,
)
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.methods.kerv.prediction import PREDICTORS, Noise
from kerv_cli.targets.checkpoint import TargetDescription, read_target
from kerv_cli.targets.folders import find_target
from kerv_cli.training.calibration import (
    CalibrationRun,
    Windows,
    choose_episodes,
    distribution,
    episode_windows,
    fit_noise,
    moving_errors,
    prediction_errors,
)
from kerv_cli.training.settings import CalibrateSettings
from kerv_cli.worlds.demos.dataset import FORMAT, DemoDataset, dataset_hash, episode_path
from kerv_cli.worlds.demos.files import DemoEpisode, save_episode
from kerv_cli.worlds.metaworld.spec import SPEC

TASKS = ("reach-v3", "drawer-close-v3")
SPACE = SPEC.actions
BIN = 2 / SPACE.tokens
STEPS = 24


def made_up_episode(task: str, seed: int, tail: int = 8) -> DemoEpisode:
    """Ramps of another slope per DoF, saturating now and then; a gripper that closes half way."""
    time = np.arange(STEPS + tail)
    slopes = 0.05 * (1 + seed % 3) * np.array([1.0, -0.5, 0.25])
    labels = np.clip(np.c_[-0.5 + time[:, None] * slopes, np.where(time < STEPS // 2, -1.0, 1.0)], -1, 1)
    perturbed = seed % 2 == 1
    executed = labels[:STEPS].copy()
    if perturbed:
        executed[:, :3] += np.random.default_rng(seed).normal(0, 0.3, (STEPS, 3))
    return DemoEpisode(
        task=task,
        seed=seed,
        perturbed=perturbed,
        steps=STEPS,
        frames=np.random.default_rng(seed).integers(0, 255, (STEPS // 2, 96, 96, 3), dtype=np.uint8),
        frame_steps=np.arange(0, STEPS, 2),
        states=np.random.default_rng(seed).normal(0, 0.1, (STEPS, 39)).astype(np.float32),
        labels=labels.astype(np.float32),
        executed=np.clip(executed, -1, 1).astype(np.float32),
        initial_state=np.zeros(3),
    )


def write_dataset(
    folder: Path,
    episodes: int = 6,
    make: Callable[[str, int], DemoEpisode] = made_up_episode,
    names: Sequence[str] = TASKS,
    seeds: Iterable[int] = (),
) -> None:
    """Writes a complete dataset, as `kerv demos` leaves it."""
    tasks: dict[str, Any] = {task: {"episodes": []} for task in names}
    for task, seed in product(names, seeds or range(episodes)):
        path, episode = episode_path(folder, task, seed), make(task, seed)
        save_episode(path, episode)
        entry = {"seed": seed, "perturbed": episode.perturbed, "steps": episode.steps}
        tasks[task]["episodes"].append({**entry, "bytes": path.stat().st_size, "sha256": sha256_of(path)})
    spaces = {"actions": SPACE.as_dict(), "observation": SPEC.observation.as_dict()}
    described = {"format": FORMAT, "environment": SPEC.name, **spaces, "config": {"camera": {"name": SPEC.cameras[0]}}}
    write_json(folder / "manifest.json", {**described, "sha256": dataset_hash(tasks), "tasks": tasks})


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """The small policies and a dataset of two tasks."""
    folder = tmp_path_factory.mktemp("calibration") / "results"
    shutil.copytree(policies, folder)
    write_dataset(folder / "artifacts/demos/few")
    return folder


def quiet(title: str) -> AbstractContextManager[Callable[[int, int], object]]:
    """A stage of a calibration that shows nothing."""
    return nullcontext(lambda done, total: None)


def settings(results: Path, *overrides: str, target: str = "nano-state") -> CalibrateSettings:
    words = ["task=reach,drawer-close", "demos=few", "held_out=0.4", "decodes=4", f"policy.target={target}"]
    given = {override.split("=")[0] for override in overrides}
    words = [word for word in words if word.split("=")[0] not in given]
    return compose("calibrate", [*words, f"results={results}", *overrides], CalibrateSettings)


def test_windows_hold_the_normalised_labels_before_and_after_each_moment():
    episode = made_up_episode("reach-v3", 0)
    past, future = episode_windows(episode, SPACE, 10, 4)
    assert past.shape == (STEPS - 10, 10, 4)
    assert future.shape == (STEPS - 10, 4, 4)
    for i in (0, 7, STEPS - 11):
        np.testing.assert_allclose(past[i], episode.labels[i : i + 10], atol=1e-6)
        np.testing.assert_allclose(future[i], episode.labels[i + 10 : i + 14], atol=1e-6)
    narrow = dataclasses.replace(SPACE, low=(-0.5,) * 4, high=(0.5,) * 4)
    past, _ = episode_windows(episode, narrow, 10, 4)
    np.testing.assert_allclose(past[0], np.clip(2 * episode.labels[:10], -1, 1), atol=1e-6)
    past, future = episode_windows(episode, SPACE, STEPS, 4)
    assert past.shape == (0, STEPS, 4)
    assert future.shape == (0, 4, 4)
    with pytest.raises(CheckpointError, match="8 labels"):
        episode_windows(episode, SPACE, 10, 10)


@pytest.mark.parametrize("ratio", [0.01, 1.0])
def test_the_fit_finds_the_noise_that_made_the_data(ratio):
    """A random walk of the velocity, observed with noise: the true ratio predicts best."""
    random = np.random.default_rng(0)
    acceleration = random.normal(0, np.sqrt(ratio), (4000, 12))
    speed = np.cumsum(acceleration, 1)
    place = np.cumsum(np.c_[np.zeros(len(speed)), speed[:, :-1] + 0.5 * acceleration[:, 1:]], 1)
    seen = 1e-3 * (place + random.normal(0, 1, place.shape))  # small: nothing is clipped, and only the ratio counts
    q, damping = fit_noise(seen[:, :10], seen[:, 10:], (1.0,))
    assert damping == 1.0
    assert ratio / 4 < q < 4 * ratio


def line_windows(slope: float) -> Windows:
    """One task of lines and one of constants; the gripper ramps in both."""
    time = np.arange(14)
    lines = np.stack([np.full((14, 4), 0.3), np.c_[np.repeat(slope * time[:, None], 3, 1), 0.01 * time]])
    both = np.concatenate([lines, lines])
    held = np.array([False, False, True, True])
    return Windows(both[:, :10], both[:, 10:], np.array([0, 1, 0, 1]), held, TASKS, {}, [])


def test_errors_of_hold_and_linear_have_closed_forms():
    noise = {kind: Noise(*3 * [(1.0,) * 4]) for kind in PREDICTORS}
    errors = prediction_errors(line_windows(0.02), noise, SPACE)
    assert set(errors) == set(PREDICTORS)
    np.testing.assert_allclose(moving_errors(errors, "hold", SPACE), [[0] * 4, 0.02 * np.arange(1, 5)], atol=1e-12)
    np.testing.assert_allclose(moving_errors(errors, "linear", SPACE), np.zeros((2, 4)), atol=1e-12)
    for kind in PREDICTORS:  # the gripper is held by all of them
        np.testing.assert_allclose(errors[kind][TASKS[1]]["gripper"], 0.01 * np.arange(1, 5), atol=1e-12)


def test_both_kinds_of_episodes_are_held_out(results):
    dataset = DemoDataset.open(results / "artifacts/demos/few")
    chosen = choose_episodes(dataset, TASKS, 0, 0.3)
    assert len(chosen) == 12
    held = [dataset.episodes[i] for i, out in chosen.items() if out]
    assert {(e.task, e.perturbed) for e in held} == {(t, p) for t in TASKS for p in (False, True)}
    assert len(choose_episodes(dataset, TASKS[:1], 4, 0.3)) == 4
    with pytest.raises(CheckpointError, match="no episode of push-v3"):
        choose_episodes(dataset, ("push-v3",), 0, 0.3)


def test_variability_is_the_mean_difference_of_the_judged_tokens():
    """K by hand, in normalised action units; what is not judged does not count, nor does a strict DoF."""
    chunk = Chunk(torch.zeros(1, 1, 8), 4, SPACE, None, Situation("t", ActionHistory(4)))  # type: ignore[arg-type]

    def play(start, drafted, target_tokens):
        played = Round("verify", "x", start, drafted, target_tokens, 0, 1, len(drafted), ())
        chunk.commit(played, [0])
        return None if chunk.variability is None else chunk.variability / BIN

    assert play(0, (), (100,)) is None
    assert play(3, (254,), (0,)) is None  # the gripper alone: nothing that moves was judged
    assert play(0, (10, 20, 30), (10, 22, 27, 99)) == pytest.approx(5 / 3)  # the bonus was not drafted
    assert play(1, (0, 0, 254, 7), (0, 4, 0, 0)) == pytest.approx((5 + 0 + 4 + 7) / 6)


def test_the_reference_level_is_the_median_and_can_divide():
    assert distribution([0.1, 5.0, 0.3], BIN).k_s == 0.3
    assert distribution([0.0, 0.0], BIN).k_s == BIN == pytest.approx(SPACE.centres[1] - SPACE.centres[0])


@pytest.mark.parametrize("target", ["nano-state", "nano-vision"])
def test_a_run_writes_what_the_next_session_reads(results, target):
    run = CalibrationRun(settings(results, target=target))
    assert "8 demonstrations of 2 tasks, tested on 4; 4 decodes per task with drafter drafts" in run.plan()
    made = run.run(quiet)
    assert {row.decodes for row in made.variability.values()} == {4}
    folder = find_target(str(results), target)
    assert run.path == results / f"artifacts/calibration/{target}/calibration.json"
    loaded = CalibrationArtifact().checked(run.path, read_target(folder))
    assert loaded == made
    assert loaded.demos.sha256 == run.dataset.sha256
    assert loaded.boundary.episodes == 8
    assert loaded.skip is None
    assert "kept" not in loaded.provenance
    assert [line.split(":")[0] for line in run.notes] == ["skip levels"]
    for kind, predictor_class in PREDICTORS.items():
        predictor = predictor_class(SPACE.is_strict, loaded.noise.get(kind), window=loaded.window)
        np.testing.assert_allclose(predictor.predict(np.full((10, 4), 0.25), 4), 0.25)


def calibration(levels: dict[str, float]) -> Calibration:
    return Calibration(
        target=MadeFor("a" * 64, SPACE, 4),
        demos=Demonstrations("b" * 64, {}),
        window=10,
        noise={kind: Noise(*3 * [(1.0,) * 4]) for kind in ("kalman", "damped")},
        errors={},
        variability={task: Variability(level, 5, level, level, level) for task, level in levels.items()},
        boundary=BoundarySection(8, {"15": BoundaryRanges(0.01, 2.0, 0.0, 0.2)}),
        skip=SkipSection("d" * 64, 0.1, 0.9, {task: SkipLevel(0.9, 0.8, 0.99, 0.5, 40, 0.9, 0.1) for task in levels}),
    )


def description(**changes: Any) -> TargetDescription:
    settings = {"chunk": changes.pop("chunk", 4)}
    whole = {"sha256": "a" * 64, "family": "compact", "environment": SPEC.name, "settings": settings}
    spaces = {"actions": SPACE, "observation": SPEC.observation, "cameras": (), "words": (), "provenance": {}}
    return TargetDescription(1, "target", **{**whole, **spaces, **changes})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda v: v.pop("noise"), "damaged: noise: field required"),
        (lambda v: v["variability"]["reach-v3"].pop("k_s"), "damaged: variability.reach-v3.k_s"),
        (lambda v: v["boundary"]["windows"]["15"].update(radius_high=0.001), "is no range"),
        (lambda v: v["skip"]["tasks"]["reach-v3"].update(s_min=float("nan")), "damaged: skip.tasks.reach-v3.s_min"),
        (lambda v: v.update(format=1), "damaged: format"),
        (lambda v: v["target"].update(sha256="c" * 64), "was made for target cccccccccccc, not for aaaaaaaaaaaa"),
        (lambda v: v["target"].update(chunk=8), "was made for chunks of 8 steps, not of 4"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(change, says, tmp_path):
    path = tmp_path / "calibration.json"
    write_json(path, dataclasses.asdict(calibration({"reach-v3": 0.7})))
    assert CalibrationArtifact().checked(path, description()) == calibration({"reach-v3": 0.7})
    value = copy.deepcopy(read_json(path))
    change(value)
    path.write_text(json.dumps(value))
    with pytest.raises(CheckpointError, match=says) as caught:
        CalibrationArtifact().checked(path, description())
    assert "\n" not in str(caught.value)
    assert "kerv calibrate" in str(caught.value)


@pytest.mark.parametrize(
    ("override", "kind", "says"),
    [
        ("window=3", UsageError, "window=3"),
        (f"window={STEPS}", KervError, f"longer than a window of {STEPS}"),
        ("proposer=none", UsageError, "drafts nothing to compare"),
        ("task=push", CheckpointError, "no episode of push-v3"),
        ("demos=absent", CheckpointError, "kerv demos"),
        ("policy.target=absent", UsageError, "no target 'absent'"),
    ],
)
def test_wrong_requests_get_one_line(results, override, kind, says):
    with pytest.raises(kind, match=says) as caught:
        CalibrationRun(settings(results, override)).run(quiet)
    assert "\n" not in str(caught.value)


def test_the_command_prints_what_it_found(results):
    words = ["calibrate", "task=reach,drawer-close", "demos=few", "held_out=0.4", "policy.target=nano-state"]
    done = kerv(*words, f"results={results}", "decodes=0", "name=without")
    for said in ("K_S", "held-out error", "damped", "h=4", "decodes=0; left empty\n", "skip levels: no datastore"):
        assert said in done.output
    assert "s_min" not in done.output
    assert (results / "artifacts/calibration/without/calibration.json").is_file()


def test_a_task_without_a_reference_level_is_named():
    with pytest.raises(CheckpointError, match="no reference level K_S for push-v3, only for reach-v3"):
        calibration({"reach-v3": 0.7}).k_s("push-v3")
