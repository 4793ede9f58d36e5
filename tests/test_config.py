"""Every config composes into its dataclass; wrong overrides and numbers out of range get one helpful line."""

import re
import time
from collections.abc import Iterator
from dataclasses import Field, asdict, fields, is_dataclass, replace
from typing import Any, get_args, get_type_hints

import pytest
import yaml
from command import refusal, told
from conftest import refused

import kerv_cli.cli.app  # noqa: F401 - registers the commands
from kerv_cli.base.codes import FastCode
from kerv_cli.base.config import _composed, compose, conf_dir, expand, groups, swept_keys
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_label, check_settings, description
from kerv_cli.base.paths import artifact, find_target
from kerv_cli.base.registry import METHOD_KINDS, SETTINGS_GROUPS, NoSettings, part_of, parts
from kerv_cli.cli.common import settings_yaml
from kerv_cli.episodes.interface import read_interface
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import opened
from kerv_cli.lab.store import Study, how_to_run
from kerv_cli.methods.compose import Method
from kerv_cli.targets.checkpoint import read_target
from kerv_cli.training.preparation import needs
from kerv_cli.worlds.libero.spec import SPEC as LIBERO

SCHEMAS = {
    name.replace(" ", "_"): part.settings for name, part in parts("command").items() if part.settings is not NoSettings
}
# which command each group belongs to
HOMES = {"target": "train_target", "grow": "build_target", "drafter": "train_drafter", "study": "sweep"}


def test_every_command_composes_and_shows_what_every_setting_is():
    for command, schema in SCHEMAS.items():
        settings = compose(command, [], schema)
        shown = settings_yaml(settings)
        assert "results: results" in shown
        assert yaml.safe_load(shown) == asdict(settings)  # the descriptions are comments


def test_every_setting_has_a_description():
    undescribed: list[str] = []

    def look(value, prefix):
        for at in fields(value):
            undescribed.extend([f"{prefix}.{at.name}"] if at.name != "kind" and not description(at) else [])
            if is_dataclass(at.default_factory):  # the settings of a part are the part's
                look(getattr(value, at.name), f"{prefix}.{at.name}")

    for command, schema in SCHEMAS.items():
        look(schema(), command)
    assert undescribed == []


WHOLE = {group: names for group, names in groups().items() if group not in (*METHOD_KINDS, "interface")}
PARTS = {group: groups()[group] for group in METHOD_KINDS}


@pytest.mark.parametrize(("group", "name"), [(group, name) for group, names in WHOLE.items() for name in names])
def test_every_config_composes(group, name):
    command = HOMES.get(name if group == "train" else group, "train_target" if group == "train" else "rollout")
    needs = ["policy.url=ws://HOST:1"] if (group, name) == ("policy", "remote") else []
    compose(command, [f"{group}={name}", *needs], SCHEMAS[command])


@pytest.mark.parametrize("name", groups()["interface"])
def test_every_interface_is_read_and_names_what_its_environment_has(name):
    interface = read_interface(name)
    assert all(camera.partition(":")[0] in LIBERO.cameras for camera in interface.cameras)
    assert interface.kerv or interface.environment == LIBERO.name


def test_quick_is_a_preset_that_typed_settings_override():
    def target(*words):
        return compose("train_target", list(words), SCHEMAS["train_target"])

    usual, quick = target(), target("quick=true")
    assert (usual.target.observation, quick.target.observation) == ("vision", "state")
    assert quick.train.steps < usual.train.steps
    own = target("target=nano", "train.steps=7", "quick=true")
    assert (own.target.size, own.target.observation) == ("nano", "state")
    assert (own.train.steps, own.train.batch) == (7, quick.train.batch)


def test_a_quick_preparation_makes_what_the_methods_of_the_own_study_need():
    quick = compose("prepare", ["quick=true"], SCHEMAS["prepare"])
    assert quick.steps < compose("train_drafter", [], SCHEMAS["train_drafter"]).train.steps
    of_study = {kind for one in resolve(["study=own"]).settings.values() for kind in Method.of(one).needs}
    target = read_target(find_target("results", "mt10-h1"))
    assert set(needs(quick.methods, target)) == of_study
    coded = replace(target, actions=replace(target.actions, code=FastCode(4, 4, 10.0)))
    assert {"drafter", "early"} <= set(needs([], coded)) <= set(needs([], target)) - {"calibration"}


@pytest.mark.parametrize("row", range(max(map(len, PARTS.values()))))
def test_every_config_of_a_part_composes(row):
    """One of every group at a time."""
    names = {group: names[row % len(names)] for group, names in PARTS.items()}
    settings = compose("rollout", [f"{group}={name}" for group, name in names.items()], RolloutSettings)
    for group, name in names.items():
        chosen = getattr(settings, group)
        part = part_of(group, chosen.kind)
        assert type(chosen) is part.settings
        assert name.startswith(chosen.kind)  # a variant is named after its part
        assert name in parts(part.kind) or (conf_dir() / group / f"{name}.yaml").is_file()


def test_grids_expand_in_hydras_grammar():
    assert expand(["method=ar,spec_vla", "threshold.r=0,9"]) == [
        ["method=ar", "threshold.r=0"],
        ["method=ar", "threshold.r=9"],
        ["method=spec_vla", "threshold.r=0"],
        ["method=spec_vla", "threshold.r=9"],
    ]
    assert [p[0] for p in expand(["threshold.r=range(0,7,3)"])] == ["threshold.r=0", "threshold.r=3", "threshold.r=6"]
    assert expand(["task=[reach-v3,push-v3]"]) == [["task=[reach-v3,push-v3]"]]
    assert swept_keys(["method=ar", "threshold.r=0,9"]) == ["threshold.r"]


@pytest.mark.parametrize("plus", ["", "+"])
def test_a_study_refuses_what_it_sets_itself(plus):
    with pytest.raises(UsageError, match=r"sets threshold\.r itself"):
        resolve(["study=threshold", f"{plus}threshold.r=3"])
    with pytest.raises(UsageError, match=r"^episodes=0: from 1"):  # typed, so no file is blamed
        resolve(["study=threshold", f"{plus}episodes=0"])


def test_a_study_composes_each_choice_of_parts_once():
    """65 settings take 0.5 s; each composition of Hydra takes 0.05 s."""
    before = _composed.cache_info().misses
    assert len(resolve(["study=stress"]).settings) == 65
    assert _composed.cache_info().misses - before <= 10


# --- limits


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
    kinds += [part.settings for group in SETTINGS_GROUPS for part in parts(group).values()]
    open_ended = [f"{kind.__name__}.{at.name}" for k in kinds for kind, at in numbers(k) if "limits" not in at.metadata]
    assert open_ended == []
    for kind in kinds:
        check_settings(kind())


WRONG = [
    ("rollout", "task={a:1}", "task="),
    ("rollout", "~method", "'~method' is not an override"),
    ("rollout", "method=spec_vla proposer.depth=1.5", "proposer.depth: Value '1.5'"),
    ("rollout", "runtime.threads=99999", "runtime.threads=99999: from 1 to 256"),
    ("rollout", "world.camera.fovy=nan", "world.camera.fovy=nan: above 0, at most 179"),
    ("rollout", "policy.artifacts={drafter:[1]}", "policy.artifacts.drafter"),
    ("train_target", "train.steps=0", "train.steps=0: from 1 to"),
    ("train_target", "target.width=33", "target.width=33 must be a multiple of 2 x target.heads=6"),
    ("calibrate", "boundary_windows=[5,2]", "boundary_windows=2: from 3 to"),
    ("rollout", "method=heisd boundary.f_star=nan", "boundary.f_star"),
    ("rollout", "method=kerv threshold.r=5", "unknown key 'threshold.r': it belongs to threshold=fixed"),
    ("rollout", "threshold=growing", "unknown threshold 'growing'"),
    ("rollout", "threshold=growing", "(a plugin's name needs KERV_PLUGINS=MODULE)"),
]


@pytest.mark.parametrize(("command", "override", "says"), WRONG)
def test_what_is_wrong_or_out_of_range_is_refused_in_one_line(command, override, says):
    with refused(says, error=UsageError):
        compose(command, override.split(), SCHEMAS[command])


@pytest.mark.parametrize(
    "grid",
    [
        "seed=range(0,100000000)",
        "seed=range(0,inf)",
        "seed=glob(*)",
    ],
)
def test_a_grid_is_counted_before_it_is_expanded(grid):
    began = time.monotonic()
    with refused(error=UsageError):
        expand(grid.split())
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("name", ["..", ".", "", ".hidden", "a b", "a\0b", "n" * 300, "../x", "a/b"])
def test_a_name_stays_in_its_own_kind_of_folder(name):
    with pytest.raises(UsageError):
        artifact("results", "drafter", name)
    with pytest.raises(UsageError):
        find_target("results", name)


@pytest.mark.parametrize("label", ["a\nb", "a\tb", "", "a" * 2000])
def test_a_label_is_one_line(label):
    with pytest.raises(UsageError):
        check_label(label)


def test_advice_names_a_study_by_its_file_and_another_file_does_not_replace_it(tmp_path, monkeypatch, quick_report):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder, horizon in (here, 3), (there, 2):
        folder.mkdir()
        common = f"policy.target=mt10-state task=reach episodes=1 world.horizon={horizon} record=0"
        lines = ["name: mine", "baseline: ar", f"common: {common}", "settings:", "  ar: method=ar", ""]
        (folder / "abl.yaml").write_text("\n".join(lines))
    monkeypatch.chdir(here)
    words, where = ("sweep", "study=abl.yaml"), f"results={here / 'results'}"
    first = told(*words)
    assert "1 run, 0 reused, 0 failed" in first
    assert re.search(r"1 episode in \d+\.\d min: \d+ per minute", first)
    monkeypatch.chdir(there)
    advice = how_to_run(Study(opened(here / "results"), "mine"))
    assert advice == f"run `kerv sweep study={here}/abl.yaml {where}`"
    assert f"study={there}/abl.yaml would replace study 'mine' of {here}/abl.yaml" in refusal(*words, where)
    assert "1 run, 0 reused, 0 failed" in told(*words, where, "study.name=other")
    assert "0 run, 1 reused, 0 failed" in told(*advice.strip("run `").split()[1:])
    (here / "abl.yaml").unlink()  # it was moved
    assert "0 run, 1 reused, 0 failed" in told(*words, where)
