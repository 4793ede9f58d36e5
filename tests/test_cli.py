"""The command line as a user meets it: output, exit codes, and one line for every mistake."""

import importlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from command import kerv, process, refusal

from kerv_cli.base import registry
from kerv_cli.base.config import groups
from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import NoSettings, parts
from kerv_cli.cli.command import Command
from kerv_cli.cli.common import one_line_errors

pytestmark = pytest.mark.usefixtures("quick_report")

INVOKE = "from typer.testing import CliRunner; from kerv_cli.cli.app import app; CliRunner().invoke(app, "
FAST = ["world.horizon=8", "record=0"]


LOADS = f"""
import sys

def loads(heavy, by=""):
    if found := set(heavy.split()) & set(sys.modules):
        sys.exit(f"loaded: {{found}} {{by}}")

import kerv_cli
loads("torch numpy pandas mujoco typer")
from kerv_cli.base.registry import parts
parts("proposer")
loads("torch mujoco numpy pyarrow hydra pydantic")
{INVOKE}["train", "drafter", "--help"])
loads("torch numpy hydra pydantic")
{INVOKE}["rollout", "nonsense.key=1"])
{INVOKE}["sweep", "study=demo", "nonsense.key=1"])
loads("torch numpy pydantic pandas mujoco rerun")
from kerv_cli.cli.command import Command
for name in Command.every():
    for words in ("--help", "--cfg", "nonsense.key=1"):
        CliRunner().invoke(app, [*name.split(), words])
        loads("torch mujoco pandas sqlalchemy", by=f"kerv {{name}} {{words}}")
words = ["study=main", "episodes=1", "runtime.device=cpu", "results=" + sys.argv[1]]
plan = CliRunner().invoke(app, ["sweep", *words, "--plan"])
assert "140 episodes to run" in plan.output, plan.output
loads("torch mujoco pandas rerun", by="a plan")
import kerv_cli.board.app, kerv_cli.report.report
loads("rerun")
"""


def test_nothing_heavy_is_imported_before_it_is_needed(tmp_path):
    run = process("-c", LOADS, str(tmp_path), KERV_PLUGINS="")
    assert run.returncode == 0, run.stderr


def test_help_lists_first_what_a_newcomer_needs_then_what_makes_things():
    listed = re.findall(r"^  (\w+)  ", kerv("--help").stdout.partition("\nCommands:\n")[2], re.MULTILINE)
    first, making = "doctor rollout sweep report board view", "demos train prepare build calibrate"
    assert " ".join(listed[:11]) == f"{first} {making}"
    assert {"runs", "serve", "bench"} <= {*listed[11:]}


@pytest.mark.parametrize(
    ("words", "most", "times"),
    [("--help", 0.4, 6), ("rollout --help", 0.4, 9), ("rollout thresold.r=3", 0.6, 14)],
)
def test_help_and_mistakes_are_fast(words, most, times, tmp_path):
    def seconds(*command):
        """Of the processor."""
        began, surroundings = os.times(), {**os.environ, "KERV_PLUGINS": ""}
        subprocess.run([sys.executable, *command], capture_output=True, check=False, env=surroundings, cwd=tmp_path)
        ended = os.times()
        return ended.children_user + ended.children_system - began.children_user - began.children_system

    run = "import sys; sys.argv[0] = 'kerv'; from kerv_cli.__main__ import main; main()"
    asked = ("-W", "ignore", "-c", run, *words.split())
    if seconds(*asked) > most:  # a loaded machine is judged against the import of typer alone
        typer = min(seconds("-c", "import typer") for _ in range(3))
        assert any(seconds(*asked) < max(most, times * typer) for _ in range(5))


def test_every_command_is_found_by_its_first_word():
    """Only the file of that word is imported when a command is typed."""
    files = registry.MODULES["command"]
    for name, part in parts("command").items():
        file = f"kerv_cli.cli.{name.split()[0]}"
        assert part.module not in files or part.module == file or file not in files


def test_no_graphics_gets_the_command_that_brings_them(results):
    words = ("rollout", "task=reach-v3", *FAST, f"results={results}", "policy.target=nano-vision")
    run = process("-m", "kerv_cli", *words, MUJOCO_GL="glfw", DISPLAY="")
    assert run.returncode == 1, run.stderr
    (line,) = [line for line in run.stderr.splitlines() if line.startswith("kerv: ")]
    assert "MUJOCO_GL" in line or "apt-get install" in line


def test_rollout_prints_figures_and_writes_a_recording(results):
    words = ["method=spec_vla", "task=drawer-open", "episodes=1", "world.horizon=10", "policy.target=nano-vision"]
    run = kerv("rollout", *words, f"results={results}")
    for word in ("success", "forwards per step", "tokens per verification", "time per step, ms", "time by phase"):
        assert word in run.stdout
    (recording,) = results.glob("rollouts/*-spec_vla/rollouts/spec_vla-drawer-open-v3-100000-*.rrd")
    assert recording.stat().st_size > 10_000


def test_typer_completes_commands():
    asked = {"COMP_WORDS": "kerv ro", "COMP_CWORD": "1", "_KERV_COMPLETE": "complete_bash"}
    be_kerv = "import sys; sys.argv[0] = 'kerv'; from kerv_cli.__main__ import main; main()"
    assert process("-c", be_kerv, **asked).stdout.split() == ["rollout"]


COMMANDS = [part for part in Command.every().values() if part.module.startswith("kerv_cli.")]


@pytest.mark.parametrize("part", COMMANDS, ids=lambda part: part.name)
def test_the_help_of_a_command_shows_its_settings_and_two_examples_that_compose(part):
    shown = kerv(*part.name.split(), "--help")
    keys = part.shown
    assert len(keys) <= 10
    assert all(f"  {key}=" in shown.stdout for key in keys)
    assert len(part.examples) == 2
    for line in part.examples:
        assert f"  {line}\n" in shown.stdout
        words = [word for word in shlex.split(line)[1:] if not word.startswith("-")]
        kerv(*words, *([] if part.settings is NoSettings else [*["-m"][: "-m" in line], "--cfg"]))


def test_a_sweep_without_a_study_lists_the_studies_with_their_sizes(tmp_path):
    shown = kerv("sweep", f"results={tmp_path}")
    assert re.search(r"\bdemo +│( +\d+ +│){4} README's table", shown.stdout)
    assert list(tmp_path.iterdir()) == []
    listed = {row["study"]: row for row in json.loads(kerv("sweep", "--json").stdout)}
    assert set(listed) == set(groups()["study"])
    assert listed["stress"]["settings"] == 65


def test_a_command_from_a_plugin_is_one_like_any_other(tmp_path, monkeypatch):
    """docs/extending.md: tests/examples/own_command.py."""
    path = os.pathsep.join([str(Path(__file__).parent / "examples"), os.environ.get("PYTHONPATH", "")])
    listed = process("-m", "kerv_cli", "--help", PYTHONPATH=path, KERV_PLUGINS="own_command")
    assert "  seeds      Print the seeds of a task's episodes\n" in listed.stdout
    monkeypatch.setattr(registry, "_PARTS", {kind: dict(parts(kind)) for kind in registry.kinds()})
    monkeypatch.delitem(sys.modules, "examples.own_command", raising=False)
    importlib.import_module("examples.own_command")
    shown = kerv("seeds", "--help").stdout
    assert "  episodes=3      int: seeds per task\n" in shown
    assert "  kerv seeds task=reach\n" in shown
    assert "episodes: 5  # seeds per task\n" in kerv("seeds", "episodes=5", "--cfg").stdout
    results = f"results={tmp_path}"
    assert json.loads(kerv("seeds", "task=reach", "episodes=1", results, "--json").stdout) == {"reach-v3": [100000]}
    assert refusal("seeds", "episodes=0", code=2) == "kerv: episodes=0: from 1 to 100"
    assert refusal("seeds", "uses=x", code=2).startswith("kerv: unknown key 'uses': did you mean use")


def test_what_has_no_effect_is_said_in_one_line(policies):
    words = ["policy=state", "policy.target=nano-state", f"results={policies}", "task=reach", "episodes=2", *FAST]
    run = kerv("rollout", "--plan", "method=ar", "acceptance=relaxed", *words)
    note, announcement = run.stderr.splitlines()
    assert note == "note: acceptance=relaxed has no effect: method ar drafts nothing"
    assert announcement == "ar acceptance=relaxed of nano-state on reach-v3: 2 episodes"


@pytest.mark.parametrize(("number", "late"), [(signal.SIGINT, False), (signal.SIGTERM, False), (signal.SIGTERM, True)])
def test_an_interrupted_command_says_so_in_one_line(number, late, results):
    words = ["rollout", "task=reach", "episodes=50", "policy.target=nano-vision", f"results={results}"]
    # as early as there is a process of ours: the line says that it is
    code = "import kerv_cli.__main__ as it; print(flush=True); it.main()"
    begun = subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    begun.stdout.readline()
    if late:
        assert begun.stderr.readline() == "ar of nano-vision on reach-v3: 50 episodes\n"
    time.sleep(0.2)
    begun.send_signal(number)
    _, errors = begun.communicate(timeout=120)
    assert begun.returncode == 130, errors
    # a signal may wait for the end of an import: any number of lines of progress may come before
    *before, last = errors.splitlines()
    assert re.fullmatch(
        r"kerv: interrupted(: \d+ of 50 episodes of \S+ are kept: run the same command to resume)?", last
    )
    assert [
        one
        for one in before
        if not re.match(r"ar of |the load |compiling |preparing |episodes |\d+/50 |50 to run", one)
    ] == []


def test_closed_output_is_no_error(policies):
    words = [sys.executable, "-m", "kerv_cli", "runs", "list", f"results={policies}"]
    run = subprocess.run(words, preexec_fn=lambda: os.close(1), stderr=subprocess.PIPE, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


def test_an_interrupt_that_a_library_made_another_error_of_is_an_interrupt(capsys, monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # which an interrupt changes

    def compose():
        try:
            try:
                raise KeyboardInterrupt
            finally:
                raise AttributeError("'NoneType' object has no attribute '_invalidate_flags_cache'")
        except AttributeError as error:
            raise UsageError("defaults: what nobody typed") from error

    with pytest.raises(typer.Exit) as ended, one_line_errors([]):
        compose()
    assert ended.value.exit_code == 130
    assert capsys.readouterr().err == "kerv: interrupted\n"


def test_the_question_of_runs_rm_ends_in_one_line(policies):
    run = kerv("runs", "rm", "target/nano-state", f"results={policies}", code=130)  # nobody answers
    assert run.stderr.splitlines()[-1] == "kerv: nothing is removed; --yes asks no question"
    assert (policies / "artifacts/target/nano-state").is_dir()


# --- mistakes

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
    "part.yaml": "# a comment\nproposer: draftr\n",
    "hydra.yaml": "defaults:\n  - override /proposer: drafter\n",
    "range.yaml": "boundary: fused\nboundary.f_star: 25\n",
    "key.yaml": "acceptance: relaxed\nthreshold:\n  radius: 5\n",
    "type.yaml": "threshold:\n  r: wide\n",
    "nul.yaml": "title: a\0b\n",
    "file": "x",
    "one.rrd": "x",
}

ANSWERS = [
    # commands and options
    ("rolout method=ar", "unknown command 'rolout': did you mean rollout?"),
    ("train targt", "unknown train command 'targt': did you mean target?"),
    ("rollout --task=reach", "settings have no dashes: task=reach"),
    ("rollout --method kerv", "settings have no dashes: method=VALUE"),
    ("runs export --dir", "Option '--dir' requires an argument"),
    # lists, empty values
    ("rollout reach", "'reach' is not an override: write key=value"),
    ("rollout task=reach, push", "write a list without spaces, task=[reach,push]"),
    ("rollout results=~/runs", "quote the value: \"results='~/runs'\""),
    ("rollout results=", "results= is empty: write a value, or leave it out"),
    ("rollout task=", "task= is empty: name a task or a suite, or leave it out"),
    (
        "rollout threshold.r=3,9",
        "threshold.r=3,9: several values need -m, as in 'kerv rollout -m threshold.r=3,9'; a list is",
    ),
    # unknown keys and names
    ("rollout nonsense=3", "unknown key 'nonsense': see 'kerv rollout --cfg' for the keys"),
    ("rollout device=cuda", "unknown key 'device': did you mean runtime.device?"),
    ("rollout task=reach-v2", "unknown task or suite 'reach-v2': did you mean reach-v3"),
    # values
    (
        "rollout episodes=1e400",
        "episodes: Value 'inf' of type 'float' could not be converted to Integer",
    ),
    ("rollout world.stress.level=9", "world.stress.level=9: from 0 to 4"),
    ("demos episodes=10 seed=100000", "seed 100000 is for evaluation; seeds for training are 0 to 49999"),
    ("rollout method=spec_vla boundary.f_star=0.3", "unknown key 'boundary.f_star'"),
    ("rollout -m method=spec_vla,kerv threshold.r=5", "method=kerv: unknown key 'threshold.r'"),
    ("rollout episodes=3 episodes=4", "episodes is given twice"),
    ("rollout runtime.device=tpu", "runtime.device=tpu: known are cpu, cuda"),
    ("demos task=reach runtime.device=tpu --plan", "runtime.device=tpu: known are cpu, cuda"),
    # methods
    ("rollout method=part.yaml", "part.yaml:2: unknown proposer 'draftr': did you mean drafter"),
    ("rollout method=range.yaml", "range.yaml:2: boundary.f_star=25.0: from 0 to 1"),
    ("rollout method=key.yaml", "key.yaml:3: unknown key 'threshold.radius'"),
    (
        "rollout method=hydra.yaml",
        "hydra.yaml:1: a method's file has no defaults: write PART: NAME",
    ),
    ("rollout method=type.yaml", "type.yaml:2: threshold.r: Value 'wide' of type 'str'"),
    ("rollout proposer.kind=drafter", "proposer.kind=drafter: choose proposer=drafter, each has settings of its own"),
    # what is not there
    ("rollout policy.target=../../etc", "name a folder that holds target.json"),
    ("demos import source=file", "file is a file: name the folder of a LeRobot dataset"),
    ("rollout results=file", "results=file is a file: name a folder"),
    ("view nothing.rrd", "nothing.rrd does not exist or is no recording"),
    ("report study=main", "results/kerv.db: run `kerv sweep study=main`"),
    ("report on=h100", "on=h100: name the study with study=NAME"),
    ("runs rm", "name a run: 'kerv runs list' shows them"),
    # studies
    ("sweep study=typo.yaml", "typo.yaml:1: unknown key 'study.setings': did you mean study.settings"),
    ("sweep study=no_baseline.yaml", "or name one of these by study.baseline=: "),
    ("sweep study=empty.yaml", "study 'empty' has no settings: see conf/study/demo.yaml"),
    ("sweep study=list.yaml", "study=list.yaml holds no keys: write key: value"),
    ("sweep study=tabs.yaml", "tabs.yaml:2: it is not YAML"),
    ("sweep study=nul.yaml", "nul.yaml: it is not YAML, unacceptable character #x0000"),
    ("sweep study=radius.yaml", "radius.yaml:3: unknown key 'threshold.radius': did you mean threshold"),
    ("sweep study=nested.yaml", "nested.yaml:1: study.settings={'ar': {'method': 'ar'}}: every element must be"),
    ("sweep study=axis.yaml", "axis.yaml:1: unknown axis 'threshold.rr': did you mean threshold.r?"),
    ("sweep study=twice.yaml", "twice.yaml:3: settings.ar is given twice, also in line 2"),
    ("sweep study=demo method=ar", "study 'demo' sets method itself: leave it out"),
    ("sweep threshold.r=1,2,3", "of which study? name one, study=NAME: 'kerv sweep' lists them; 'kerv rollout -m'"),
    # artifacts and policies
    ("serve method=heisd", "its calibration or drafts differ between tasks: name one with task=NAME"),
    ("serve method=spec_vla proposer=retrieval task=rech", "unknown task 'rech': did you mean reach-v3?"),
    ("serve policy=expert", "policy=expert: it needs the simulator and cannot be served"),
    ("prepare policy=parallel", "decodes all tokens at once"),
    ("train drafter drafter=erly", "unknown drafter 'erly': did you mean early"),
    ("bench target=vla-15m", "did you mean vla-150m"),
    ("bench projections.mine=[1]", "GB/s and TFLOP/s"),
    ("serve port=70000", "port=70000"),
]
"""A line as typed -> what its answer says."""


@pytest.mark.parametrize(("line", "says"), ANSWERS)
def test_a_mistake_is_answered_in_one_line(line, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    assert says in refusal(*shlex.split(line), code=2)
