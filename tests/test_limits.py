"""Every setting has a range, and what lies outside it is refused when it is composed."""

import time
from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

import pytest

import kerv_cli.cli.app  # noqa: F401 - registers the commands
from kerv_cli.base.config import MOST_POINTS, compose, expand
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_label, check_settings
from kerv_cli.base.places import artifact, results_dir
from kerv_cli.base.registry import SETTINGS_GROUPS, parts
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.kerv.prediction import MINIMUM
from kerv_cli.targets.folders import find_target
from kerv_cli.training.settings import CalibrateSettings

SCHEMAS = {name.replace(" ", "_"): part.settings for name, part in parts("command").items()}


def numbers(kind: type) -> Iterator[tuple[type, Field[Any]]]:
    """Every number among the fields of a dataclass and of those that it holds."""
    hints = get_type_hints(kind)
    for at in fields(kind):
        hint = hints[at.name]
        if is_dataclass(hint):
            yield from numbers(hint)
        elif {int, float} & {hint, *get_args(hint)}:
            yield kind, at


def test_every_number_has_limits_and_its_default_lies_within_them():
    kinds = list(SCHEMAS.values())
    kinds += [part.settings for group in (*SETTINGS_GROUPS, "executor") for part in parts(group).values()]
    open_ended = [f"{kind.__name__}.{at.name}" for k in kinds for kind, at in numbers(k) if "limits" not in at.metadata]
    assert open_ended == []
    for kind in kinds:
        check_settings(kind())


WRONG = [
    ("rollout", "task={a:1}", "task="),
    ("rollout", "~method", "'~method' is not an override"),
    ("rollout", "+foo=1", "unknown key 'foo'"),
    ("rollout", "method=spec_vla proposer.depth=1.5", "proposer.depth: Value '1.5'"),
    ("rollout", "seed=4294967296", "seed=4294967296: from 0 to 2147483647"),
    ("rollout", "runtime.threads=99999", "runtime.threads=99999: from 1 to 256"),
    ("rollout", "world.camera.fovy=nan", "world.camera.fovy=nan: above 0, at most 179"),
    ("rollout", "policy.artifacts={drafter:[1]}", "policy.artifacts.drafter"),
    ("train_target", "train.steps=0", "train.steps=0: from 1 to"),
    ("train_target", "target.width=33", "target.width=33 must be a multiple of 2 x target.heads=6"),
    ("train_target", "target.image_size=90", "target.image_size=90 must be a multiple of 8 x target.grid=4"),
    ("sweep", "study.block=0", "study.block=0"),
    ("sweep", "study.settings=${oc.env:HOME}", ": a list or a mapping is wanted"),
    ("calibrate", "boundary_windows=[5,2]", "boundary_windows=2: from 3 to"),
]


@pytest.mark.parametrize(("command", "override", "says"), WRONG)
def test_what_is_wrong_or_out_of_range_is_refused_in_one_line(command, override, says):
    with pytest.raises(UsageError) as refused:
        compose(command, override.split(), SCHEMAS[command])
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "override",
    ["boundary.f_star=nan", "boundary.window=2", "boundary.alpha=1.5", "boundary.alpha=nan", "skip.up=inf"],
)
def test_a_parts_numbers_have_ranges_too(override):
    with pytest.raises(UsageError, match=override.partition("=")[0]):
        compose("rollout", ["method=heisd", override], RolloutSettings)


@pytest.mark.parametrize(
    "grid",
    [
        "seed=range(0,100000000)",
        "seed=range(0,200) record=range(0,200)",
        "seed=range(0,10,0)",
        "seed=range(0,inf)",
        "seed=glob(*)",
        "seed='1",
    ],
)
def test_a_grid_is_counted_before_it_is_expanded(grid):
    began = time.monotonic()
    with pytest.raises(UsageError) as refused:
        expand(grid.split())
    assert time.monotonic() - began < 5
    assert "\n" not in str(refused.value)


def test_a_grid_as_large_as_allowed_is_expanded():
    assert len(expand([f"seed=range(0,{MOST_POINTS})"])) == MOST_POINTS
    assert expand(["seed=range(3,0,-1)"]) == [["seed=3"], ["seed=2"], ["seed=1"]]


@pytest.mark.parametrize("name", ["..", ".", "", ".hidden", "a b", "a\0b", "n" * 300, "n" * 300 + "/x", "/a\0b"])
def test_a_name_stays_in_its_own_kind_of_folder(name):
    with pytest.raises(UsageError):
        artifact("results", "drafter", name)
    with pytest.raises(UsageError):
        find_target("results", name)


def test_a_plain_name_or_a_path_is_taken():
    assert artifact("results", "drafter", "mt10-v1.2+b").parts[-2:] == ("drafter", "mt10-v1.2+b")
    assert artifact("results", "drafter", "a/b").parts == ("a", "b")
    assert results_dir("results/x").parts == ("results", "x")


def test_limits_that_repeat_a_constant_agree_with_it():
    window = next(at for at in fields(CalibrateSettings) if at.name == "window")
    assert window.metadata["limits"][0] == MINIMUM


@pytest.mark.parametrize("label", ["a\nb", "a\tb", "", "a" * 2000])
def test_a_label_is_one_line(label):
    with pytest.raises(UsageError):
        check_label(label)
