"""Names, instructions and suites of the 50 tasks."""

import re
from collections import Counter

import pytest

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.worlds import resolve_tasks, spec_of, specs, task_names
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.metaworld.tasks import DIFFICULTIES, SUITES, TASKS


def test_the_names_are_those_of_metaworld():
    from kerv_cli.worlds.mujoco_world import load_mujoco

    load_mujoco()
    from metaworld.policies import ENV_POLICY_MAP

    assert set(TASKS) == set(ENV_POLICY_MAP)
    assert len(TASKS) == 50


def test_instructions_are_distinct_and_short():
    instructions = [task.instruction for task in TASKS.values()]
    assert len(set(instructions)) == 50
    for text in instructions:
        assert re.fullmatch(r"[a-z]+( [a-z]+){0,9}", text), text


def test_difficulty_groups_have_the_published_sizes():
    sizes = Counter(task.difficulty for task in TASKS.values())
    assert sizes == {"easy": 28, "medium": 11, "hard": 6, "very_hard": 5}
    assert set(sizes) == set(DIFFICULTIES)


def test_suites_expand_in_order_without_duplicates():
    assert spec_of("drawer-open") is spec_of("drawer-open-v3") is SPEC  # the suffix is optional
    resolved = resolve_tasks(["window-open", "MT10", "window-open-v3", "hammer"])
    assert resolved[0] == "window-open-v3"
    assert resolved[1:10] == tuple(name for name in SUITES["MT10"] if name != "window-open-v3")
    assert resolved[10:] == ("hammer-v3",)
    assert resolve_tasks(["mt50"]) == tuple(TASKS)


def test_names_are_looked_for_in_every_environment():
    assert set(specs()) == {"metaworld", "insertion"}
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
        assert {task.difficulty for task in spec.tasks.values()} == set(spec.difficulties)
        assert all(name in spec.tasks for suite in spec.suites.values() for name in suite)
        assert set(spec.upside_down) <= set(spec.cameras)
        assert len({task.instruction for task in spec.tasks.values()}) == len(spec.tasks)
        assert spec.observation.state >= len(spec.observation.proprioception) > 3


@pytest.mark.parametrize(("seeds", "purpose"), [([100_000, 99_999], "evaluation"), ([-1], "training")])
def test_seeds_of_one_purpose_are_refused_for_another(seeds, purpose):
    SPEC.seeds.check([100_000, 2_000_000], "evaluation", "seed")
    with pytest.raises(UsageError, match=f"seed {seeds[-1]} "):
        SPEC.seeds.check(seeds, purpose, "demos")
