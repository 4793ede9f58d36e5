"""What somebody mistypes gets one line that says what is meant; the line that it names works when typed."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from test_cli import kerv, one_line

FILES = {
    "typo.yaml": "setings:\n  ar: method=ar\n",
    "no_baseline.yaml": "settings:\n  kerv: method=kerv\n",
    "empty.yaml": "title: Empty\n",
    "list.yaml": "- ar\n- kerv\n",
    "tabs.yaml": "title: x\n\tsettings: y\n",
    "commas.yaml": "settings:\n  ar: method=ar\n  a: method=spec_vla, threshold.r=3\n",
    "radius.yaml": "settings:\n  ar: method=ar\n  a: method=spec_vla threshold.radius=3\n",
    "nested.yaml": "settings:\n  ar:\n    method: ar\n",
    "file": "x",
    "one.rrd": "x",
}

ANSWERS = [
    # where a word stands
    ("method=ar rollout", "settings follow the command: kerv rollout method=ar"),
    ("method=ar", "settings follow the command: kerv COMMAND method=ar"),
    ("train demos=mt10", "kerv train COMMAND demos=mt10, COMMAND is target or drafter"),
    ("kerv rollout", "kerv stands twice in this line"),
    ("help rollout", "did you mean 'kerv rollout --help'?"),
    ("version", "did you mean 'kerv --version'?"),
    # commands
    ("rolout method=ar", "unknown command 'rolout': did you mean rollout?"),
    ("Rollout method=ar", "unknown command 'Rollout': did you mean rollout?"),
    ("roll-out method=ar", "unknown command 'roll-out': did you mean rollout?"),
    ("run method=ar", "unknown command 'run': did you mean rollout?"),
    ("train.target name=x", "unknown command 'train.target': did you mean train target?"),
    ("train targt", "unknown train command 'targt': did you mean target?"),
    ("build datastor demos=mt10", "unknown build command 'datastor': did you mean datastore?"),
    ("list", "unknown command 'list': did you mean runs list?"),
    ("compare a b", "unknown command 'compare': did you mean runs compare?"),
    ("export last", "unknown command 'export': did you mean demos export or runs export?"),
    ("runs delete x", "unknown runs command 'delete': did you mean rm?"),
    ("completion powershell", "unknown shell 'powershell': known: bash, zsh, fish"),
    # options
    ("rollout --paln", "No such option: --paln: did you mean --plan?"),
    ("rollout --dry-run", "No such option: --dry-run: did you mean --plan?"),
    ("doctor --fix", "No such option: --fix: did you mean --repair?"),
    ("sweep study=demo --resume", "No such option: --resume: leave it out, the same command goes on"),
    ("view --to", "Option '--to' requires an argument: Write a film of one recording: FILE.mp4 or FILE.gif."),
    ("view --together one.rrd", "--together shows two recordings, not 1: name two .rrd files"),
    ("runs show --json=true", "Option '--json' does not take a value: Print the result as JSON"),
    # what is not there
    ("rollout policy.target=mine", "no target 'mine' in results/artifacts/target/mine"),
    ("demos import source=file", "file is a file: name the folder of a LeRobot dataset"),
    ("rollout episodes=1e400", "episodes=1e400: a whole number, e.g. episodes=3"),
    ("runs list state=finished", "unknown state 'finished': known: complete, begun, damaged, step"),
    ("rollout --gpu 0", "settings have no dashes: runtime.device=cuda"),
    ("prepare for=all", "(without for= it is all of them)"),
    ("calibrate task=all", "unknown task or suite 'all'"),
    ("runs list since=yesterday", "since=yesterday is no date: write 2026-11-23"),
    ("rollout results=file", "results=file is a file: name a folder"),
    ("view nothing.rrd", "nothing.rrd does not exist: name a recording (.rrd) or a folder of them"),
    ("view file", "file is not a recording: its name does not end in .rrd"),
    ("report study=main", "no study 'main' in results/studies: run `kerv sweep study=main`"),
    ("runs compare a", "name two runs, ID or ID:SETTING: 'kerv runs list' shows them"),
    ("runs rm", "name a run: 'kerv runs list' shows them"),
    ("runs list kind", "'kind' is no filter: write kind=, method=, task=, state= or since="),
    ("build drafter", "checkpoint=DIR: name the folder of a drafter"),
    # studies
    ("sweep study=demo study=main", "study= is given twice, demo and main: leave one out"),
    ("sweep study=typo.yaml study=main", "study= is given twice, typo.yaml and main: leave one out"),
    ("sweep study=typo.yaml", "unknown key in study=typo.yaml: 'setings': did you mean settings?"),
    ("sweep study=no_baseline.yaml", "study 'no_baseline' has no setting 'ar', the baseline that its others are"),
    ("sweep study=empty.yaml", "study 'empty' has no settings: see conf/study/demo.yaml"),
    ("sweep study=list.yaml", "study=list.yaml is no study: it needs the key settings"),
    ("sweep study=tabs.yaml", "study=tabs.yaml cannot be read: it is not YAML"),
    ("sweep study=commas.yaml", "cannot read 'method=spec_vla,': write method=spec_vla"),
    ("sweep study=radius.yaml", "unknown key 'threshold.radius': did you mean threshold.r=3"),
    ("sweep study=nested.yaml", "nested.yaml is no study: settings.ar: input should be a valid string"),
    ("sweep study=nothing.yml", "study=nothing.yml cannot be read: No such file"),
    ("sweep study=folder/", "study=folder/ is no YAML file: name one that ends in .yaml"),
    ("sweep study=demo method=ar", "study 'demo' sets method itself: leave it out"),
    ("sweep study=demo,threshold", "study=demo,threshold names 2 choices: this command takes one"),
    ("sweep study=demo study.baseline=AR", "study 'demo' has no setting 'AR', the baseline"),
    ("calibrate success", "is there, as a part of a shipped policy: policy.certificate=NAME makes one of yours"),
    ("train drafter drafter=early", "is there, as a part of a shipped policy: policy.early=NAME makes one of yours"),
    ("serve method=heisd", "its levels or drafts differ between tasks: name one with task=NAME"),
    ("serve method=spec_vla proposer=retrieval task=rech", "unknown task 'rech': did you mean reach-v3?"),
    ("serve policy=expert", "policy=expert: it acts in the simulator's worlds and cannot be served"),
    ("demos policy=vision policy.target=nope task=reach", "train it with 'kerv train target name=nope'"),
    ("sweep threshold.r=1,2,3", "of which study? name one, study=NAME: 'kerv sweep' lists them; 'kerv rollout -m'"),
    ("report study=demo,main", "study=demo,main holds several values: this command takes one"),
    ("report on=h100", "on=h100: name the study whose decodes are to be priced, study=NAME"),
    # names and values
    ("rollout policy=mine", "state, state_h8, vision, vision_h8 (policy.target=mine names weights)"),
    ("train drafter target=mine", "vla-150m (policy.target=mine names weights)"),
    ("rollout method=ar,kerv", "method=ar,kerv names 2 choices: -m runs each in turn"),
    ("rollout threshold.r=1,2 method=spec_vla", "holds several values: -m runs each in turn"),
    ("rollout method=kerv method=ar", "method= is given twice, kerv and ar: leave one out"),
    ("prepare for=kervv", "unknown method 'kervv': did you mean kerv"),
    ("rollout task=", "name at least one task or suite: task=NAME, or leave it out"),
    ("rollout task=reach-v2", "unknown task or suite 'reach-v2': did you mean reach-v3"),
    ("rollout task='reach push'", "unknown task or suite 'reach push': did you mean reach-v3 or push-v3?"),
    ("rollout task=mt11", "unknown task or suite 'mt11': did you mean MT10?"),
    ("rollout rollout.clock=reel", "unknown rollout.clock 'reel': did you mean real?"),
    ("rollout world.stress.level=9", "world.stress.level=9: from 0 to 4"),
    ("calibrate epsilon=5%", "epsilon=5%: a number, e.g. epsilon=0.1 (verify-skip: mean abs error"),
    ("calibrate success margin=200", "margin=200.0: above 0, at most 99.9"),
    ("serve port=99999", "port=99999: from 0 to 65535"),
    ("demos episodes=10 seed=100000", "seed 100000 is for evaluation; seeds for training are 0 to 49999"),
    ("rollout lr=3", "unknown key 'lr': a setting of 'kerv train drafter', 'kerv train target'"),
    ("rollout until=decided", "unknown key 'until': a setting of 'kerv calibrate success', 'kerv sweep'"),
]
"""A line as typed -> what its answer says."""

MENDS = [
    # spaces, quotes, brackets
    ("rollout reach", "task=reach"),
    ("rollout episodes 5", "episodes=5"),
    ("rollout episodes = 5", "episodes=5"),
    ("rollout episode: 2", "episodes="),
    ("rollout method: ar", "method=ar"),
    ("rollout method:ar", "method=ar"),
    ("rollout 'method = ar'", "method=ar"),
    ("rollout task=reach, push", "task=[reach,push]"),
    ("rollout task=reach push", "task=[reach,push]"),
    ("rollout 'task=reach;push'", "task=[reach,push]"),
    ("rollout task=reach,", "task=reach"),
    ("rollout task=[reach", "task=reach"),
    ("rollout 'episodes=3 task=reach'", "episodes=3 task=reach"),
    ("rollout 'episodes=3, task=reach'", "episodes=3 task=reach"),
    ("rollout results=~/runs", "\"results='~/runs'\""),
    ("sweep demo", "study=demo"),
    ("sweep study demo", "study=demo"),
    ("bench tokens=7,16", "tokens=[7,16]"),
    ("build datastore key=scene", "key=[scene]"),
    # a key's name, and what other programs call it
    ("rollout Method=ar", "method=ar"),
    ("rollout device=cuda", "runtime.device=cuda"),
    ("rollout workers=4", "runtime.workers=4"),
    ("rollout checkpoint=model", "policy.target=model"),
    ("rollout max_steps=20", "world.horizon=20"),
    ("demos n=5", "episodes=5"),
    ("view result=folder", "results=folder"),
    # dashes
    ("rollout --task reach", "task=reach"),
    ("rollout --method=kerv", "method=kerv"),
    ("rollout -method ar", "method=ar"),
    ("rollout -n 5", "episodes=5"),
    ("sweep study=demo --workers 2", "runtime.workers=2"),
    ("train target --epochs 3", "train.steps=3"),
    # values and units
    ("rollout method=AR", "ar"),
    ("rollout episodes=2.5", "episodes=2"),
    ("rollout episodes=three", "episodes=3"),
    ("rollout world.horizon=10s", "world.horizon=10"),
    ("rollout threshold.r=5deg", "threshold.r=5"),
    ("rollout rollout.latency_ms=20ms", "rollout.latency_ms=20"),
    ("rollout seed=100000..100010", "seed=100000"),
    ("rollout record=yes", "record=1"),
    ("train target train.steps=1e6", "train.steps=1000000"),
    ("train target train.bf16=maybe", "train.bf16=true"),
    ("rollout world.stress=push", "world.stress.kind=push"),
    # nothing behind the =
    ("rollout policy.target=", "policy.target=mt10-vision"),
    ("rollout results=", "results=results"),
    ("rollout method=", "method=ar"),
    ("rollout episodes=", "episodes=3"),
    ("sweep study=", "study=threshold"),
    ("serve host=", "host=127.0.0.1"),
]
"""A line as typed -> the settings that its answer names, which the same command takes."""


COMMANDS = ("rollout", "sweep", "train", "target", "demos", "build", "datastore", "bench", "view", "serve")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)


@pytest.mark.parametrize(("line", "says"), ANSWERS)
def test_a_mistake_is_answered_for_what_it_is(line: str, says: str) -> None:
    assert says in one_line(kerv(*shlex.split(line)), 2)


@pytest.mark.parametrize(("line", "mend"), MENDS)
def test_the_setting_that_an_answer_names_works(line: str, mend: str) -> None:
    assert mend in one_line(kerv(*shlex.split(line)), 2)
    names = [word for word in line.split() if word in COMMANDS]
    typed = mend if "=" in mend else f"method={mend}"
    more = ["study=demo"] if names == ["sweep"] and "study=" not in typed else []
    shown = kerv(*names, *more, *shlex.split(typed), "--cfg")
    assert shown.returncode == (0 if typed[-1] != "=" else 2), shown.stderr
