"""`kerv bench` and its replay: what is counted, what is executed, what is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from studies_synthetic import prepare, threshold_settings, threshold_study
from typer.testing import CliRunner

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.settings import BenchSettings
from kerv_cli.bench.ceilings import ceilings
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import layer_weights, open_model
from kerv_cli.bench.phases import Phase, Stage, costs, flipped
from kerv_cli.bench.profile import profile_of, projected
from kerv_cli.bench.replay import Player
from kerv_cli.bench.sequences import Recorded
from kerv_cli.cli.app import app
from kerv_cli.engine.cost import DecodeSequence, Forward, Profile, predicted, read_profile, sequence_of
from kerv_cli.lab.execute import execute
from kerv_cli.lab.store import StudyStore

NANO = BenchSettings(model="nano", dtype="float32")


def played(mode: str, start: int, nodes: int = 0, accepted: int = 0, committed: int = 1, proposer: str = "none") -> Any:
    return {
        "mode": mode,
        "start": start,
        "tree_size": nodes,
        "accepted": accepted,
        "committed": committed,
        "proposer": proposer,
    }


def row(*rounds: Any) -> Any:
    times = {"seconds.propose": 0.5, "seconds.accept": 0.25, "seconds.rectify": 0.0, "seconds.other": 0.125}
    return {"rounds": list(rounds), **times}


def test_a_recorded_decode_becomes_its_forwards() -> None:
    decode = row(played("prefill", 0), played("verify", 1, 14, 3, 4, "drafter"), played("decode", 5))
    found = sequence_of(decode, 16, 16)
    assert [dataclasses.astuple(f) for f in found.forwards] == [
        ("prefill", 0, 0, 0, ""),
        ("verify", 1, 14, 3, "drafter"),
        ("verify", 5, 0, 0, ""),
    ]
    assert found.drafts
    assert found.host == 0.375


def test_a_cut_decode_ends_at_its_last_token() -> None:
    """N = 7: drafts shrink to the places that are left, rounds behind the cut do not run."""
    decode = row(played("verify", 0, 30, 2, 3, "merged"), played("verify", 3, 12, 12, 13, "jacobi"))
    found = sequence_of(decode, 16, 7)
    assert [(f.kind, f.drafted, f.accepted) for f in found.forwards] == [("prefill", 12, 2), ("verify", 3, 3)]
    assert found.host == 0.875
    last = sequence_of(row(played("prefill", 0), played("verify", 6, 9, 4, 5, "drafter"), played("decode", 11)), 16, 7)
    assert [(f.start, f.drafted, f.proposer) for f in last.forwards] == [(0, 0, ""), (6, 0, "")]


def test_a_parallel_decode_is_one_forward_over_prompt_and_chunk() -> None:
    found = sequence_of(row(played("parallel", 0, committed=16)), 16, 7)
    assert found.forwards == (Forward("prefill", 0, 7, 0),)


def test_a_skipped_decode_has_no_forward() -> None:
    assert sequence_of(row(played("skip", 0, 0, 16, 16, "early")), 16, 16).forwards == ()


def test_bytes_and_operations_of_a_forward() -> None:
    model = open_model(NANO)
    s = model.target.settings
    weights = s.layers * (4 * s.width**2 + 3 * s.width * s.feed_forward) + s.width * 255
    assert model.trunk_weights == weights
    assert layer_weights(s) * s.layers + s.width * 255 == weights
    read, flops = costs(model, 3, 10)
    assert read == 4 * weights + 2 * s.layers * 13 * s.width * 4
    assert flops == 2 * weights * 3 + 4 * s.layers * s.width * (3 * 10 + 1 + 2 + 3)


@pytest.mark.bits
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_verification_and_single_tokens_agree(dtype: str) -> None:
    differ, compared = flipped(open_model(dataclasses.replace(NANO, dtype=dtype)), 3, 8)
    assert compared == 24
    assert differ == 0 if dtype == "float32" else differ <= 3


class Counting:
    """Counts the rows of every forward of a target."""

    def __init__(self, target: Any) -> None:
        self.rows: list[int] = []
        target.trunk.register_forward_pre_hook(lambda _, inputs: self.rows.append(inputs[0].shape[1]))


def test_a_replay_executes_the_recorded_forwards() -> None:
    model = open_model(NANO)
    counted, drafts = Counting(model.target), list[int]()
    model.drafter.register_forward_pre_hook(lambda _, inputs: drafts.append(inputs[0].shape[1]))
    forwards = (Forward("prefill", 0, 0, 0), Forward("verify", 1, 5, 2, "drafter"), Forward("verify", 4, 0, 0))
    sequence = DecodeSequence(forwards, 2.0)
    own = Recorded("spec_vla", (sequence,), {"kind": "drafter", "depth": 5, "top_k": 1}, 1, 1)
    player = Player(model, [own])
    prompt = player.stage.length
    assert player.play(sequence, own.proposer) > 2.0  # the recorded host seconds count
    assert counted.rows == [prompt, 6, 1]
    assert drafts == [prompt, 1, 1, 1, 1, 3]  # the prompt, four steps behind the first token, three committed states
    tree = dataclasses.replace(own, proposer={"kind": "drafter", "depth": 3, "top_k": 2})
    Player(model, [tree]).play(sequence, tree.proposer)
    assert counted.rows[3:] == [prompt, 6, 1]
    in_prefill = DecodeSequence((Forward("prefill", 0, 12, 4, "merged"),), 0.0)
    player.play(in_prefill, {"kind": "none"})
    assert counted.rows[-1] == prompt + 12
    assert player.stage.cache.length == prompt + 4


def profile() -> Profile:
    """A prefill of 31 costs four tokens, as the shipped policy's does; every drafted row a hundredth."""

    def phase(kind: str, rows: int, seconds: float) -> Phase:
        return Phase(kind, rows, seconds, seconds, seconds, 1e6, 1e6, seconds / 2)

    found = [phase("encode", 1, 1.0), *(phase("verify", n, 1 + 0.01 * (n - 1)) for n in (1, 2, 16))]
    found += [phase("prefill", 31, 4.0), phase("prefill", 46, 4.15), phase("draft", 2, 0.1), phase("draft", 6, 0.5)]
    found += [phase("feed", 1, 0.1), phase("feed", 31, 0.3)]
    return profile_of(31, found)


def test_the_cost_model_adds_the_forwards_up() -> None:
    known = profile()
    assert known.decode(16) == pytest.approx(20.0)
    assert known.seconds("verify", 9) == pytest.approx(1.08)
    assert known.seconds("verify", 32) == pytest.approx(1.31)
    forwards = (Forward("prefill", 0, 0, 0), Forward("verify", 1, 5, 5, "drafter"))
    assert predicted(DecodeSequence(forwards, 0.25), known) == pytest.approx(1 + 4 + 0.3 + 1.05 + 0.4 + 0.25)


def test_ceilings_are_those_of_the_definition() -> None:
    found = {c.method: c for c in ceilings(profile(), 16)}
    assert found["one_pass"].free == pytest.approx(20 / 5.15)
    assert found["spec_vla"].free == pytest.approx(20 / (5 + 1.14))
    assert found["spec_vla"].drafted == pytest.approx(20 / (5 + 1.14 + 1.3))
    assert found["naive_sd"].how == "3 × 5 drafted"
    assert found["naive_sd"].drafted < found["naive_sd"].free
    assert found["parallel"].free == pytest.approx(20 / 5.16)
    assert not {"ar", "expert", "early_unverified"} & set(found)


def test_a_projection_keeps_the_share_of_the_floor() -> None:
    phase = Phase("verify", 1, 0.02, 0.02, 0.02, 1e8, 1e6, 0.01)
    (there,) = projected([phase], Machine(1e10, 1e12), Machine(1e12, 1e14))
    assert there.seconds == pytest.approx(2e-4)
    assert projected([phase], Machine(1e10, 1e12), Machine(1e12, 1e14), overhead=1e-3)[0].seconds == 1e-3


@pytest.mark.bits
def test_a_stage_reports_the_targets_own_tokens() -> None:
    model = open_model(NANO)
    stage = Stage(model)
    with torch.inference_mode():
        hidden = model.target.forward(stage.prompt, torch.arange(stage.length))
        assert stage.prefill() == [int(model.target.head(hidden[0, -1]).argmax())]


def test_a_study_is_replayed_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """End to end on a synthetic study: AR's forwards are N, every method's are those of its record."""
    monkeypatch.setattr("kerv_cli.bench.machine._BUFFER", 2**20)
    monkeypatch.setattr("kerv_cli.bench.machine._WIDTH", 256)
    cells = threshold_study(["reach-v3"], radii=(9,))
    store = StudyStore(tmp_path, "threshold")
    store.write_plan(threshold_settings(), cells)
    execute(cells, prepare, store)
    words = ("study=threshold", "target=nano", "dtype=float32", "decodes=4", "repeats=3", "tokens=[7,16]")
    path = tmp_path / "there.json"
    path.write_text(json.dumps({"profile": profile().as_dict()}))
    told = kerv("replay", *words, f"results={tmp_path}", f"profiles.there={path}", "--json")
    rows = json.loads(told.splitlines()[-1])["rows"]
    assert [(r["tokens"], r["label"]) for r in rows][:2] == [(7, "ar"), (7, "naive_sd")]
    baseline = {r["tokens"]: r for r in rows if r["label"] == "ar"}
    assert {n: r["forwards"] for n, r in baseline.items()} == {7: 7.0, 16: 16.0}
    assert all(r["speedup"] == r["model"] == 1.0 for r in baseline.values())
    assert all(2 <= r["forwards"] < r["tokens"] and set(r["projections"]) for r in rows if r["label"] != "ar")
    table = pd.read_csv(tmp_path / "bench/nano-float32-replay-threshold.csv")
    assert len(table) == 6
    assert {"speedup", "low", "high", "projection.A100 80GB", "projection.there", "device_name", "git_commit"} <= set(
        table.columns
    )


def kerv(*words: str) -> str:
    done = CliRunner().invoke(app, ["bench", *words])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_the_command_ends_with_one_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kerv_cli.bench.machine._BUFFER", 2**20)
    monkeypatch.setattr("kerv_cli.bench.machine._WIDTH", 256)
    words = ("target=nano", "dtype=float32", "repeats=3", "tokens=[7]", f"results={tmp_path}")
    told = kerv(*words, "--json")
    document = json.loads(told.splitlines()[-1])
    path = tmp_path / "bench/nano-float32.json"
    assert document == json.loads(path.read_text())
    assert {"card", "cold_start", "phases", "ceilings", "ties", "profile", "git_commit"} <= set(document)
    assert next(p["name"] for p in document["phases"] if p["kind"] == "verify") == "one token"
    (single,) = [p["seconds"] for p in document["phases"] if p["name"] == "one token"]
    assert read_profile(path).one_token == single
    assert (tmp_path / "bench/nano-float32.png").stat().st_size > 5000
    compared = kerv("--compare", str(path), str(path))
    assert "one token" in compared
    assert "1.00" in compared


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["target=vla-15m"], "did you mean vla-150m"),
        (["target=nano", "dtype=int4"], "dtype=int4: known are auto"),
        (["repeats=1"], "repeats=1: from 3 to 100000"),
        (["tokens=[1]"], "tokens=1: from 3 to 256"),
        (["tokens=[]"], "tokens=[]: name at least one N"),
        (["target=openvla-7b", "dtype=float32"], "GB are free on cpu"),
        (["replay", "study=nothing"], "no study 'nothing'"),
        (["replay", "decodes=1"], "decodes=1: from 2 to"),
        (["replay", "profiles=1"], "profiles"),
        (["replay", "projections.mine=[1]"], "GB/s and TFLOP/s"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kerv_cli.bench.model.free_memory", lambda device: 8e9)
    done = CliRunner().invoke(app, ["bench", *words, f"results={tmp_path}"])
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_without_a_profile_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text("{}")
    with pytest.raises(CheckpointError, match="no latency profile"):
        read_profile(path)
    done = CliRunner().invoke(app, ["bench", "--compare", str(path), str(path)])
    assert done.exit_code == 1
    assert "is no result of 'kerv bench'" in done.stderr
