"""The boundary's ranges and the skip levels: by hand, from a datastore made to order, kept, refused and printed."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from command import kerv
from examples.own_target import SEVEN
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from test_calibration import STEPS, TASKS, made_up_episode, quiet, write_dataset

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_json
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.methods.calibration import NEVER, Calibration, CalibrationArtifact, Variability
from kerv_cli.methods.heisd.datastore import Datastore, Manifest, Shard
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.training.calibration import LEAST, CalibrationRun, Matches, lowest_level, match, skip_section, task_levels
from kerv_cli.training.datastore import DatastoreBuild
from kerv_cli.training.settings import BuildDatastoreSettings, CalibrateSettings
from kerv_cli.worlds.demos.files import DemoEpisode
from kerv_cli.worlds.metaworld.spec import SPEC

SPACE = SPEC.actions
BIN = 2 / SPACE.tokens


def silent(done: int, total: int) -> None:
    """No progress."""


def recognisable_episode(task: str, seed: int) -> DemoEpisode:
    """What is seen tells the step, nearly: a neighbour is one in time."""
    episode = made_up_episode(task, seed)
    seen = np.outer(np.linspace(-0.5, 0.5, STEPS), np.sin(np.arange(39))) + 0.1 * episode.states
    return replace(episode, states=seen.astype(np.float32))


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """The small policies, a dataset of two tasks and a datastore of the state policy."""
    folder = tmp_path_factory.mktemp("skipping") / "results"
    shutil.copytree(policies, folder)
    write_dataset(folder / "artifacts/demos/few", make=recognisable_episode)
    asked = BuildDatastoreSettings(
        policy=PolicySettings(target="nano-state"), demos="few", task=list(TASKS), results=str(folder)
    )
    DatastoreBuild(asked).build()
    return folder


@pytest.fixture
def copy(results, tmp_path):
    return Path(shutil.copytree(results, tmp_path / "results"))


def words(results: Path, *overrides: str) -> list[str]:
    chosen = ["task=reach,drawer-close", "demos=few", "held_out=0.4", "decodes=0", "policy.target=nano-state"]
    return [*chosen, f"results={results}", *overrides]


def calibrated(
    results: Path, *overrides: str, levels: dict[str, Variability] | None = None
) -> tuple[CalibrationRun, Calibration]:
    """A whole run; `levels` in the place of the pre-sampled variability."""
    run = CalibrationRun(compose("calibrate", words(results, *overrides), CalibrateSettings))
    run.presample = lambda stage: levels or {}  # type: ignore[method-assign]
    return run, run.run(quiet)


def store_of(similar: np.ndarray, tokens: np.ndarray, seeds: np.ndarray, space: ActionSpace = SPACE) -> Datastore:
    """One task `a`. similar (n,): angle of each entry's key."""
    vectors = np.stack([np.cos(similar), np.sin(similar)], 1).astype(np.float32)
    rows = np.arange(len(tokens))
    files = {"vectors.npy": "v" * 64, "payload.parquet": "p" * 64}
    shards = {"a": Shard((0, len(rows)), tuple(sorted(set(seeds.tolist()))))}
    manifest = Manifest(2, "datastore", ("scene",), 2, len(rows), 2, space, "t" * 64, "d" * 64, files, shards)
    return Datastore(manifest, vectors, tokens.astype(np.uint8), seeds, rows, rows, {"a": slice(0, len(rows))})


@hypothesis_settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.sampled_from([0.5, 0.7, 0.9, 0.97]), st.integers(1, 25))
def test_the_lowest_level_is_the_definitions(seed, n, confidence, least):
    """Against every level tried one by one; few distinct similarities, so that ties are many."""
    rng = np.random.default_rng(seed)
    similarity = (rng.integers(0, 12, n) / 16).astype(np.float32)
    good = rng.random(n) < 0.8
    levels = [
        float(s) for s in similarity if (similarity >= s).sum() >= least and good[similarity >= s].mean() >= confidence
    ]
    assert lowest_level(similarity, good, confidence, least) == (min(levels) if levels else None)


@hypothesis_settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 0.6, 0.8, 0.9, 0.95, 0.99]), st.floats(0.05, 1.0))
def test_the_bounds_hold_the_level(seed, confidence, share):
    rng = np.random.default_rng(seed)
    similarity = rng.random(80).astype(np.float32)
    matches = Matches(similarity, 0.2 * (rng.random(80) > share), rng.random(80) > 0.97)
    row = task_levels(matches, 0.1, confidence)
    assert row.low <= row.s_min <= row.high <= NEVER
    skipped = similarity >= row.s_min
    assert row.share == pytest.approx(skipped.mean())
    if row.s_min < 1:
        assert skipped.sum() >= LEAST
        assert matches.good(0.1)[skipped].mean() == row.within >= confidence
        assert row.high <= similarity.max()
    else:
        assert (row.low, row.high, row.share, row.error) == (NEVER, NEVER, 0.0, None)


def test_the_bounds_are_the_levels_of_twice_and_a_third_of_the_wrong_chunks():
    """1000 entries, the more similar the better: the k-th hundred from the top has 5·k wrong ones, spread."""
    wrong = np.concatenate([5 * k * np.arange(100) % 100 < 5 * k for k in range(10)])
    similarity = np.linspace(1, 0, 1000).astype(np.float32)
    row = task_levels(Matches(similarity, wrong * 1.0, np.zeros(1000, bool)), 0.1, 0.9)
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
    found = match(store_of(angles, own, seeds), "a")
    np.testing.assert_allclose(found.similarity, np.cos([0.5, 0.49, 0.49, 0.59]), atol=1e-6)
    np.testing.assert_allclose(found.error, np.array([30, 30, 30, 1]) * BIN / 8, atol=1e-9)
    assert found.strict.tolist() == [False, False, False, True]
    assert found.good(0.04).tolist() == [True, True, True, False]
    assert found.good(0.02).tolist() == [False] * 4
    seven = np.full((4, 14), 100)
    seven[0, 4], seven[3, 13] = 110, 101  # entry 0: a rotation; entry 3: the second step's gripper
    assert match(store_of(angles, seven, seeds, SEVEN), "a").strict.tolist() == [False, False, False, True]


def test_a_single_episode_or_too_few_good_entries_never_skip():
    tokens = np.full((40, 8), 100)
    lonely = task_levels(match(store_of(np.linspace(0, 1, 40), tokens, np.zeros(40, int)), "a"), 0.1, 0.9)
    assert (lonely.s_min, lonely.entries) == (NEVER, 0)
    seeds = np.arange(40) % 2
    assert task_levels(match(store_of(np.linspace(0, 1, 40), tokens, seeds), "a"), 0.1, 0.9).share == 1.0
    few = task_levels(match(store_of(np.linspace(0, 1, 19), tokens[:19], seeds[:19]), "a"), 0.1, 0.9)
    assert (few.s_min, few.entries) == (NEVER, 19)
    tokens[::2] = 200
    assert task_levels(match(store_of(np.linspace(0, 1, 40), tokens, seeds), "a"), 0.1, 0.9).s_min == NEVER


def test_tasks_that_the_datastore_does_not_hold_are_left_out():
    store = store_of(np.linspace(0, 1, 40), np.full((40, 8), 100), np.arange(40) % 2)
    seen: list[int] = []
    section = skip_section(store, ["b", "a"], 0.1, 0.9, lambda done, total: seen.append(done))
    assert (list(section.tasks), section.datastore) == (["a"], store.content)
    assert seen == [1, 2]
    assert skip_section(store, ["b"], 0.1, 0.9, silent) is None


def test_the_ranges_are_those_of_the_training_episodes(copy):
    run, made = calibrated(copy, "boundary_windows=[7,15]")
    training = [run.dataset.load(i).end_effector for i, held_out in run.chosen.items() if not held_out]
    everything = [run.dataset.load(i).end_effector for i in run.chosen]
    assert made.ranges(7) == BoundaryRanges.fit(training, 7)
    assert made.ranges(15) == BoundaryRanges.fit(training, 15)
    assert made.ranges(7) != BoundaryRanges.fit(everything, 7)
    with pytest.raises(CheckpointError, match="over 7, 15 positions, the boundary looks at 9: run 'kerv calibrate"):
        made.ranges(9)
    with pytest.raises(CheckpointError):
        replace(made, boundary=None).ranges(7)


def test_the_skip_levels_belong_to_one_datastore(copy):
    run, made = calibrated(copy, "epsilon=1.9", "confidence=0.5")
    folder = copy / "artifacts/datastore/nano-state"
    row = made.skip.tasks["reach-v3"]
    store = Datastore.open(folder, run.description)
    assert row == task_levels(match(store, "reach-v3"), 1.9, 0.5)
    assert row.share > 0
    assert made.skip_levels("reach-v3", store.content) == (row.low, row.s_min, row.high)
    assert CalibrationArtifact().checked(run.path, run.description) == made
    with pytest.raises(CheckpointError, match=r"for datastore \w+, not for eeeeeeeeeeee: run 'kerv calibrate' again"):
        made.skip_levels("reach-v3", "e" * 64)
    with pytest.raises(CheckpointError, match="no skip level for push-v3, only for reach-v3, drawer-close-v3"):
        made.skip_levels("push-v3", store.content)
    with pytest.raises(CheckpointError):
        replace(made, skip=None).skip_levels("reach-v3", store.content)


def test_what_cannot_be_computed_now_is_kept(copy):
    levels = {name: Variability(0.25, 3, 0.1, 0.3, 0.4) for name in TASKS}
    _, first = calibrated(copy, levels=levels)
    assert "kept" not in first.provenance
    shutil.rmtree(copy / "artifacts/datastore")
    run, second = calibrated(copy, "window=8", "boundary_windows=[5]")
    assert (second.variability, second.skip) == (levels, first.skip)
    assert (second.window, list(second.boundary.windows)) == (8, ["5"])
    assert [line.endswith("kept from the earlier run") for line in run.notes] == [True, True]
    _, third = calibrated(copy, "window=9")
    assert (third.variability, third.skip) == (levels, first.skip)
    assert third.provenance["kept"] == {"variability": first.provenance, "skip": first.provenance}
    _, fourth = calibrated(copy, levels={**levels, TASKS[0]: replace(levels[TASKS[0]], k_s=0.5)})
    assert fourth.k_s(TASKS[0]) == 0.5
    assert list(fourth.provenance["kept"]) == ["skip"]


def test_nothing_is_kept_of_another_target_or_a_damaged_file(copy):
    run, made = calibrated(copy, levels={"reach-v3": Variability(0.25, 3, 0.1, 0.3, 0.4)})
    write_json(run.path, asdict(replace(made, target=replace(made.target, sha256="f" * 64))))
    run, made = calibrated(copy)
    assert made.variability == {}
    assert run.notes == ["reference levels K_S: decodes=0; left empty"]
    write_json(run.path, {"format": 1})
    assert calibrated(copy)[1].variability == {}


def test_the_command_prints_ranges_and_levels(copy):
    done = kerv("calibrate", *words(copy, "epsilon=1.9", "confidence=0.5"))
    for word in ("s_min", "would be skipped", "error ≤ 1.9", "144"):
        assert word in done.output
    assert "skip levels from" in kerv("calibrate", *words(copy, "--plan")).output
    never = kerv("calibrate", *words(copy, "epsilon=0.0001"))
    assert never.output.count("never") == 2
