"""The datastore: search against brute force, what an entry holds, what is refused, and the tree of the neighbours."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from loaded import datastore_of
from mock_target import SEVEN
from test_calibration import write_dataset

from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.manifests import DIGEST
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decisions import ROOT, TokenTree
from kerv_cli.lab.database import Database
from kerv_cli.methods.heisd.datastore import Datastore, Shard, check_seeds, neighbour_tree, prompt_key
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.checkpoint import TargetDescription, load_target
from kerv_cli.training.datastore import plan_datastore
from kerv_cli.training.settings import BuildDatastoreSettings
from kerv_cli.worlds.demos.files import DemoEpisode
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.settings import EVALUATION_SEED

SPACE = SPEC.actions
TASKS = ("drawer-close-v3", "reach-v3")
LENGTHS = {0: 9, 1: 6, 7: 11}  # seed -> control steps
TAIL = 8


def label_of(task: str, seed: int, step: int) -> np.ndarray:
    """An action that tells which episode and step it belongs to."""
    return np.array([seed / 10, step / 25, TASKS.index(task) / 2, -1 if step < 5 else 1], dtype=np.float32)


def episode(task: str, seed: int, steps: int, tail: int = TAIL, size: int = 96) -> DemoEpisode:
    rng = np.random.default_rng([seed, TASKS.index(task)])
    labels = np.stack([label_of(task, seed, t) for t in range(steps + tail)])
    frame_steps = np.arange(0, steps, 2)
    frames = rng.integers(0, 255, (len(frame_steps), size, size, 3), dtype=np.uint8)
    states = rng.uniform(0, 0.5, (steps, 39)).astype(np.float32)
    executed = labels[:steps].copy()
    return DemoEpisode(task, seed, False, steps, frames, frame_steps, states, labels, executed, np.zeros(3))


def smooth(task: str, seed: int, steps: int, tail: int, size: int) -> DemoEpisode:
    """What is seen follows the step and the episode: keys near a few directions, as an encoder's are."""
    time, waves = np.linspace(-0.5, 0.5, steps)[:, None], np.sin(np.outer([1, 2, 3], np.arange(39)))
    states = time * waves[0] + 0.05 * seed * waves[1] + 0.2 * time**2 * waves[2]
    return replace(episode(task, seed, steps, tail, size), states=states.astype(np.float32))


def write_demos(
    folder: Path, lengths: dict[int, int], tail: int = TAIL, size: int = 96, make: Callable[..., DemoEpisode] = episode
) -> None:
    """A recorded dataset of both tasks."""

    def made(task, seed):
        return make(task, seed, lengths[seed], tail, size)

    write_dataset(folder, make=made, names=TASKS[::-1], seeds=lengths)


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """Policies, demonstrations and a datastore of each policy."""
    results = tmp_path_factory.mktemp("datastore") / "results"
    shutil.copytree(policies, results)
    write_demos(results / "artifacts/demos/few", LENGTHS)
    for name in ("nano-state", "nano-vision"):
        build(asked(results, name))
    return results


@pytest.fixture
def copy(results, tmp_path):
    """A copy that a test may change."""
    return Path(shutil.copytree(results, tmp_path / "results"))


def asked(
    results: Path, target: str = "nano-state", named: str | None = None, **changes: Any
) -> BuildDatastoreSettings:
    policy = PolicySettings(target=target, artifacts={"datastore": named})
    chosen = BuildDatastoreSettings(policy=policy, demos="few", task=list(TASKS), results=str(results), replace=True)
    return replace(chosen, **changes)


def build(settings: BuildDatastoreSettings) -> tuple[Path, Datastore]:
    return plan_datastore(settings, Database(settings.results)).make()


def folder_of(results: Path, name: str = "nano-state") -> Path:
    return results / "artifacts/datastore" / name


def opened(results: Path, name: str = "nano-state") -> tuple[Datastore, Any, TargetDescription]:
    target, description = load_target(results / "artifacts/target" / name)
    return Datastore.open(folder_of(results, name), description), target, description


def on_a_grid(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vectors and a key of small whole numbers, so that ties are many."""
    span, rows = rng.integers([1, 2], [5, 61])
    vectors = rng.integers(-span, span + 1, (rows + 1, 3)).astype(np.float32)
    return vectors[1:], vectors[0]


def near_a_subspace(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """As an encoder's keys are; with noise they differ in the rest, too."""
    rows, width = ((500, 64), (9001, 192), (10, 1024))[rng.integers(3)]
    rank, noise = rng.integers(1, 41), rng.choice([0.0, 1e-7, 1e-3, 0.1])
    vectors = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, width)) + noise * rng.normal(size=(rows, width))
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    vectors[-(rows // 5) :] = vectors[: rows // 5]
    return vectors, (vectors[3] + rng.choice([0.0, 0.1]) * rng.normal(size=width)).astype(np.float32)


@pytest.mark.bits
@given(st.integers(0, 2**32 - 1), st.sampled_from([on_a_grid, near_a_subspace]), st.integers(1, 12))
def test_the_search_is_brute_force_with_ties_in_stored_order(seed, made, k):
    rng = np.random.default_rng(seed)
    vectors, key = made(rng)
    rows, seeds, before = np.arange(len(vectors)), rng.integers(0, 3, len(vectors)), int(rng.integers(0, len(vectors)))
    shards = {"a": slice(0, before), "b": slice(before, len(vectors))}
    store = datastore_of(vectors, np.stack([rows % 251, rows // 251], 1), shards, seeds)  # tokens tell the row
    exact = (vectors.astype(np.float64) @ key.astype(np.float64)).astype(np.float32)
    for without in (None, 1):
        ranked = [row for row in np.argsort(-exact, kind="stable") if row >= before and seeds[row] != without][:k]
        neighbours = store.query(key, "b", k, without)
        assert neighbours.steps.tolist() == ranked
        assert neighbours.similarity.dtype == np.float32
        assert neighbours.similarity.tolist() == exact[ranked].tolist()
        assert neighbours.chunks.tolist() == [[row % 251, row // 251] for row in ranked]


def entries(store: Datastore) -> list[tuple[str, int, int]]:
    tasks = [task for task, shard in store.shards.items() for _ in range(shard.start, shard.stop)]
    return list(zip(tasks, store.seeds.tolist(), store.steps.tolist(), strict=True))


@pytest.mark.parametrize(("name", "stride"), [("nano-state", 1), ("nano-vision", 2)])
def test_every_observed_step_is_one_entry_that_is_found_by_its_own_observation(results, name, stride):
    """The last entries' chunks run into the labels recorded beyond the success, never into the next episode."""
    store, target, _ = opened(results, name)
    expected = [(task, s, t) for task in TASKS for s, steps in LENGTHS.items() for t in range(0, steps, stride)]
    assert entries(store) == sorted(expected) == expected
    assert store.left.tolist() == [LENGTHS[seed] - step for _, seed, step in expected]
    assert np.linalg.norm(store.vectors, axis=1) == pytest.approx(1.0, abs=1e-6)
    for row, (task, seed, step) in enumerate(expected):
        labels = np.stack([label_of(task, seed, t) for t in range(step, step + 4)])
        assert store.tokens[row].tolist() == target.actions.encode(labels).ravel().tolist()
    shown, instruction = episode("reach-v3", 1, LENGTHS[1]), SPEC.task("reach").instruction
    with torch.inference_mode():
        for step in (0, 4):
            state, images = shown.states[step], dict.fromkeys(target.cameras, shown.frames[step // 2])
            prompt = target.encode(Observation(state[:4], state, instruction, images))
            neighbours = store.query(store.key_of(prompt, target), "reach-v3", 3)
            assert (neighbours.seeds[0], neighbours.steps[0], neighbours.left[0]) == (1, step, LENGTHS[1] - step)
            assert neighbours.similarity[0] == pytest.approx(1.0, abs=1e-5)
            assert (np.diff(neighbours.similarity) <= 0).all()
            assert (neighbours.chunks.shape, neighbours.chunks.dtype) == ((3, 16), np.int64)


def test_the_key_pools_the_named_parts_of_the_prompt(results):
    _, target, _ = opened(results, "nano-vision")
    prompt = torch.randn(2, target.max_prompt, target.width)
    vision, scene, hand = prompt[:, :4].mean(1), prompt[:, 14:16].mean(1), prompt[:, 16]
    unit = [x / x.norm(dim=-1, keepdim=True) for x in (vision, scene, hand)]
    assert np.allclose(prompt_key(prompt, target, ["scene"]), unit[1], atol=1e-6)
    whole = prompt_key(prompt, target, ["vision", "scene", "proprioception"])
    assert np.allclose(whole, torch.cat(unit, -1) / 3**0.5, atol=1e-6)
    assert whole.dtype == torch.float32
    assert target.segments["proprioception"].stop == target.max_prompt
    state = opened(results)[1]
    assert "vision" not in state.segments
    with pytest.raises(UnknownName):
        prompt_key(prompt, state, ["vision"])


def test_the_first_episodes_and_tasks_can_be_asked_for(copy):
    plan = plan_datastore(asked(copy, task=["reach"], episodes=2, key=["proprioception"]), Database(copy))
    assert "2 demonstrations of 1 task, 15 control steps" in plan.text
    _, store = plan.make()
    assert set(entries(store)) == {("reach-v3", s, t) for s in (0, 1) for t in range(LENGTHS[s])}
    assert store.manifest.tasks == {"reach-v3": Shard((0, 15), (0, 1))}


def test_a_datastore_of_half_the_bytes_holds_the_same(copy):
    whole, _, description = opened(copy)
    build(asked(copy, half=True))
    half = Datastore.open(folder_of(copy), description)
    assert entries(half) == entries(whole)
    assert half.vectors.dtype == np.float32
    assert half.vectors == pytest.approx(whole.vectors, abs=1e-3)
    assert np.load(folder_of(copy) / "vectors.npy").dtype == np.float16


def test_projected_keys_find_nearly_always_the_same_neighbour_in_a_smaller_file(copy):
    write_demos(copy / "artifacts/demos/few", LENGTHS, make=smooth)
    build(asked(copy))
    whole, target, _ = opened(copy)
    size = (folder_of(copy) / "vectors.npy").stat().st_size
    build(asked(copy, components=8))
    short, _, _ = opened(copy)
    assert (whole.vectors.shape[1], short.vectors.shape[1], short.manifest.width) == (target.width, 8, 8)
    assert (folder_of(copy) / "vectors.npy").stat().st_size < size / 2
    assert sorted(short.manifest.files) == ["payload.parquet", "projection.npy", "vectors.npy"]
    assert np.linalg.norm(short.vectors, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.array_equal(short.tokens, whole.tokens)
    assert short.manifest.content != whole.manifest.content
    same = []
    for task, shard in whole.shards.items():
        for row in range(shard.start, shard.stop):
            without = int(whole.seeds[row])
            one, other = (store.query(store.vectors[row], task, 1, without) for store in (whole, short))
            same.append((one.steps[0], one.seeds[0]) == (other.steps[0], other.seeds[0]))
            assert other.similarity[0] == pytest.approx(one.similarity[0], abs=0.02)
    assert np.mean(same) > 0.9
    shown, instruction = smooth("reach-v3", 1, LENGTHS[1], TAIL, 96), SPEC.task("reach").instruction
    with torch.inference_mode():  # what is looked up while decoding is projected, too
        prompt = target.encode(Observation(shown.states[2][:4], shown.states[2], instruction))
    neighbours = short.query(short.key_of(prompt, target), "reach-v3", 1)
    assert (neighbours.seeds[0], neighbours.steps[0]) == (1, 2)
    assert neighbours.similarity[0] == pytest.approx(1.0, abs=1e-5)


def test_training_and_evaluation_seeds_are_proved_disjoint(results, tmp_path):
    last = SPEC.seeds.training.stop - 1
    check_seeds({"reach-v3": [0, last]}, "here")
    with pytest.raises(CheckpointError, match="here holds seed 50000 of reach-v3"):  # of selection
        check_seeds({"reach-v3": [0, last, last + 1]}, "here")
    shutil.copytree(results / "artifacts/target", tmp_path / "artifacts/target")
    write_demos(tmp_path / "artifacts/demos/few", {0: 5, EVALUATION_SEED + 3: 5})
    with pytest.raises(CheckpointError, match="seed 100003 of drawer-close-v3: seeds from 50000 on"):
        build(asked(tmp_path))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    del manifest[DIGEST]  # as one that was made so, not damaged later
    (folder / "manifest.json").write_text(json.dumps(manifest))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (
            lambda f: rewrite(f, lambda m: m["actions"].update(low=[-2, -1, -1, -1])),
            "an action space with low -2, -1, -1, -1",
        ),
        (
            lambda f: rewrite(f, lambda m: m["tasks"]["reach-v3"]["seeds"].append(EVALUATION_SEED)),
            "holds seed 100000 of reach-v3",
        ),
        (lambda f: rewrite(f, lambda m: m.update(format=1)), "manifest.json is damaged: format"),
        (lambda f: rewrite(f, lambda m: m.update(rows=60)), "its files do not fit its manifest"),
        (lambda f: rewrite(f, lambda m: m["actions"].update(high=[-9] * 4)), "manifest.json is damaged: actions"),
        (lambda f: cut(f / "vectors.npy"), "vectors.npy does not match its manifest"),
        (lambda f: (f / "payload.parquet").unlink(), "payload.parquet cannot be read"),
        (lambda f: cut(f / "manifest.json"), "cannot be read as JSON"),
        (lambda f: shutil.rmtree(f), "no datastore in"),
    ],
)
def test_a_datastore_that_is_damaged_or_not_of_this_target_is_refused(copy, harm, says):
    harm(folder_of(copy))
    with refused(says, error=CheckpointError):
        opened(copy)


def test_a_key_of_no_part_is_refused(results):
    with refused("name at least one part", error=UsageError):
        build(asked(results, key=[]))


def test_demonstrations_that_do_not_fit_the_target_are_refused(copy):
    write_demos(copy / "artifacts/demos/few", LENGTHS, tail=2)
    with pytest.raises(
        CheckpointError, match="2 labels after an episode's end, chunks of 4 need 3: take at most 3, or record or"
    ):
        build(asked(copy))
    write_demos(copy / "artifacts/demos/few", LENGTHS, size=32)
    with pytest.raises(CheckpointError, match="32 x 32 pixels, the policy takes 96"):
        build(asked(copy, "nano-vision"))
    assert opened(copy)[0].manifest.rows == 52  # what was there still is


@pytest.mark.bits
def test_a_rebuild_replaces_the_whole_datastore_and_is_the_same(copy):
    first = {p.name: p.read_bytes() for p in folder_of(copy).iterdir()}
    build(asked(copy, episodes=1))
    assert opened(copy)[0].manifest.rows == 2 * LENGTHS[0]
    build(asked(copy))
    again = {p.name: p.read_bytes() for p in folder_of(copy).iterdir()}
    assert again["vectors.npy"] == first["vectors.npy"]
    assert again["payload.parquet"] == first["payload.parquet"]


def leaves(tree: TokenTree) -> list[tuple[int, ...]]:
    inner = set(tree.parents)
    return [tuple(tree.tokens[i] for i in tree.path_to(n)) for n in range(len(tree)) if n not in inner]


def ranked_paths(
    chunks: np.ndarray, cuts: list[tuple[int, int, bool]], cross: float
) -> list[tuple[float, tuple[int, ...]]]:
    """Every path of whole groups with its probability by docs/methods.md §4.2, most probable first: enumerated, no
    search. The i-th neighbour weighs 1 / i; a path leaves the neighbours it has followed with probability `cross`."""
    weights = [1.0 / (1 + i) for i in range(len(chunks))]

    def share(some, all_):
        return sum(weights[i] for i in some) / sum(weights[i] for i in all_)

    def below(level, path, odds, gave, followed):
        if level == len(cuts):
            return
        first, last, strict = cuts[level]
        pool = gave if strict else set(range(len(chunks)))
        for group in {tuple(chunks[i, first:last].tolist()) for i in pool}:
            owners = {i for i in pool if tuple(chunks[i, first:last].tolist()) == group}
            staying = owners & followed
            own = odds * ((1 - cross) * share(staying, followed) + cross * share(owners, pool))
            if own > 0:
                yield own, path + group
                yield from below(level + 1, path + group, own, owners, staying or owners)

    everyone = set(range(len(chunks)))
    return sorted(below(0, (), 1.0, everyone, everyone), reverse=True)


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([SPACE, SEVEN]),
    st.integers(1, 5),
    st.sampled_from([1, 2, 3, 255]),
    st.integers(0, 9),
    st.sampled_from([1, 3, 6]),
    st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    st.floats(0, 1),
)
def test_a_limited_tree_holds_the_most_probable_groups(seed, space, k, span, start, depth, cross, where):
    """Room for exactly the m most probable groups: the tree is these, where the next one is less probable."""
    chunks = np.random.default_rng(seed).integers(0, span, (k, 3 * space.dofs))
    paths = ranked_paths(chunks, list(space.segments(start, min(chunks.shape[1], start + depth))), cross)
    drops = [m for m in range(1, len(paths)) if paths[m][0] < 0.999 * paths[m - 1][0]] + [len(paths)]
    m = drops[min(int(where * len(drops)), len(drops) - 1)]
    kept = [path for _, path in paths[:m]]
    prefixes = {path[:n] for path in kept for n in range(1, len(path) + 1)}
    tree = neighbour_tree(chunks, start, space, len(prefixes), depth, cross).tree
    assert {tuple(tree.tokens[i] for i in tree.path_to(n)) for n in range(len(tree))} == prefixes
    nodes = max(0, len(prefixes) - 1)  # no room for the last group: every path still ends with a whole one
    smaller = neighbour_tree(chunks, start, space, nodes, depth, cross).tree
    assert len(smaller) <= nodes
    assert set(leaves(smaller)) <= {path for _, path in paths}


def test_of_equally_probable_groups_the_better_neighbours_comes_first():
    """The grippers 8 of neighbours 3 and 6 and 9 of neighbour 2 weigh 1/3 + 1/6 = 1/2; only the best neighbour, who
    went another way, gave the 8 before."""
    grippers = [8, 9, 8, 8, 8, 8]
    chunks = np.array([[i in (1, 2, 5)] * 3 + [gripper] for i, gripper in enumerate(grippers)], dtype=np.int64)
    tree = neighbour_tree(chunks, 0, SPACE, cross=0.0).tree
    assert [path[-1] for path in leaves(tree) if path[0] == 1] == [9, 8]
    assert list(tree.tokens) == [0, 0, 0, 8, 1, 1, 1, 9, 8]
    assert list(tree.parents) == [ROOT, 0, 1, 2, ROOT, 4, 5, 6, 6]
    assert len(neighbour_tree(chunks, 4, SPACE)) == len(neighbour_tree(chunks[:0], 0, SPACE)) == 0
