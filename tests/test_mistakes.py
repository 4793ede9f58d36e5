"""Bad input gets one line that says what is wrong, where, and what to type."""

import shlex

import pytest
from test_cli import kerv, one_line

FILES = {
    "typo.yaml": "setings:\n  ar: method=ar\n",
    "no_baseline.yaml": "settings:\n  kerv: method=kerv\n",
    "empty.yaml": "title: Empty\n",
    "list.yaml": "- ar\n- kerv\n",
    "tabs.yaml": "title: x\n\tsettings: y\n",
    "radius.yaml": "settings:\n  ar: method=ar\n  a: method=spec_vla threshold.radius=3\n",
    "nested.yaml": "settings:\n  ar:\n    method: ar\n",
    "axis.yaml": "axis: threshold.rr\nsettings:\n  ar: method=ar\n  a: method=spec_vla threshold.r=3,9\n",
    "twice.yaml": "settings:\n  ar: method=ar\n  ar: method=kerv\n",
    "common.yaml": "common: epsodes=3\nsettings:\n  ar: method=ar\n",
    "part.yaml": "# a comment\ndefaults:\n  - override /proposer: draftr\n",
    "range.yaml": "defaults:\n  - override /boundary: fused\nboundary:\n  f_star: 25\n",
    "key.yaml": "defaults:\n  - override /acceptance: relaxed\nthreshold:\n  radius: 5\n",
    "type.yaml": "threshold:\n  r: wide\n",
    "file": "x",
    "one.rrd": "x",
}

ANSWERS = [
    # commands and options
    ("rolout method=ar", "unknown command 'rolout': did you mean rollout?"),
    ("train targt", "unknown train command 'targt': did you mean target?"),
    ("rollout --task=reach", "settings have no dashes: task=reach"),
    ("rollout --method kerv", "settings have no dashes: method=VALUE"),
    ("rollout --paln", "No such option: --paln (Possible options: --plan)"),
    ("runs export --to", "Option '--to' requires an argument"),
    # lists, empty values
    ("rollout reach", "'reach' is not an override: write key=value"),
    ("rollout task=reach, push", "write a list without spaces, task=[reach,push]"),
    ("rollout task=[reach, push]", "write a list without spaces, task=[reach,push]"),
    ("rollout task=[reach", "cannot read 'task=[reach': write a list without spaces"),
    ("rollout results=~/runs", "quote the value: \"results='~/runs'\""),
    ("rollout results=", "results= is empty: write a value, or leave it out"),
    ("rollout task=", "task= is empty: name a task or a suite, or leave it out"),
    ("bench tokens=7,16", "tokens=7,16: several values need 'kerv rollout -m'; as a list write tokens=[7,16]"),
    # unknown keys and names
    ("rollout nonsense=3", "unknown key 'nonsense': see 'kerv rollout --cfg' for the keys"),
    ("rollout device=cuda", "unknown key 'device': did you mean runtime.device?"),
    ("rollout target=small", "unknown key 'target': did you mean policy.target?"),
    ("runs list kindd=x", "unknown key 'kindd': did you mean kind?"),
    ("rollout task=reach-v2", "unknown task or suite 'reach-v2': did you mean reach-v3"),
    ("rollout task=mt11", "unknown task or suite 'mt11': did you mean MT10"),
    ("train target target=smal", "unknown target 'smal': did you mean small"),
    ("sweep study=treshold", "unknown study 'treshold': did you mean threshold"),
    ("rollout method=AR", "unknown method 'AR': did you mean ar?"),
    ("prepare for=kervv", "unknown method 'kervv': did you mean kerv"),
    ("rollout rollout.clock=reel", "unknown rollout.clock 'reel': did you mean real?"),
    ("runs list state=finished", "unknown state 'finished': known: complete, begun, damaged, step"),
    # values
    ("rollout episodes=1e400", "episodes: Value 'inf' of type 'float' could not be converted to Integer"),
    ("rollout world.stress=push", "world.stress: Invalid type assigned"),
    ("rollout world.stress.level=9", "world.stress.level=9: from 0 to 4"),
    ("calibrate success margin=200", "margin=200.0: above 0, at most 99.9"),
    ("serve port=99999", "port=99999: from 0 to 65535"),
    ("demos episodes=10 seed=100000", "seed 100000 is for evaluation; seeds for training are 0 to 49999"),
    ("runs list since=yesterday", "since=yesterday is not a date: write 2026-11-23"),
    ("rollout method=heisd boundary.f_star=25", "boundary.f_star=25.0: from 0 to 1"),
    ("rollout method=spec_vla boundary.f_star=0.3", "unknown key 'boundary.f_star'"),
    ("rollout episodes=3 episodes=4", "episodes is given twice"),
    ("rollout seed=5", "seed=5 is a training seed"),
    ("rollout threshold.r=900 method=spec_vla", "threshold.r=900"),
    ("rollout runtime.device=tpu", "runtime.device=tpu: known are cpu, cuda"),
    # methods
    ("rollout method=part.yaml", "part.yaml:3: unknown proposer 'draftr': did you mean drafter"),
    ("rollout method=range.yaml", "range.yaml:4: boundary.f_star=25.0: from 0 to 1"),
    ("rollout method=key.yaml", "key.yaml:4: unknown key 'threshold.radius'"),
    ("rollout method=type.yaml", "type.yaml:2: threshold.r: Value 'wide' of type 'str'"),
    ("rollout method=list.yaml", "method=list.yaml holds no keys"),
    ("rollout method=nothing.yaml", "method=nothing.yaml cannot be read: No such file"),
    # what is not there
    ("rollout policy.target=mine", "no target 'mine' in results/artifacts/target/mine"),
    ("demos import source=file", "file is a file: name the folder of a LeRobot dataset"),
    ("rollout results=file", "results=file is a file: name a folder"),
    ("view nothing.rrd", "nothing.rrd does not exist or is no recording"),
    ("report study=main", "results/kerv.db: run `kerv sweep study=main`"),
    ("report on=h100", "on=h100: name the study to price with study=NAME"),
    ("runs compare a", "name two runs, ID or ID:SETTING: 'kerv runs list' shows them"),
    ("runs rm", "name a run: 'kerv runs list' shows them"),
    ("build drafter", "checkpoint=DIR: name the folder of a drafter"),
    # studies
    ("sweep study=typo.yaml", "typo.yaml:1: unknown key 'study.setings': did you mean study.settings"),
    ("sweep study=no_baseline.yaml", "study 'no_baseline' has no setting 'ar', the baseline that its others are"),
    ("sweep study=empty.yaml", "study 'empty' has no settings: see conf/study/demo.yaml"),
    ("sweep study=list.yaml", "study=list.yaml holds no keys: write key: value"),
    ("sweep study=tabs.yaml", "tabs.yaml:2: it is not YAML"),
    ("sweep study=radius.yaml", "radius.yaml:3: unknown key 'threshold.radius': did you mean threshold"),
    ("sweep study=nested.yaml", "nested.yaml:1: study.settings={'ar': {'method': 'ar'}}: every element must be"),
    ("sweep study=axis.yaml", "axis.yaml:1: unknown axis 'threshold.rr': did you mean threshold.r?"),
    ("sweep study=twice.yaml", "twice.yaml:3: settings.ar is given twice, also in line 2"),
    ("sweep study=common.yaml", "common.yaml:1: unknown key 'epsodes': did you mean episodes?"),
    ("sweep study=main thresold.r=3", "kerv: unknown key 'thresold.r': did you mean threshold.r"),
    ("sweep study=nothing.yml", "study=nothing.yml cannot be read: No such file"),
    ("sweep study=demo method=ar", "study 'demo' sets method itself: leave it out"),
    ("sweep threshold.r=1,2,3", "of which study? name one, study=NAME: 'kerv sweep' lists them; 'kerv rollout -m'"),
    # artifacts and policies
    (
        "calibrate success",
        "is there, as a part of a shipped policy: policy.artifacts.certificate=NAME makes one of yours",
    ),
    ("serve method=heisd", "its calibration or drafts differ between tasks: name one with task=NAME"),
    ("serve method=spec_vla proposer=retrieval task=rech", "unknown task 'rech': did you mean reach-v3?"),
    ("serve policy=expert", "policy=expert: it needs the simulator and cannot be served"),
    ("demos policy=vision policy.target=nope task=reach", "train it with 'kerv train target name=nope'"),
]
"""A line as typed -> what its answer says."""


@pytest.mark.parametrize(("line", "says"), ANSWERS)
def test_a_mistake_is_answered_in_one_line(line, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    assert says in one_line(kerv(*shlex.split(line)), 2)
