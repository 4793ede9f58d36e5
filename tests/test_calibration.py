"""Calibration: windows, fits, ranges and skip levels by hand; the file and its refusals; the command."""

import copy
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command import told
from conftest import refused
from hypothesis import given
from hypothesis import strategies as st
from loaded import datastore_of
from mock_target import SEVEN

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_json, sha256_of, write_json
from kerv_cli.base.manifests import read_file
from kerv_cli.base.paths import find_target, shipped_dir
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk, Follower
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.record import Round, variability
from kerv_cli.lab.database import Database
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.calibration import (
    NEVER,
    BoundarySection,
    Calibration,
    CalibrationArtifact,
    Demonstrations,
    SkipLevel,
    SkipSection,
    Variability,
)
from kerv_cli.methods.heisd.curvature import BoundaryRanges
from kerv_cli.methods.heisd.datastore import Datastore, Manifest
from kerv_cli.methods.kerv.prediction import PREDICTORS, Noise
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.checkpoint import TargetDescription, read_target
from kerv_cli.training.calibration import (
    LEAST,
    Matches,
    episode_windows,
    fit_noise,
    lowest_level,
    match,
    plan_calibration,
    reference_level,
    skip_section,
    task_levels,
)
from kerv_cli.training.datastore import plan_datastore
from kerv_cli.training.settings import BuildDatastoreSettings, CalibrateSettings
from kerv_cli.worlds.demos.dataset import FORMAT, DemoDataset, dataset_hash, episode_path
from kerv_cli.worlds.demos.files import DemoEpisode, save_episode
from kerv_cli.worlds.metaworld.spec import SPEC

TASKS = ("reach-v3", "drawer-close-v3")
SPACE = SPEC.actions
BIN = 2 / SPACE.tokens
STEPS = 24


def made_up_episode(task: str, seed: int) -> DemoEpisode:
    """Ramps of another slope per DoF, saturating now and then; a gripper that closes half way."""
    time = np.arange(STEPS + 8)
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
    spaces = {"actions": SPACE.as_dict(), "observation": asdict(SPEC.observation)}
    described = {"format": FORMAT, "environment": SPEC.name, **spaces, "config": {"camera": {"name": SPEC.cameras[0]}}}
    write_json(folder / "manifest.json", {**described, "sha256": dataset_hash(tasks), "tasks": tasks})


def recognisable_episode(task: str, seed: int) -> DemoEpisode:
    """What is seen tells the step, nearly: a neighbour is one in time."""
    episode = made_up_episode(task, seed)
    seen = np.outer(np.linspace(-0.5, 0.5, STEPS), np.sin(np.arange(39))) + 0.1 * episode.states
    return replace(episode, states=seen.astype(np.float32))


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """The small policies and a dataset of two tasks."""
    folder = tmp_path_factory.mktemp("calibration") / "results"
    shutil.copytree(policies, folder)
    write_dataset(folder / "artifacts/demos/few", make=recognisable_episode)
    return folder


@pytest.fixture(scope="module")
def with_datastore(results, tmp_path_factory):
    """The same with a datastore of the state policy."""
    folder = Path(shutil.copytree(results, tmp_path_factory.mktemp("skipping") / "results"))
    policy = PolicySettings(target="nano-state")
    built = BuildDatastoreSettings(policy=policy, demos="few", task=list(TASKS), results=str(folder))
    plan_datastore(built, Database(folder)).make()
    return folder


@pytest.fixture
def own(with_datastore, tmp_path):
    return Path(shutil.copytree(with_datastore, tmp_path / "results"))


def words(results: Path, *overrides: str) -> list[str]:
    usual = {"task": "reach,drawer-close", "demos": "few", "decodes": "0", "replace": "true"}
    usual |= {"policy.target": "nano-state", "results": str(results)}
    given = dict(override.split("=", 1) for override in overrides if "=" in override)
    return [f"{key}={value}" for key, value in {**usual, **given}.items()]


def calibrated(results: Path, *overrides: str) -> tuple[Path, Calibration, list[str]]:
    return plan_calibration(
        compose("calibrate", words(results, *overrides), CalibrateSettings), Database(results)
    ).make()


def test_windows_hold_the_normalised_labels_before_and_after_each_moment():
    episode = made_up_episode("reach-v3", 0)
    cut = episode_windows(episode, SPACE, 10, 4)
    assert cut.shape == (STEPS - 10, 14, 4)
    for i in (0, 7, STEPS - 11):
        np.testing.assert_allclose(cut[i], episode.labels[i : i + 14], atol=1e-6)
    narrow = replace(SPACE, low=(-0.5,) * 4, high=(0.5,) * 4)
    np.testing.assert_allclose(
        episode_windows(episode, narrow, 10, 4)[0], np.clip(2 * episode.labels[:14], -1, 1), atol=1e-6
    )
    assert episode_windows(episode, SPACE, STEPS, 4).shape == (0, STEPS + 4, 4)
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
    assert ratio / 4 < fit_noise(seen[:, :10], seen[:, 10:]) < 4 * ratio


def test_variability_is_the_mean_difference_of_the_judged_tokens():
    """K by hand, in normalised action units; what is not judged does not count, nor does a strict DoF."""
    chunk = Chunk(4, SPACE, Follower(SPACE), None)  # type: ignore[arg-type]

    def play(start, drafted, target_tokens):
        played = Round("verify", "x", start, drafted, target_tokens, 0, 1, len(drafted), ())
        chunk.commit(played, [0])
        found = variability(chunk.rounds, SPACE)
        return None if found is None else found / BIN

    assert play(0, (), (100,)) is None
    assert play(3, (254,), (0,)) is None  # the gripper alone: nothing that moves was judged
    assert play(0, (10, 20, 30), (10, 22, 27, 99)) == pytest.approx(5 / 3)  # the bonus was not drafted
    assert play(1, (0, 0, 254, 7), (0, 4, 0, 0)) == pytest.approx((5 + 0 + 4 + 7) / 6)


def test_a_reference_level_is_the_median_of_the_decodes_and_divides():
    def level(*drafts: Round) -> Variability:
        decodes: Any = [SimpleNamespace(rounds=[draft]) for draft in drafts]
        return reference_level(decodes, SPACE, 4)

    def off_by(bins: int) -> Round:
        """Two draft tokens: one accepted and off by these bins, one rejected and off by 30."""
        return Round("verify", "x", 0, (100 + bins, 130), (100, 100, 7), 1, 2, 2, ())

    row = level(off_by(1), off_by(50), off_by(3))
    assert row.k_s == row.levels["mean of compared"] == pytest.approx(33 / 2 * BIN)
    found = [row.levels[name] for name in ("sum of compared", "mean of accepted", "sum of accepted")]
    assert found == pytest.approx([33 * BIN, 3 * BIN, 3 * BIN])
    assert level(off_by(0), off_by(0)).levels["sum of accepted"] == BIN
    assert level(Round("verify", "x", 0, (9,), (9,), 1, 1, 1, ())).k_s == BIN / 12  # one token off by one bin


def test_a_policy_that_sees_no_image_is_calibrated_on_all_control_steps(results, monkeypatch):
    """Its demonstrations may have one image each, at the first step: LIBERO's are recorded so."""
    load, decoded = DemoDataset.load, []
    first = np.zeros(1, dtype=np.int64)
    monkeypatch.setattr(DemoDataset, "load", lambda self, index: replace(load(self, index), frame_steps=first))
    monkeypatch.setattr(Decoder, "decode", recording(Decoder.decode, decoded))
    calibrated(results, "decodes=60", "policy.target=nano-state")
    assert len({tuple(observation.state) for observation in decoded}) > 12


def recording(decode: Callable[..., Any], seen: list[Any]) -> Callable[..., Any]:
    return lambda self, observation: seen.append(observation) or decode(self, observation)


@pytest.mark.parametrize("target", ["nano-state", "nano-vision"])
def test_a_run_writes_what_the_next_session_reads(results, target):
    plan = told("calibrate", *words(results, "decodes=4", f"policy.target={target}"), "--plan")
    assert "12 demonstrations of 2 tasks; 4 decodes per task" in plan
    path, made, notes = calibrated(results, "decodes=4", f"policy.target={target}")
    assert {row.decodes for row in made.variability.values()} == {4}
    assert made.k_s("reach-v3", "sum of compared") == made.variability["reach-v3"].levels["sum of compared"]
    folder = find_target(str(results), target)
    assert path == results / f"artifacts/calibration/{target}/calibration.json"
    loaded = CalibrationArtifact().checked(path, read_target(folder))
    assert loaded == made
    assert loaded.demos.sha256 == DemoDataset.open(results / "artifacts/demos/few").sha256
    assert loaded.boundary.episodes == 12
    assert loaded.skip is None
    drafter = Artifacts(str(results), PolicySettings(target=target)).check(["drafter"])["drafter"]
    assert CalibrationArtifact().sources(loaded) == {"drafter": drafter}  # another drafter's K_S would be another
    assert [line.split(":")[0] for line in notes] == ["no skip levels"]
    for kind, predictor_class in PREDICTORS.items():
        predictor = predictor_class(SPACE.is_strict, loaded.noise.get(kind), window=loaded.window)
        np.testing.assert_allclose(predictor.predict(np.full((10, 4), 0.25), 4), 0.25)


def test_a_calibration_of_an_earlier_version_says_which_measure_of_k_it_lacks():
    with refused("sum of accepted tokens", "kerv calibrate replace=true", error=CheckpointError):
        calibration().k_s("reach-v3", "sum of accepted")


def calibration() -> Calibration:
    return Calibration(
        target=MadeFor("a" * 64, SPACE, 4),
        demos=Demonstrations("b" * 64, {}),
        window=10,
        noise={"kalman": Noise(*2 * [(1.0,) * 4])},
        variability={"reach-v3": Variability(0.7, 5)},
        boundary=BoundarySection(8, {"15": BoundaryRanges(0.01, 2.0, 0.0, 0.2)}),
        skip=SkipSection("d" * 64, 0.1, 0.9, {"reach-v3": SkipLevel(0.9, 0.8, 0.99, 0.5, 40, 0.9, 0.1)}),
    )


def description() -> TargetDescription:
    own = {"sha256": "a" * 64, "family": "compact", "environment": SPEC.name, "settings": {"chunk": 4}}
    spaces = {"actions": SPACE, "observation": SPEC.observation, "cameras": (), "words": (), "provenance": {}}
    return TargetDescription(1, "target", **own, **spaces)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda v: v.pop("noise"), "damaged: noise: field required"),
        (lambda v: v["variability"]["reach-v3"].pop("k_s"), "damaged: variability.reach-v3.k_s"),
        (lambda v: v["boundary"]["windows"]["15"].update(radius_high=0.001), "is no range"),
        (lambda v: v["skip"]["tasks"]["reach-v3"].update(s_min=float("nan")), "damaged: skip.tasks.reach-v3.s_min"),
        (lambda v: v.update(format=1), "damaged: format"),
        (lambda v: v["target"].update(chunk=8), "was made for chunks of 8 steps, not of 4"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(change, says, tmp_path):
    path = tmp_path / "calibration.json"
    write_json(path, asdict(calibration()))
    assert CalibrationArtifact().checked(path, description()) == calibration()
    value = copy.deepcopy(read_json(path))
    change(value)
    path.write_text(json.dumps(value))
    with refused(says, "kerv calibrate", error=CheckpointError):
        CalibrationArtifact().checked(path, description())


@pytest.mark.parametrize(
    ("override", "kind", "says"),
    [("window=3", UsageError, "window=3"), ("task=push", CheckpointError, "no episode of push-v3")],
)
def test_wrong_requests_get_one_line(results, override, kind, says):
    with refused(says, error=kind):
        calibrated(results, "decodes=4", override)


def test_a_task_without_a_reference_level_is_named():
    with pytest.raises(CheckpointError, match="no reference level K_S for push-v3, only for reach-v3"):
        calibration().k_s("push-v3")


# --- calibration skip


def store_of(similar: np.ndarray, tokens: np.ndarray, seeds: np.ndarray, space: ActionSpace = SPACE) -> Datastore:
    """One task `a`. similar (n,): angle of each entry's key."""
    vectors = np.stack([np.cos(similar), np.sin(similar)], 1).astype(np.float32)
    return datastore_of(vectors, tokens, {"a": slice(0, len(tokens))}, seeds, space=space)


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.sampled_from([0.5, 0.7, 0.9, 0.97]), st.integers(1, 25))
def test_the_lowest_level_is_the_definitions(seed, n, confidence, least):
    """Against every level tried one by one; few distinct similarities, so that ties are many."""
    rng = np.random.default_rng(seed)
    similarity = (rng.integers(0, 12, n) / 16).astype(np.float32)
    good = rng.random(n) < 0.8
    levels = [
        float(s) for s in similarity if (similarity >= s).sum() >= least and good[similarity >= s].mean() >= confidence
    ]
    assert lowest_level(Matches(similarity, good * 1.0, good), confidence, least) == (min(levels) if levels else None)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 0.6, 0.8, 0.9, 0.95, 0.99]), st.floats(0.05, 1.0))
def test_the_bounds_hold_the_level(seed, confidence, share):
    rng = np.random.default_rng(seed)
    similarity = rng.random(80).astype(np.float32)
    matches = Matches(similarity, rng.random(80), rng.random(80) < share)
    row = task_levels(matches, confidence)
    assert row.low <= row.s_min <= row.high <= NEVER
    skipped = similarity >= row.s_min
    assert row.share == pytest.approx(skipped.mean())
    if row.s_min < 1:
        assert skipped.sum() >= LEAST
        assert matches.good[skipped].mean() == row.within >= confidence
        assert row.high <= similarity.max()
    else:
        assert (row.low, row.high, row.share, row.error) == (NEVER, NEVER, 0.0, None)


def test_the_bounds_are_the_levels_of_twice_and_a_third_of_the_wrong_chunks():
    """1000 entries, the more similar the better: the k-th hundred from the top has 5·k wrong ones, spread."""
    wrong = np.concatenate([5 * k * np.arange(100) % 100 < 5 * k for k in range(10)])
    similarity = np.linspace(1, 0, 1000).astype(np.float32)
    row = task_levels(Matches(similarity, wrong * 1.0, ~wrong), 0.9)
    shares = {key: float((~wrong[similarity >= getattr(row, key)]).mean()) for key in ("low", "s_min", "high")}
    assert row.low < row.s_min < row.high
    assert shares["s_min"] == pytest.approx(0.9, abs=0.003)
    assert shares["high"] == pytest.approx(0.967, abs=0.003)
    assert shares["low"] == pytest.approx(0.8, abs=0.003)


def test_an_entry_is_compared_with_the_best_of_another_episode():
    """Seeds 0 and 1: the nearest of entry 0 is its own episode's entry 1, and must be passed over."""
    angles, seeds = np.array([0.0, 0.01, 0.5, 0.6]), np.array([0, 0, 1, 1])
    own = np.full((4, 8), 100)
    own[2, :3] = 110  # entry 2: three position tokens ten bins away
    own[3, 7] = 101  # entry 3: the second step's gripper, one bin away
    store = store_of(angles, own, seeds)
    found = match(store, "a", 0.04)
    np.testing.assert_allclose(found.similarity, np.cos([0.5, 0.49, 0.49, 0.59]), atol=1e-6)
    np.testing.assert_allclose(found.error, np.array([30, 30, 30, 1]) * BIN / 8, atol=1e-9)
    assert found.good.tolist() == [True, True, True, False]
    assert match(store, "a", 0.02).good.tolist() == [False] * 4
    seven = np.full((4, 14), 100)
    seven[0, 4], seven[3, 13] = 110, 101  # entry 0: a rotation; entry 3: the second step's gripper
    assert match(store_of(angles, seven, seeds, SEVEN), "a", 9.0).good.tolist() == [True, True, True, False]


def test_a_single_episode_or_too_few_good_entries_never_skip():
    tokens = np.full((40, 8), 100)
    lonely = task_levels(match(store_of(np.linspace(0, 1, 40), tokens, np.zeros(40, int)), "a", 0.1), 0.9)
    assert (lonely.s_min, lonely.entries) == (NEVER, 0)
    seeds = np.arange(40) % 2
    assert task_levels(match(store_of(np.linspace(0, 1, 40), tokens, seeds), "a", 0.1), 0.9).share == 1.0
    few = task_levels(match(store_of(np.linspace(0, 1, 19), tokens[:19], seeds[:19]), "a", 0.1), 0.9)
    assert (few.s_min, few.entries) == (NEVER, 19)
    tokens[::2] = 200
    assert task_levels(match(store_of(np.linspace(0, 1, 40), tokens, seeds), "a", 0.1), 0.9).s_min == NEVER


def test_tasks_that_the_datastore_does_not_hold_are_left_out():
    store = store_of(np.linspace(0, 1, 40), np.full((40, 8), 100), np.arange(40) % 2)
    seen: list[int] = []
    section = skip_section(store, ["b", "a"], 0.1, 0.9, lambda done, total: seen.append(done))
    assert (list(section.tasks), section.datastore) == (["a"], store.manifest.content)
    assert seen == [1, 2]
    assert skip_section(store, ["b"], 0.1, 0.9, lambda done, total: None) is None


def test_the_ranges_are_those_of_the_first_episodes_of_each_task(own):
    _, made, _ = calibrated(own, "boundary_windows=[7,15]", "episodes=4")
    dataset = DemoDataset.open(own / "artifacts/demos/few")
    paths = [dataset.load(i).end_effector for task in TASKS for i in dataset.of_tasks(task)[:4]]
    assert made.boundary.episodes == len(paths) == 8
    assert made.ranges(7) == BoundaryRanges.fit(paths, 7)
    assert made.ranges(15) == BoundaryRanges.fit(paths, 15)
    with pytest.raises(CheckpointError, match="over 7, 15 positions, the boundary looks at 9: run 'kerv calibrate"):
        made.ranges(9)
    with pytest.raises(CheckpointError):
        replace(made, boundary=None).ranges(7)


def test_the_skip_levels_belong_to_one_datastore(own):
    path, made, _ = calibrated(own, "epsilon=1.9", "confidence=0.5")
    described = read_target(find_target(str(own), "nano-state"))
    folder = own / "artifacts/datastore/nano-state"
    row = made.skip.tasks["reach-v3"]
    store = Datastore.open(folder, described)
    assert row == task_levels(match(store, "reach-v3", 1.9), 0.5)
    assert row.share > 0
    assert made.skip_levels("reach-v3", store.manifest.content) == (row.low, row.s_min, row.high)
    assert CalibrationArtifact().checked(path, described) == made
    with pytest.raises(CheckpointError, match="no skip level for push-v3, only for reach-v3, drawer-close-v3"):
        made.skip_levels("push-v3", store.manifest.content)
    with pytest.raises(CheckpointError):
        replace(made, skip=None).skip_levels("reach-v3", store.manifest.content)


def test_the_command_prints_what_it_found(own):
    shown = told("calibrate", *words(own, "epsilon=1.9", "confidence=0.5"))
    for said in ("K_S", "s_min", "would be skipped"):
        assert said in shown
    shutil.rmtree(own / "artifacts/datastore")
    shown = told("calibrate", *words(own, "policy.artifacts.calibration=without"))
    for said in ("no reference levels K_S: decodes=0\n", "no skip levels: no datastore"):
        assert said in shown
    assert "s_min" not in shown
    assert (own / "artifacts/calibration/without/calibration.json").is_file()


@pytest.mark.parametrize("where", ["calibration.json", "datastore/manifest.json"])
def test_a_changed_digit_anywhere_in_a_file_that_decides_results_is_noticed(where, tmp_path):
    """Each number and each word of the shipped file, one at a time: also of its provenance, and of a manifest's key."""
    shipped = shipped_dir() / "mt10-h1" / where
    schema: Any = Calibration if where == "calibration.json" else Manifest
    value, path = json.loads(shipped.read_text()), tmp_path / "changed.json"
    assert "digest" in value
    read_file(schema, shipped)

    def leaves(at: Any) -> Iterator[tuple[Any, Any]]:
        for key, one in at.items() if isinstance(at, dict) else enumerate(at):
            if isinstance(one, dict | list):
                yield from leaves(one)
            elif key != "digest":
                yield at, key

    changed = list(leaves(value))
    for at, key in changed[:: len(changed) // 40]:
        before = at[key]
        at[key] = f"{before}x" if isinstance(before, str) else 7 if before != 7 else 8
        path.write_text(json.dumps(value))
        with pytest.raises(CheckpointError, match="its content does not have the hash that it names"):
            read_file(schema, path)
        at[key] = before
