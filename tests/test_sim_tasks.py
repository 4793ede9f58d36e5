"""Names, instructions and suites of the 50 tasks."""

import re
import subprocess
import sys
from collections import Counter

import pytest

from kerv_cli.environments.metaworld.tasks import DIFFICULTIES, SUITES, TASKS, resolve_tasks, task
from kerv_cli.errors import UnknownName


def test_the_names_are_those_of_metaworld():
    from kerv_cli.environments.metaworld.world import load_simulator

    load_simulator()
    from metaworld.policies import ENV_POLICY_MAP

    assert set(TASKS) == set(ENV_POLICY_MAP)
    assert len(TASKS) == 50


def test_instructions_are_distinct_and_short():
    instructions = [task.instruction for task in TASKS.values()]
    assert len(set(instructions)) == 50
    for text in instructions:
        assert re.fullmatch(r"[a-z]+( [a-z]+){0,9}", text), text


def test_confusable_tasks_are_told_apart():
    assert "clockwise" in task("faucet-close").instruction.split()
    assert "counterclockwise" in task("faucet-open").instruction.split()
    assert "back" in task("push-back").instruction.split()
    assert "back" not in task("push").instruction.split()


def test_difficulty_groups_have_the_published_sizes():
    sizes = Counter(task.difficulty for task in TASKS.values())
    assert sizes == {"easy": 28, "medium": 11, "hard": 6, "very_hard": 5}
    assert set(sizes) == set(DIFFICULTIES)


@pytest.mark.parametrize("name", ["drawer-open", "drawer-open-v3"])
def test_the_version_suffix_is_optional(name):
    assert task(name) is TASKS["drawer-open-v3"]


def test_a_misspelled_task_names_its_neighbour():
    with pytest.raises(UnknownName, match="unknown task 'drawer-opn-v3': did you mean drawer-open-v3"):
        task("drawer-opn-v3")


def test_suites_expand_in_order_without_duplicates():
    resolved = resolve_tasks(["window-open", "MT10", "window-open-v3", "hammer"])
    assert resolved[0] == "window-open-v3"
    assert resolved[1:10] == tuple(name for name in SUITES["MT10"] if name != "window-open-v3")
    assert resolved[10:] == ("hammer-v3",)
    assert resolve_tasks(["mt50"]) == tuple(TASKS)
    with pytest.raises(UnknownName, match="MT10"):
        resolve_tasks(["MT11"])


def test_importing_the_table_loads_nothing_heavy():
    heavy = "('numpy', 'mujoco', 'metaworld')"
    code = f"import sys, kerv_cli.environments.metaworld.tasks; sys.exit(any(m in sys.modules for m in {heavy}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
