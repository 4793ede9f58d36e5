"""Action spaces: round trips of tokens, statistics, codes; names, instructions and suites of the tasks."""

import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from conftest import refused
from examples.insertion import SPEC as INSERTION
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.base.codes import FastCode
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace
from kerv_cli.worlds import resolve_tasks, spec_of, specs, task_names
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.metaworld.tasks import SUITES, TASKS

WIDTH = 2 / 255  # of a bin
SPACE = SPEC.actions


def openvla_bin(value: float) -> int:
    """OpenVLA's rule in its own terms: digitize over 256 edges, ids counted from one, then clipped to the centres."""
    return int(np.clip(np.digitize(np.clip(value, -1, 1), np.linspace(-1, 1, 256)) - 1, 0, 254))


def test_both_ends_belong_to_the_outermost_bins():
    assert len(SPACE.edges) == 256
    assert SPACE.tokens == len(SPACE.centres) == 255
    assert SPACE.bins_of(np.array([-1.0, 1.0, -7.0, 7.0])).tolist() == [0, 254, 0, 254]
    assert SPACE.values_of(np.array([0, 254])) == pytest.approx([-1 + WIDTH / 2, 1 - WIDTH / 2])


@given(st.floats(-1.0, 1.0))
def test_the_round_trip_is_within_half_a_bin_and_equals_openvla(value):
    token = SPACE.bins_of(np.array(value))
    assert token == openvla_bin(value)
    assert abs(SPACE.values_of(token) - value) <= WIDTH / 2 + 1e-12


def test_statistics_are_the_percentiles_and_a_still_dof_stays_finite():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-3, 5, (5000, 4))
    actions[:, 3] = 0.25
    fitted = SPACE.fitted(actions)
    assert fitted.low[:3] == pytest.approx(np.quantile(actions[:, :3], 0.01, axis=0))
    assert fitted.high[:3] == pytest.approx(np.quantile(actions[:, :3], 0.99, axis=0))
    back = fitted.decode(fitted.encode(actions))
    inside = (actions > np.array(fitted.low)) & (actions < np.array(fitted.high))
    assert np.abs(back - actions)[inside].max() <= (8 / 255) / 2 + 1e-9
    assert back[:, 3] == pytest.approx(0.25, abs=WIDTH)


def test_a_space_survives_its_json_and_a_damaged_one_gets_one_line():
    for space in (SPEC.actions, INSERTION.actions):
        assert read(ActionSpace, json.loads(json.dumps(space.as_dict())), "a space") == space
    for space in (SPEC.observation, INSERTION.observation):
        assert read(ObservationSpace, json.loads(json.dumps(asdict(space))), "a space") == space
    wrong = (
        {"names": 1},
        {**SPACE.as_dict(), "more": 1},
        {**SPACE.as_dict(), "bins": 2},
        {**SPACE.as_dict(), "low": [float("nan")] * 4},
        {**SPACE.as_dict(), "groups": [{"name": "position", "size": 3}]},
        {**SPACE.as_dict(), "strict": ["thumb"]},
    )
    for value in wrong:
        with refused("an action space is damaged", error=CheckpointError):
            read(ActionSpace, value, "an action space")


def test_what_was_made_for_other_actions_is_refused_by_the_first_difference():
    fitted = replace(SPACE, low=(-0.5,) * 4)
    fitted.check_same(SPACE, "the target", "the environment")
    others = {
        "names": INSERTION.actions,
        "strict": replace(SPACE, strict=()),
        "groups": replace(SPACE, groups=(Group("all", 4),)),
        "low": fitted,
    }
    for name, other in others.items():
        with pytest.raises(CheckpointError, match=f"an action space with {name} "):
            SPACE.check_same(other, "the target", "the drafter", statistics=True)


# --- sim tasks


def test_the_names_are_those_of_metaworld():
    from kerv_cli.worlds.mujoco_world import load_mujoco

    load_mujoco()
    from metaworld.policies import ENV_POLICY_MAP

    assert set(TASKS) == set(ENV_POLICY_MAP)
    assert len({task.instruction for task in TASKS.values()}) == 50
    assert all(re.fullmatch(r"[a-z]+( [a-z]+){0,9}", task.instruction) for task in TASKS.values())


def test_suites_expand_in_order_without_duplicates():
    assert spec_of("drawer-open") is spec_of("drawer-open-v3") is SPEC  # the suffix is optional
    resolved = resolve_tasks(["window-open", "MT10", "window-open-v3", "hammer"])
    assert resolved[0] == "window-open-v3"
    assert resolved[1:10] == tuple(name for name in SUITES["MT10"] if name != "window-open-v3")
    assert resolved[10:] == ("hammer-v3",)
    assert resolve_tasks(["mt50"]) == tuple(TASKS)


def test_names_are_looked_for_in_every_environment():
    assert set(specs()) == {"metaworld", "libero", "insertion"}
    assert spec_of("fetch-peg") is specs()["insertion"]
    assert resolve_tasks(["insertion"]) == ("insert-peg", "fetch-peg")
    assert {"MT10", "INSERTION", "reach-v3", "insert-peg"} <= set(task_names())
    for wrong in (["MT11"], ["inser-peg"], ["drawer-opn-v3"]):
        with pytest.raises(UnknownName):
            resolve_tasks(wrong)
    for wrong in ([], ["reach", "insert-peg"]):
        with pytest.raises(UsageError):
            resolve_tasks(wrong)


def test_every_spec_fits_together():
    for spec in specs().values():
        assert all(name in spec.tasks for suite in spec.suites.values() for name in suite)
        assert set(spec.upside_down) <= set(spec.cameras)
        own = [task.instruction for name, task in spec.tasks.items() if "_" not in name]  # LIBERO-PRO repeats some
        assert len(set(own)) == len(own)
        assert spec.observation.state >= len(spec.observation.proprioception) > 3


@settings(max_examples=60)
@given(
    steps=st.integers(1, 16), dofs=st.integers(1, 8), scale=st.sampled_from([1.0, 10.0]), seed=st.integers(0, 10_000)
)
def test_a_fast_code_gives_back_every_integer(steps, dofs, scale, seed):
    """For random merges, random coefficients in its range, and the rounded ones of the largest actions."""
    rng = np.random.default_rng(seed)
    plain = FastCode(steps, dofs, scale)
    count = 2 * plain.highest + 1
    pairs = {tuple(sorted(pair)) for pair in rng.integers(0, count, (12, 2)).tolist()}
    code = FastCode(steps, dofs, scale, tuple(sorted(pairs)))
    random = rng.integers(-plain.highest, plain.highest + 1, (4, steps * dofs)) * (rng.random((4, steps * dofs)) < 0.5)
    largest = code.coefficients(np.sign(rng.normal(size=(4, steps, dofs))))
    assert np.abs(largest).max() <= code.highest
    for row in [*random, *largest, np.zeros(steps * dofs, int)]:
        tokens = code.encode(row[None])[0]
        assert tokens.shape == (code.longest,)
        assert tokens.max() == code.end
        assert tokens[-1] == code.end
        found = code.decode(tokens.tolist())
        assert found + [0] * (len(row) - len(found)) == row.tolist()


def test_a_learnt_fast_code_is_shorter_than_bins_and_survives_its_file():
    """docs/methods.md §0.3. A beginning of a sequence is a coarser motion, and the difference falls with its length."""
    rng = np.random.default_rng(0)
    chunks = np.cumsum(rng.normal(0, 0.1, (2000, 8, 4)), 1).clip(-1, 1)
    space = replace(SPACE, low=(-1.0,) * 4, high=(1.0,) * 4, code=FastCode.learn(chunks))
    assert read(ActionSpace, json.loads(json.dumps(space.as_dict())), "it") == space
    tokens = space.chunk_tokens(chunks[:50])
    assert (tokens != space.end).sum(1).mean() < 20  # bins: 32
    for row, chunk in zip(tokens.tolist(), chunks, strict=False):
        whole = row.index(space.end)
        errors = [np.abs(space.chunk_values(row[:n], 8) - chunk).mean() for n in (1, whole // 2, whole)]
        assert errors[-1] < 0.05
        assert errors[2] <= errors[1] <= errors[0] + 0.05
    assert space.chunk_values(tokens[0].tolist(), 3).shape == (3, 4)
    with pytest.raises(CheckpointError, match="code"):
        space.check_same(SPACE, "the drafter", "the target", statistics=True)
