"""The command line as a user meets it: its output, its exit code; in a process of its own where that matters."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from kerv_cli.cli.app import app

FAST = ["episodes=2", "world.horizon=8", "record=0"]


def kerv(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in this process, which has loaded the libraries already."""
    run = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    return subprocess.CompletedProcess(arguments, run.exit_code, run.stdout, run.stderr)


def process(*arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
    """The command as a shell starts it."""
    command = [sys.executable, "-W", "ignore", "-m", "kerv_cli.cli.app", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, **env})


def one_line(run: subprocess.CompletedProcess[str], code: int) -> str:
    """The single line that a refusal consists of."""
    assert run.returncode == code, run.stdout + run.stderr
    assert "Traceback" not in run.stderr
    lines = [line for line in run.stderr.splitlines() if line.startswith("kerv: ")]
    assert len(lines) == 1, run.stderr
    return lines[0]


def test_help_lists_the_commands_without_importing_anything_heavy() -> None:
    heavy = "{'torch', 'mujoco', 'hydra', 'pandas', 'rerun'}"
    code = f"import sys, kerv_cli.cli.app; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
    run = process("--help")
    assert run.returncode == 0
    for command in ("demos", "train", "build", "calibrate", "rollout", "sweep", "report", "view", "doctor"):
        assert f"  {command} " in run.stdout


def test_help_is_fast() -> None:
    def seconds() -> float:
        began = time.perf_counter()
        process("--help")
        return time.perf_counter() - began

    python = min(_python_start() for _ in range(3))
    # half a second on an idle machine; a loaded one is judged against its own bare interpreter
    assert min(seconds() for _ in range(5)) < max(0.5, 12 * python)


def _python_start() -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "pass"], check=True)
    return time.perf_counter() - began


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("rollout", "task=drawer-opne"), "unknown task or suite 'drawer-opne': did you mean drawer-open"),
        (("rollout", "method=spec-vla"), "unknown method 'spec-vla': did you mean spec_vla"),
        (("rollout", "threshold.radius=3"), "unknown key 'threshold.radius'"),
        (("train", "target", "target=smal"), "unknown target 'smal': did you mean small"),
        (("rollout", "episodes=0"), "episodes=0: from 1 to"),
        (("rollout", "seed=5"), "seed=5 is a training seed"),
        (("rollout", "threshold.r=900", "method=spec_vla"), "threshold.r=900"),
        (("rollout", "runtime.threads=0"), "runtime.threads=0"),
        (("rollout", "runtime.device=tpu"), "runtime.device=tpu"),
        (("sweep", "study=treshold"), "unknown study 'treshold': did you mean threshold"),
    ],
)
def test_a_wrong_request_gets_one_line_and_exit_code_2(arguments: tuple[str, ...], says: str, policies: Path) -> None:
    policy = ["policy=state", "policy.target=nano-state"] if arguments[0] == "rollout" else []
    assert says in one_line(kerv(*arguments, *policy, f"results={policies}"), 2)


def test_what_is_missing_or_damaged_gets_one_line_and_exit_code_1(policies: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    shutil.copytree(policies, results)
    common = ["task=reach-v3", *FAST, f"results={results}"]
    assert "no target 'absent'" in one_line(kerv("rollout", *common, "policy.target=absent"), 2)
    weights = results / "artifacts/target/nano-state/model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-7])
    assert "does not match its description" in one_line(kerv("rollout", *common, "policy.target=nano-state"), 1)
    shutil.copytree(results / "artifacts/drafter/nano-state", results / "wrong")
    wrong = ["method=spec_vla", "policy.target=nano-vision", f"policy.drafter={results}/wrong"]
    assert "was trained for target" in one_line(kerv("rollout", *common, *wrong), 1)
    assert "demonstrations" in one_line(kerv("train", "target", "name=new", f"results={results}"), 1)


def test_an_empty_results_folder_says_what_to_run(tmp_path: Path) -> None:
    assert "kerv sweep" in one_line(kerv("report", f"results={tmp_path}"), 2)
    assert "kerv rollout" in one_line(kerv("view", f"results={tmp_path}"), 2)


def test_no_graphics_gets_the_command_that_brings_them(policies: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    shutil.copytree(policies, results)
    run = process(
        "rollout",
        "task=reach-v3",
        *FAST,
        f"results={results}",
        "policy.target=nano-vision",
        MUJOCO_GL="glfw",
        DISPLAY="",
    )
    assert "MUJOCO_GL" in one_line(run, 1) or "apt-get install" in one_line(run, 1)


def test_rollout_prints_figures_and_writes_a_recording(policies: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    shutil.copytree(policies, results)
    run = kerv(
        "rollout", "method=spec_vla", "task=drawer-open", "episodes=1", "world.horizon=10", "policy.target=nano-vision",
        f"results={results}",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    for word in ("success", "forwards/step", "AL", "ms/step", "time by phase", "kerv view"):
        assert word in run.stdout
    (recording,) = results.glob("rollouts/*-spec_vla/rollouts/spec_vla-drawer-open-v3-100000-*.rrd")
    assert recording.stat().st_size > 10_000
    seen = kerv("view", "--summary", str(recording))
    assert seen.returncode == 0, seen.stderr
    assert "drawer-open-v3" in seen.stdout


def test_sweep_resumes_and_report_writes_tables(policies: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    shutil.copytree(policies, results)
    study = tmp_path / "small.yaml"
    study.write_text(
        "title: Small\nbaseline: ar\naxis: threshold.r\n"
        "settings:\n  ar: method=ar\n  spec_vla: method=spec_vla threshold.r=0,20\n"
    )
    command = [
        "sweep",
        f"study={study}",
        "task=reach-v3",
        *FAST,
        "policy=state",
        "policy.target=nano-state",
        f"results={results}",
    ]
    plan = kerv(*command, "--plan")
    assert "3 cells to run, 0 reused" in plan.stdout, plan.stderr
    first = kerv(*command)
    assert first.returncode == 0, first.stderr
    assert "3 cells run, 0 reused, 0 failed" in first.stdout
    assert re.search(r"\d+ episodes in \d+\.\d min: \d+ per minute", first.stdout)
    cells = sorted((results / "studies/small/cells").iterdir())
    shutil.rmtree(cells[0])
    assert "1 cells run, 2 reused, 0 failed" in kerv(*command).stdout
    told = kerv("report", "study=small", f"results={results}")
    assert told.returncode == 0, told.stderr
    table = pd.read_csv(results / "report/tables/small.csv")
    assert set(table["averaging"]) == {"micro over tasks", "macro over difficulty groups"}
    assert {"ar", "spec_vla r=0", "spec_vla r=20"} <= set(table["label"])
    assert list((results / "report/plots").glob("small*.png"))


def test_cfg_prints_the_resolved_settings_and_loads_nothing() -> None:
    run = process("rollout", "method=spec_vla", "threshold.r=3", "--cfg")
    assert run.returncode == 0
    assert "kind: drafter" in run.stdout
    assert "  r: 3" in run.stdout


def test_completion_knows_groups_names_and_keys_of_the_command() -> None:
    from kerv_cli.cli.completing import completions

    assert "method=spec_vla" in completions("rollout", [], "method=s")
    assert completions("rollout", [], "me") == ["method="]
    assert "task=drawer-open-v3" in completions("rollout", [], "task=drawer")
    assert "threshold.r=" in completions("rollout", [], "threshold.")
    assert "threshold.k_s=" in completions("sweep", ["threshold=kinematic"], "threshold.")
    assert "threshold.r=" not in completions("rollout", ["threshold=kinematic"], "threshold.r")
    assert "train.lr=" in completions("train_target", [], "train.l")
    assert completions("train_target", [], "method") == []
    assert completions("demos", [], "prop") == []
    assert "study=demo" in completions("sweep", [], "study=d")
    assert completions("runs_list", [], "me") == []


def test_bash_completes_behind_an_equals_sign_without_a_start_up_file(tmp_path: Path) -> None:
    from kerv_cli.cli.completing import script

    (tmp_path / "kerv").write_text(f'#!/bin/sh\nexec {sys.executable} -W ignore -c "{BE_KERV}" "$@"\n')
    (tmp_path / "kerv").chmod(0o755)
    (tmp_path / "script").write_text(script("bash"))
    typed = "kerv rollout method=spec"
    body = f"source {tmp_path}/script; COMP_LINE='{typed}' COMP_POINT={len(typed)}; _kerv_completion kerv"
    command = ["bash", "--norc", "-c", f'{body}; printf "%s\\n" "${{COMPREPLY[@]}}"']
    path = f"{tmp_path}:{os.environ['PATH']}"
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PATH": path}, check=False)
    assert run.stdout.split() == ["spec_vla", "spec_vla_paper"], run.stderr


BE_KERV = "import sys; sys.argv[0] = 'kerv'; from kerv_cli.cli.app import main; main()"


def test_doctor_repair_removes_what_a_killed_command_left(tmp_path: Path) -> None:
    from test_leftovers import of_process

    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    left = of_process(tmp_path / "artifacts" / "drafter" / "a" / "drafter.json", child.pid)
    left.parent.mkdir(parents=True)
    left.touch()
    claims = tmp_path / "studies" / "main" / "claims"
    claims.mkdir(parents=True)
    (claims / "old.running").write_text("x")
    run = kerv("doctor", "--repair", f"results={tmp_path}")
    assert run.returncode == 0, run.stderr
    assert [line.split()[0] for line in run.stdout.splitlines()] == ["removed", "removed", "2"]
    assert not left.exists()
    assert list(claims.iterdir()) == []
    assert kerv("doctor", "--repair", f"results={tmp_path}").stdout.startswith("0 left over files")


def test_what_has_no_effect_is_said_in_one_line(policies: Path) -> None:
    words = ["policy=state", "policy.target=nano-state", f"results={policies}", "task=reach", *FAST]
    run = kerv("rollout", "--plan", "method=ar", "acceptance=relaxed", *words)
    assert run.returncode == 0
    assert run.stderr == "note: acceptance=relaxed has no effect: method ar drafts nothing\n"
