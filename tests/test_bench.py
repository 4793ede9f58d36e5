"""`kerv bench`: what is counted, what is measured, what is refused."""

import dataclasses
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from command import kerv, refusal
from examples.tiny_openvla import TINY, write_checkpoint
from flips import flipped

from kerv_cli.base.errors import CheckpointError
from kerv_cli.bench import measure as measuring
from kerv_cli.bench.measure import Phase, costs_of, decoders, launches, measure, profile_of
from kerv_cli.bench.model import open_model
from kerv_cli.bench.physics import Sizes
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.decoder import Decoder, Parts, Stopwatch
from kerv_cli.episodes.cost import READ_PHASES, Profile, Work, prices, read_profile, work_of, work_of_record
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.targets.openvla.config import Language

pytestmark = pytest.mark.usefixtures("quick_report")

NANO = BenchSettings(target="nano", dtype="float32")

Played = tuple[str, int, int, int, str]
"""Mode, start, nodes, accepted, proposer."""
PREFILL: Played = ("prefill", 0, 0, 0, "none")


def work(*rounds: Played, looked_up: bool = False, levels: int = 0, vision: float = 1.0) -> Work:
    """Of one decode of sixteen tokens."""
    names = ("mode", "start", "tree_size", "accepted", "proposer")
    columns = {name: np.array(column) for name, column in zip(names, zip(*rounds, strict=True), strict=True)}
    columns["levels"] = np.full(len(rounds), levels)
    times = dict(zip(READ_PHASES, np.array([[vision], [0.5], [0.25], [0.0], [0.125]]), strict=True))
    return work_of(columns, np.array([len(rounds)]), times, np.array([looked_up]), 16)


def test_a_recorded_decode_becomes_its_forwards():
    found = work(PREFILL, ("verify", 1, 14, 3, "drafter"), ("decode", 5, 0, 0, "none"))
    rows = {kind: calls.rows.tolist() for kind, calls in found.calls.items()}
    assert rows == {"encode": [1], "prefill": [0], "verify": [15, 1], "feed": [0, 4], "draft": [14]}
    assert found.calls["feed"].with_prompt.tolist() == [True, False]
    assert (found.host.tolist(), found.propose.tolist()) == ([0.375], [0.0])  # the drafter's: by the profile
    assert found.needs == ["encode", "prefill", "verify", "feed", "draft"]


def test_a_drafter_reads_no_states_if_one_token_is_left():
    found = work(PREFILL, ("verify", 1, 14, 13, "drafter"), ("decode", 15, 0, 0, "none"))
    assert found.calls["feed"].rows.tolist() == [0]


def test_early_and_retrieved_drafts_have_costs_and_others_take_what_was_recorded():
    jacobi = work(PREFILL, ("verify", 1, 12, 12, "jacobi"))
    assert jacobi.propose.tolist() == [0.5]
    assert jacobi.needs == ["encode", "prefill", "verify"]
    merged = work(("verify", 0, 30, 2, "merged"), ("verify", 3, 12, 12, "jacobi"))
    assert merged.needs == ["encode", "prefill", "verify", "early"]
    without = work(("verify", 0, 30, 2, "hold+lookup"))  # takes what was recorded
    assert (without.needs, without.propose.tolist()) == (["encode", "prefill"], [0.5])
    beside = work(("verify", 0, 15, 2, "early"), ("verify", 3, 12, 12, "drafter"), looked_up=True)
    assert beside.needs == ["encode", "prefill", "verify", "feed", "draft", "early", "retrieval"]


def test_a_skipped_decode_has_no_forward():
    found = work(("skip", 0, 0, 16, "early"))
    assert found.needs == ["encode", "early"]
    blind = work(("skip", 0, 0, 16, "hold"), vision=0.0)  # the target never encoded
    assert (blind.needs, blind.propose.tolist(), blind.host.tolist()) == ([], [0.5], [0.375])
    profile = Profile(31, {"encode": ((1,), (9.0,))})
    assert prices(blind, profile).tolist() + prices(found, profile).tolist() == [0.875, 9.875]
    asked = work(("verify", 0, 15, 15, "early"))  # the target verifies, so it encodes
    assert asked.needs == ["encode", "prefill", "early"]


def test_a_tree_has_the_levels_of_its_settings_and_of_the_chunk():
    rounds = (PREFILL, ("verify", 1, 50, 4, "drafter"), ("verify", 13, 50, 1, "drafter"))
    assert work(*rounds, levels=5).calls["tree"].rows.tolist() == [5, 2]


@torch.inference_mode()
@pytest.mark.parametrize(("top_k", "nodes", "kind"), [(2, 6, "tree"), (1, 6, "draft")])
def test_a_record_says_whether_a_tree_was_drafted_however_small_it_is(top_k, nodes, kind):
    model = open_model(NANO)
    drafter = DrafterProposer(model.drafter, model.target, 6, top_k, nodes)
    decoder = Decoder(model.target, Parts(proposer=drafter))
    decoder.reset("reach-v3", 0, np.zeros(3))
    decode = decoder.decode(model.observation)
    drafted = [one for one in decode.rounds if one.tree_size]
    assert {one.levels for one in drafted[:1]} == {6 if top_k > 1 else 0}
    assert {"tree", "draft"} & set(work_of_record(decode).calls) == {kind}


def test_bytes_and_operations_of_a_forward():
    model = open_model(NANO)
    s, sizes = model.target.settings, model.sizes
    weights = s.layers * (4 * s.width**2 + 3 * s.width * s.feed_forward) + s.width * 255
    assert sizes.trunk_weights == weights
    read, flops = sizes.forward(3, 10)
    assert 2 <= sizes.weight < 2.1  # half precision, and float32 for the gains of the norms
    assert read == sizes.weight * weights + 2 * s.layers * 13 * s.width * 4
    assert flops == 2 * weights * 3 + 4 * s.layers * s.width * (3 * 10 + 1 + 2 + 3)
    assert sizes.needs("verify", 3, 10) == (read, flops)
    assert sizes.needs("encode", 1, 10) == (0, 0)
    assert sizes.needs("tree", 5, 10)[1] == 8 * sizes.needs("draft", 5, 10)[1]


def test_the_sizes_of_a_grown_target_are_those_of_its_new_layers(policies, tmp_path):
    shape = ["grow.width=128", "grow.heads=2", "grow.feed_forward=160", "grow.layers=3", "grow.prompt=70"]
    nano = f"{policies}/artifacts/target/nano-vision"
    kerv("build", "target", *shape, "grow.drafter=true", f"policy.target={nano}", "name=large", f"results={tmp_path}")
    model, base = (open_model(BenchSettings(target=name, results=str(tmp_path))) for name in ("large", nano))
    sizes, s = model.sizes, base.target.settings
    tokens = base.target.actions.tokens
    assert sizes.trunk_weights == 3 * (4 * 128**2 + 3 * 128 * 160) + s.width * tokens
    assert sizes.drafter == 4 * 128**2 + 3 * 128 * 160 + 2 * s.width**2 + s.width * tokens
    assert (sizes.cached, sizes.channels) == (2 * 3 * 128, 3 * 128)
    prompt = model.target.max_prompt
    assert sizes.forward(prompt, 0)[1] == 2 * sizes.trunk_weights * 70 + 4 * 3 * 128 * 70 * 71 / 2
    assert base.sizes == Sizes.of(Language(tokens, s.width, s.feed_forward, s.layers, 1), 4)


@pytest.mark.usefixtures("quick")
def test_the_sizes_of_an_openvla_policy_are_counted_and_its_decodes_measured(tmp_path):
    write_checkpoint(tmp_path / "tiny")
    kerv("build", "target", "target=openvla", f"checkpoint={tmp_path}/tiny", f"results={tmp_path}")
    settings = BenchSettings(target="openvla", repeats=3, results=str(tmp_path))
    model = open_model(settings)
    width, layers = TINY.language.hidden_size, TINY.language.num_hidden_layers
    weights = layers * (4 * width**2 + 3 * width * TINY.language.intermediate_size) + width * 256
    assert (model.sizes.trunk_weights, model.sizes.weight) == (weights, 4)
    phases = measure(model, settings)
    assert {phase.kind for phase in phases} == {"encode", "prefill", "verify", "feed", "draft", "tree"}


def test_a_policy_that_does_not_show_its_layers_is_refused(tmp_path):
    importlib.import_module("examples.own_policy")
    kerv("build", "target", "target=own", "name=own", f"results={tmp_path}")
    assert "has no attribute `layers`" in refusal("bench", "target=own", f"results={tmp_path}", code=2)


def test_a_draft_that_cannot_be_measured_is_named_and_the_others_are_measured(monkeypatch, caplog):
    def without_early(settings, task):
        if settings.method == "early_unverified":
            raise CheckpointError("no early drafter")
        return settings.method

    monkeypatch.setattr(measuring, "decoder_for", without_early)
    assert set(measuring.source_decoders(NANO)) == {"retrieval"}
    assert "'early': no early drafter" in caplog.text


@pytest.mark.bits
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_verification_and_single_tokens_agree(dtype):
    differ, compared = flipped(open_model(dataclasses.replace(NANO, dtype=dtype)), 2)
    assert compared == 32
    assert differ == 0 if dtype == "float32" else differ <= 3


@torch.inference_mode()
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_decodes_of_all_sizes_show_what_each_part_costs(dtype):
    """The forwards' rows are counted at the trunk and at its compiled verification, the costs' at the laps."""
    model, rows = open_model(dataclasses.replace(NANO, dtype=dtype)), list[int]()
    shown = set[tuple[str, int]]()
    model.target.trunk.register_forward_pre_hook(lambda _, inputs: rows.append(inputs[0].shape[1]))
    predict = model.target.predict
    model.target.predict = lambda tokens, *rest: (rows.append(len(tokens)), predict(tokens, *rest))[1]
    prompt = model.target.encode(model.observation)
    length = prompt.shape[1]
    for decoder in decoders(model):
        clock = Stopwatch(model.target.device)
        clock.lap("vision")
        chunk = decoder.decode_prompt(prompt, clock)
        clock.stop()
        assert sum(seconds for _, seconds in clock.laps) == pytest.approx(sum(clock.phases.values()))
        found = [key for key, _ in costs_of(decoder, length, chunk.rounds, clock.laps)]
        assert {n for kind, n in found if kind in ("prefill", "verify")} <= {1, *rows}  # single tokens are one call
        shown.update(found)
        rows.clear()
    assert {n - length for kind, n in shown if kind == "prefill"} == {0, 1, 3, 7, 15, 30}
    assert {n for kind, n in shown if kind == "verify"} == {1, 2, 4, 8, 15, 51}
    assert {n for kind, n in shown if kind == "tree"} == {2, 5}
    assert {("draft", 14), ("draft", 3), ("feed", length), ("feed", 4)} <= shown


def profile() -> Profile:
    """A prefill of 31 costs four tokens, as the shipped policy's does; every drafted row a hundredth."""

    def phase(kind, rows, seconds):
        return Phase(kind, rows, seconds, seconds, seconds, 1e6, 1e6, seconds / 2)

    found = [phase("encode", 1, 1.0), *(phase("verify", n, 1 + 0.01 * (n - 1)) for n in (1, 2, 16))]
    found += [phase("prefill", 31, 4.0), phase("prefill", 46, 4.15), phase("draft", 2, 0.1), phase("draft", 6, 0.5)]
    found += [phase("feed", 1, 0.1), phase("feed", 31, 0.3)]
    return profile_of(found, 16)


def test_the_cost_model_adds_the_forwards_up():
    known = profile()
    assert known.decode(16) == pytest.approx(20.0)
    assert known.seconds("verify", 9) == pytest.approx(1.08)
    assert known.seconds("verify", 32) == pytest.approx(1.31)
    drafted = work(PREFILL, ("verify", 1, 5, 5, "drafter"))
    assert prices(drafted, known) == pytest.approx([1 + 4 + 0.3 + 1.05 + 0.4 + 0.375])
    skipped = work(("skip", 0, 0, 16, "early"))
    assert prices(skipped, known) == pytest.approx([1 + 0.5 + 0.375])
    early = Profile(31, {**known.phases, "early": ((1,), (0.7,))}, 16)
    assert prices(skipped, early) == pytest.approx([1 + 0.7 + 0.375])


@pytest.fixture
def quick(monkeypatch):
    """Small buffers, and no shipped policy beside the measured one."""
    monkeypatch.setattr("kerv_cli.bench.measure._BUFFER", 2**20)
    monkeypatch.setattr("kerv_cli.bench.measure._WIDTH", 256)
    monkeypatch.setattr(measuring, "_EVICTING", 2**10)
    monkeypatch.setattr(measuring, "source_decoders", lambda settings: {})


@pytest.mark.usefixtures("quick")
def test_what_starts_work_on_a_gpu_is_counted():
    counted = "cudaLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch", "cudaMemcpyAsync", "cudaMemsetAsync"
    assert launches([*counted, "aten::mm", "cudaEventRecord", "cudaDeviceSynchronize"]) == len(counted)


def test_the_command_ends_with_one_document(tmp_path):
    words = ("target=nano", "dtype=float32", "repeats=3", "tokens=7", f"results={tmp_path}")
    told = kerv("bench", *words, "--json").stdout
    document = json.loads(told.splitlines()[-1])
    path = tmp_path / "bench/nano-float32.json"
    assert document == json.loads(path.read_text())
    assert {"phases", "profile", "git_commit"} <= set(document)
    assert next(p["name"] for p in document["phases"] if p["kind"] == "verify") == "one token"
    (single,) = [p["seconds"] for p in document["phases"] if p["name"] == "one token"]
    assert read_profile(path).seconds("verify", 1) == single
    assert read_profile(path).tokens == 8


@pytest.mark.usefixtures("quick")
def test_the_commands_for_a_new_gpu_run_to_their_end(policies, tmp_path):
    """They run as docs/measuring.md writes them, but for the device, the shapes and the study's settings."""
    page = (Path(__file__).parents[1] / "docs/measuring.md").read_text(encoding="utf-8")
    (block,) = [block for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) if "runtime.device=cuda" in block]
    study = tmp_path / "main.yaml"
    study.write_text("settings: {ar: method=ar, hold: method=spec_vla proposer=hold}\n", encoding="utf-8")
    own = {
        "bench": ["repeats=3"],
        "sweep": [f"policy.target={policies}/artifacts/target/nano-state", "record=0", "world.horizon=6"],
        "report": [],
    }
    for line in block.splitlines():
        small = line.split("#")[0].replace("openvla-7b", "nano").replace("bfloat16", "float32").replace("cuda", "cpu")
        _, name, *words = small.replace("sweep study=main", f"sweep study={study}").split()
        kerv(name, *words, *own.pop(name), f"results={tmp_path}")
    assert not own
    priced = pd.read_csv(tmp_path / "report/tables/main_on.csv")
    assert set(priced["label"]) == {"ar", "hold"}
    assert set(priced["on"]) == {"nano-float32"}
    assert list(priced["episodes"]) == [4, 4]


def test_a_model_that_does_not_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("kerv_cli.bench.model.memory_of", lambda device: 8e9)
    words = ("target=openvla-7b", "dtype=float32", f"results={tmp_path}")
    assert "cpu has 8.0 GB" in refusal("bench", *words, code=2)
