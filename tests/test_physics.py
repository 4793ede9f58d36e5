"""Computed prices of a 7B policy on GPUs: never below a floor, and close to what others measured."""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from command import kerv

from kerv_cli.bench.physics import DEVICES, ENGINES, ROOFLINE, SHAPES, Device, Engine, priced
from kerv_cli.bench.projections import ACTION, projections
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.episodes.cost import FORWARDS, read_profile, source_costs

ROOT = Path(__file__).resolve().parent.parent
OPENVLA = SHAPES["openvla-7b"]
PUBLISHED = json.loads((ROOT / "tests/fixtures/openvla-7b.json").read_text())
SETTINGS = BenchSettings(projected="openvla-7b")


@dataclass(frozen=True)
class Anchor:
    """A published time of one action of OpenVLA-7B in milliseconds: one sequence, seven tokens, vision included."""

    device: str
    engine: Engine
    low: float
    high: float
    source: str
    weight: float = 2.0  # bytes

    @property
    def ours(self) -> float:
        shape = SHAPES["openvla-7b"]
        shape = replace(shape, sizes=replace(shape.sizes, weight=self.weight))
        return 1e3 * priced(shape, DEVICES[self.device], self.engine).decode(ACTION)


ANCHORS = (
    Anchor("h100", ROOFLINE, 30.7, 30.7, "VLA-Perf (NVIDIA, arXiv 2602.18397): vision 0.56, prefill 4.1, tokens 26.0"),
    Anchor("a100", ROOFLINE, 55.1, 55.1, "VLA-Perf: vision 1.2, prefill 11.2, tokens 42.7"),
    Anchor("a100", ENGINES["eager"], 170, 199, "Hugging Face code; 174 = vision 8 + trunk 113 + system 53 (HeiSD)"),
    Anchor("4090", ENGINES["eager"], 162, 229, "Hugging Face code 162 (2026-07) and 229; SGLang 173"),
    Anchor("3090", ENGINES["eager"], 283, 283, "Hugging Face code (2026-07)"),
    Anchor("orin", ENGINES["tuned"], 345, 400, "2.5 to 2.9 actions per second in int4", weight=0.5),
)


@pytest.mark.parametrize("device", DEVICES.values(), ids=DEVICES)
@pytest.mark.parametrize("engine", ENGINES.values(), ids=ENGINES)
def test_no_phase_costs_less_than_its_floor(device, engine):
    profile, floors = priced(OPENVLA, device, engine), priced(OPENVLA, device, ROOFLINE)
    assert set(profile.phases) == {*FORWARDS, *source_costs()}
    for kind, (rows, seconds) in profile.phases.items():
        for n, one in zip(rows, seconds, strict=True):
            read, flops = OPENVLA.needs(kind, n)[:2]
            assert min(read, flops) > 0
            assert one >= max(read / device.bandwidth, flops / device.flops)
            assert one >= floors.seconds(kind, n)


def test_shipped_profiles_are_the_computed_ones():
    shipped = {path.name for path in (ROOT / "results/bench").glob("*-openvla-7b*.json")}
    assert shipped == {f"{one.name}-profile.json" for one in projections(SETTINGS)}
    for one in projections(SETTINGS):
        path = ROOT / "results/bench" / f"{one.name}-profile.json"
        assert json.loads(path.read_text()) == one.document
        profile = read_profile(path)
        assert (profile.about["engine"], profile.about["projected"]) == (one.engine.name, True)


@pytest.mark.parametrize("anchor", ANCHORS, ids=lambda one: f"{one.device}-{one.engine.name}")
def test_an_action_takes_what_others_measured(anchor):
    assert 0.75 * anchor.low <= anchor.ours <= 1.25 * anchor.high


def test_an_action_takes_what_the_published_ranges_allow():
    ours = {(one.device, one.engine.name): one.ours for one in ANCHORS}
    assert 170 <= ours["a100", "eager"] <= 199
    assert 162 <= ours["4090", "eager"] <= 229
    assert 30.7 <= 1e3 * priced(OPENVLA, DEVICES["h100"], ENGINES["tuned"]).decode(7) <= 45
    assert all(anchor.ours == pytest.approx(anchor.low, rel=0.1) for anchor in ANCHORS if anchor.engine is ROOFLINE)


def test_the_published_loop_takes_longer_by_what_its_users_measured():
    """158.2 and 179.3 ms on a 4090 (Spec-VLA's repository, issue 4)."""
    plain, public = (priced(OPENVLA, DEVICES["4090"], ENGINES[name]).decode(7) for name in ("eager", "public"))
    assert public / plain == pytest.approx(179.3 / 158.2, rel=0.02)


def test_the_page_has_the_published_figures_beside_ours():
    page = re.sub(" +", " ", (ROOT / "docs/measuring.md").read_text())
    for one in ANCHORS:
        engine = one.engine.name + (", int4" if one.weight < 1 else "")
        published = f"{one.low:g}" if one.low == one.high else f"{one.low:g}–{one.high:g}"
        assert f"| {DEVICES[one.device].title} | {engine} | {published} | {one.ours:.1f} | {one.source} |" in page


def test_the_weights_are_those_of_the_published_checkpoint():
    """Every forward reads the language model but its input embeddings; the encoder, all but what it never uses."""
    sizes = PUBLISHED["sizes"]
    embeddings = sizes["vocabulary"] * sizes["width"]
    vision = PUBLISHED["total_size"] // 2 - OPENVLA.sizes.trunk_weights - embeddings
    encoder = OPENVLA.needs("encode", 1).read / 2
    blocks = sum(4 * one["width"] ** 2 + 2 * one["width"] * one["feed_forward"] for one in sizes["towers"])
    assert encoder + blocks == pytest.approx(vision, rel=0.03)
    assert encoder + blocks < vision, "the checkpoint has biases, positions and a pooling head, too"
    assert 1e3 * 2 * encoder / DEVICES["h100"].bandwidth >= 0.44


def test_pi0_fast_has_gemmas_weights_and_drafts_action_tokens_alone():
    """Gemma 2B has 2.51 billion weights with its embeddings, which are its head, and 18 layers with keys of 256."""
    sizes = SHAPES["pi0-fast"].sizes
    assert sizes.trunk_weights == pytest.approx(2.506e9, rel=2e-3)
    assert sizes.cached == 18 * 2 * 256
    assert sizes.drafter < sizes.head / 4


def test_a_share_of_the_peak_and_the_launches_bound_a_phase():
    tuned, device = ENGINES["tuned"], Device("slow", 1e9, 1e15)
    needs = OPENVLA.needs("verify", 1)
    assert tuned.seconds(needs, device) == pytest.approx(needs.read / 1e9 / tuned.share)
    assert replace(tuned, share=1.0).seconds(needs, device) == pytest.approx(needs.read / 1e9)
    endless = Device("endless", 1e20, 1e20)
    assert tuned.seconds(needs, endless) == pytest.approx((32 * tuned.layer + needs.kernels) * tuned.launch)
    eager = ENGINES["eager"]
    assert 8 * eager.system == pytest.approx(0.053)
    assert 7 * 32 * eager.layer * eager.launch == pytest.approx(0.113, rel=0.01)
    draft, tree = (eager.seconds(OPENVLA.needs(kind, 5), endless) for kind in ("draft", "tree"))
    assert draft == pytest.approx(4 * (eager.layer + 13) * eager.launch), "a draft asks neither encoder nor trunk"
    assert tree > draft


def test_the_command_writes_profiles_without_torch(tmp_path):
    words = ["bench", "projected=openvla-7b", "projections.mine=[500,50]", "share=0.5"]
    shown = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "kerv_cli", *words, f"results={tmp_path}", "--json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "KERV_PLUGINS": ""},  # a plugin may load torch
    )
    assert not re.search(r"\| +torch$", shown.stderr, re.MULTILINE)
    documents = json.loads(shown.stdout.splitlines()[-1])
    assert len(documents) == 3 * (1 + len(DEVICES))
    profile = read_profile(tmp_path / "bench/mine-openvla-7b-share0.5-profile.json")
    assert profile.seconds("verify", 1) == pytest.approx(OPENVLA.needs("verify", 1).read / 500e9 / 0.5, rel=1e-3)
    assert documents["mine-openvla-7b-eager-share0.5"]["device_name"] == "mine"


def test_the_bench_of_a_shape_that_has_no_figures_is_refused(tmp_path):
    assert "openvla-7b" in kerv("bench", "projected=vla-150m", f"results={tmp_path}", code=2).stderr
