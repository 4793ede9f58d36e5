"""Action spaces: round trips of tokens, groups, statistics; names, instructions and suites of the tasks."""

import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from examples.insertion import SPEC as INSERTION
from hypothesis import given
from hypothesis import strategies as st

from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace
from kerv_cli.targets.compact.text import PAD, UNKNOWN, WordTokenizer
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


def test_groups_and_strict_dofs_follow_from_the_space():
    assert SPACE.bounds == ((0, 3), (0, 3), (0, 3), (3, 4))
    assert SPACE.is_strict.tolist() == [False, False, False, True]
    seven = INSERTION.actions
    assert seven.dofs == 7
    assert [seven.names[dof] for dof in np.flatnonzero(seven.is_strict)] == ["gripper"]
    assert np.flatnonzero(seven.strict_tokens(14)).tolist() == [6, 13]


def test_a_space_survives_its_json_and_a_damaged_one_gets_one_line():
    for space in (SPEC.actions, INSERTION.actions):
        assert read(ActionSpace, json.loads(json.dumps(space.as_dict())), "a space") == space
    for space in (SPEC.observation, INSERTION.observation):
        assert read(ObservationSpace, json.loads(json.dumps(space.as_dict())), "a space") == space
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


def test_words_keep_their_ids_and_a_long_sentence_is_refused():
    words = WordTokenizer.build(["open the drawer", "close the door"])
    ids = words.encode("Open the window", 5)
    assert ids[2] == UNKNOWN
    assert ids[3:] == [PAD, PAD]
    assert len({*words.encode("open the drawer close door", 5)}) == 5
    with pytest.raises(UsageError, match="5 words, the policy takes 4"):
        words.encode("open the drawer close door", 4)


# --- sim tasks


def test_the_names_and_difficulties_are_those_of_metaworld():
    from kerv_cli.worlds.mujoco_world import load_mujoco

    load_mujoco()
    from metaworld.policies import ENV_POLICY_MAP

    assert set(TASKS) == set(ENV_POLICY_MAP)
    assert Counter(task.difficulty for task in TASKS.values()) == {"easy": 28, "medium": 11, "hard": 6, "very_hard": 5}
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
        assert len({task.instruction for task in spec.tasks.values()}) == len(spec.tasks)
        assert spec.observation.state >= len(spec.observation.proprioception) > 3


@pytest.mark.parametrize(("seeds", "purpose"), [([100_000, 99_999], "evaluation"), ([-1], "training")])
def test_seeds_of_one_purpose_are_refused_for_another(seeds, purpose):
    SPEC.seeds.check([100_000, 2_000_000], "evaluation", "seed")
    with pytest.raises(UsageError, match=f"seed {seeds[-1]} "):
        SPEC.seeds.check(seeds, purpose, "demos")
