"""What speculation can give a policy, from its size: against the cost model, and against what was measured."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from command import kerv, refusal, told
from examples import trace_of_log
from studies_synthetic import swept, threshold_study

from kerv_cli.base.paths import shipped_dir
from kerv_cli.bench.described import described, language_of
from kerv_cli.bench.expected import TABLES, Decodes, Drafts, recorded
from kerv_cli.bench.physics import DEVICES, ENGINES, SHAPES, Sizes, priced
from kerv_cli.bench.prices import ANCHORS, FAMILIES, Estimate, closest, computed
from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.engine.cost import Profile, prices, read_profile, work_of_record
from kerv_cli.engine.record import DecodeRecord, Round
from kerv_cli.lab.database import opened
from kerv_cli.lab.store import Study
from kerv_cli.report.profiles import open_profiles
from kerv_cli.report.reprice import prices_table, repriced
from kerv_cli.report.tables import load_study

ROOT = Path(__file__).resolve().parent.parent
OPENVLA = priced(SHAPES["openvla-7b"], DEVICES["a100"], ENGINES["eager"])


def answer(*words: str) -> dict:
    document = json.loads(told("estimate", *words, "--json"))
    assert document["applies"]
    (machine,) = document["machines"]
    return machine


def family(machine: dict, method: str, engine: int = 0) -> dict:
    return next(one for one in machine["engines"][engine]["families"] if one["method"] == method)


# --- the price of a decode is the cost model's


def decode(*rounds: Round, size: int = 7) -> DecodeRecord:
    tokens = tuple(range(size))
    return DecodeRecord(tokens, None, len(rounds), rounds, "ar", 0.0, {"vision": 1.0}, size=size)


def taken(record: DecodeRecord) -> float:
    return prices(work_of_record(record), OPENVLA)[0]


FIRST = Round("prefill", committed=1)


@pytest.mark.parametrize(
    ("drafts", "chance", "record"),
    [
        (Drafts(), 0.0, decode(FIRST, *(Round("decode", start=n, committed=1) for n in range(1, 7)))),
        (
            Drafts(5),
            1.0,
            decode(FIRST, Round("verify", "drafter", 1, accepted=5, committed=6, tree_size=5)),
        ),
        (
            Drafts(2),
            1.0,
            decode(FIRST, *(Round("verify", "drafter", n, accepted=2, committed=3, tree_size=2) for n in (1, 4))),
        ),
        (
            Drafts(5, 49),
            1.0,
            decode(FIRST, Round("verify", "drafter", 1, accepted=5, committed=6, tree_size=49, levels=5)),
        ),
        (
            Drafts(source="early", in_prefill=True),
            1.0,
            decode(Round("prefill", "early", 0, accepted=6, committed=7, tree_size=6)),
        ),
        (Drafts(source="early", skipped=1.0), 1.0, decode(Round("skip", "early", 0, committed=7, tree_size=7))),
    ],
)
def test_a_decode_costs_what_the_cost_model_says_of_its_rounds(drafts, chance, record):
    assert Decodes(OPENVLA, 7, drafts).seconds([chance]) == pytest.approx(taken(record))


def test_a_mean_is_that_of_all_outcomes():
    """Two places can be rejected: four outcomes, each with its own rounds."""
    accept, total = 0.3, 0.0
    last = Round("decode", start=3, committed=1)
    both = Round("verify", "drafter", 1, accepted=2, committed=3, tree_size=2)
    one = Round("verify", "drafter", 1, accepted=1, committed=2, tree_size=2)
    none = Round("verify", "drafter", 1, accepted=0, committed=1, tree_size=2)
    again, failed = (Round("verify", "drafter", 2, accepted=n, committed=n + 1, tree_size=1) for n in (1, 0))
    total += accept**2 * taken(decode(FIRST, both, size=4))
    total += accept * (1 - accept) * taken(decode(FIRST, one, last, size=4))
    total += (1 - accept) * accept * taken(decode(FIRST, none, again, size=4))
    total += (1 - accept) ** 2 * taken(decode(FIRST, none, failed, last, size=4))
    decodes = Decodes(OPENVLA, 4, Drafts(2))
    assert decodes.seconds([accept]) == pytest.approx(total)
    forwards = decodes.verified([accept]).forwards
    assert forwards == pytest.approx(accept**2 * 2 + 2 * accept * (1 - accept) * 3 + (1 - accept) ** 2 * 4)
    assert decodes.acceptance_for(forwards) == pytest.approx(accept)
    even = decodes.break_even()
    assert even is not None
    assert even.seconds == pytest.approx(OPENVLA.decode(4))


# --- against what was measured


def measured_profile(table: str) -> Profile:
    """The stored profile. LIBERO's policy has no vision encoder: there AR's phases take what that table measured."""
    name = "epyc-mt10-150m" if table == "papers" else "epyc-vla-150m"
    profile = read_profile(ROOT / f"results/bench/{name}-profile.json")
    if table == "papers":
        return profile
    document = json.loads((ROOT / f"results/tables/{table}.json").read_text())
    times = document["labels"]["ar"]["measures"]["micro over tasks"]
    token = times["ms.verify"] / (TABLES[table] - 1) / 1e3 / profile.seconds("verify", 1)
    scale = {
        "encode": times["ms.vision"] / 1e3 / profile.seconds("encode", 1),
        "prefill": times["ms.prefill"] / 1e3 / profile.seconds("prefill", profile.prompt),
    }
    phases = {
        kind: (rows, tuple(scale.get(kind, token) * x for x in seconds))
        for kind, (rows, seconds) in profile.phases.items()
    }
    return replace(profile, phases=phases)


@pytest.mark.parametrize("table", ["papers", "papers_libero"])
def test_every_method_of_a_published_table_is_estimated_within_15_per_cent(table):
    profile, settings = measured_profile(table), recorded(table)
    assert len(settings) > 9
    off = {}
    for one in settings:
        decodes = Decodes(profile, one.tokens, one.drafts)
        estimated = decodes.speed([decodes.acceptance_for(one.forwards)])
        if not 0.85 <= estimated / one.speed <= 1.15:
            off[one.label] = f"{estimated:.2f}, measured {one.speed:.2f}"
    assert off == {}


@pytest.mark.parametrize("table", TABLES)
def test_a_published_table_stands_for_the_families(table):
    settings = recorded(table)
    assert (settings[0].label, settings[0].forwards) == ("ar", TABLES[table])
    for family in FAMILIES:
        shown = closest(TABLES[table], family)
        wanted = family.method, bool(family.drafts.nodes)
        assert (shown.method, bool(shown.drafts.nodes)) == wanted
        assert (shown.table == table) == (wanted in [(one.method, bool(one.drafts.nodes)) for one in settings])
    shown = next(one for one in settings if one.method == "one_pass_streak")
    assert 0.5 < shown.drafts.skipped < 1
    assert 1 <= shown.forwards < 2


# --- the command


def test_a_7b_on_every_device_in_a_second_without_torch():
    words = ["estimate", "weights=7B", "tokens=7", "device=h100,a100,4090,orin", "--json"]
    command = [sys.executable, "-X", "importtime", "-m", "kerv_cli", *words]
    environment = {**os.environ, "KERV_PLUGINS": ""}  # a plugin may load torch
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    assert not re.search(r"\| +(torch|pandas)$", shown.stderr, re.MULTILINE)
    machines = json.loads(shown.stdout)["machines"]
    assert [one["machine"] for one in machines] == [DEVICES[name].title for name in ("h100", "a100", "4090", "orin")]
    for machine in machines:
        tuned, eager = machine["engines"]
        assert tuned["ms"] < eager["ms"]
        for engine in machine["engines"]:
            assert sum(part["ms"] for part in engine["parts"]) == pytest.approx(engine["ms"])
            for one in engine["families"]:
                for speed in (one["at_published_acceptance"], one["at_own_acceptance"]):
                    assert speed is None or speed <= one["ceiling"] * 1.001, one
    assert machines[0]["engines"][0]["parts"][2]["bound"] == "reading"
    assert machines[0]["engines"][1]["parts"][2]["bound"] == "launches"


def test_weights_alone_give_about_what_the_model_itself_gives():
    """OpenVLA-7B's checkpoint has 7.54 billion weights."""
    guessed, known = answer("weights=7.54B", "device=a100"), answer("model=openvla-7b", "device=a100")
    for engine in (0, 1):
        assert guessed["engines"][engine]["ms"] == pytest.approx(known["engines"][engine]["ms"], rel=0.1)
        for one in known["engines"][engine]["families"][:5]:
            if one["method"] == "heisd":
                continue  # unverified drafts cost what one encoder or two towers do
            assert family(guessed, one["method"], engine)["ceiling"] == pytest.approx(one["ceiling"], rel=0.1)
    assert any("assumed" in line and "layers" in line for line in guessed["notes"])
    assert not any("assumed" in line for line in known["notes"])


@pytest.mark.parametrize("weights", [4.6e6, 135e6, 450e6, 3e9, 7e9, 70e9])
def test_an_assumed_shape_has_the_weights_that_were_asked_for(weights):
    language = language_of(weights)
    sizes = Sizes.of(language, 2)
    assert sizes.trunk_weights == pytest.approx(weights, rel=0.02)


def test_a_small_policy_and_a_shipped_one_are_answered():
    assert answer("weights=450M", "vision=100M", "device=orin")["engines"][0]["parts"][0]["ms"] > 0
    shipped = answer("model=mt10-vision")
    assert shipped["tokens"] == 16
    assert family(shipped, "spec_vla")["own_acceptance_from"].startswith("results/tables/main.csv")
    assert "prefill, 31 tokens" in [part["part"] for part in shipped["engines"][0]["parts"]]


def test_what_is_said_of_a_policy_counts():
    known = answer("model=openvla-7b", "device=a100")
    slow = answer("model=openvla-7b", "device=a100", "vision=150ms")
    assert slow["engines"][0]["parts"][0]["ms"] == 150
    assert family(slow, "one_pass")["ceiling"] < family(known, "one_pass")["ceiling"]
    assert "a faster vision encoder" in slow["sentence"]
    int4 = answer("model=openvla-7b", "device=orin", "bits=4")
    published = next(one for one in ANCHORS if one.device == "orin")
    assert int4["engines"][0]["ms"] == pytest.approx(published.ours)
    blind = answer("model=openvla-7b", "vision=0")
    assert blind["engines"][0]["encoder_share"] == 0
    assert answer("model=openvla-7b", "prompt=500")["engines"][0]["parts"][1]["part"] == "prefill, 500 tokens"
    text = told("estimate", "weights=3B", "tokens=7", "hz=20", "device=4090")
    assert "20 Hz leave 50 ms per decode" in text
    assert re.search(r"At 7 tokens and [\d.]+ ms per action .* at most [\d.]+ .*what pays first is", text)
    assert "leave 250 ms" in told("estimate", "weights=3B", "hz=20", "actions=5")


@pytest.mark.parametrize("words", [("tokens=1",), ("tokens=64",), ("weights=1M",), ("weights=400B", "vision=8ms")])
def test_extremes_are_answered(words):
    words = words if any("weights" in word for word in words) else ("weights=7B", *words)
    assert "what pays first is" in told("estimate", *words)


def test_a_measured_profile_is_priced_as_it_is():
    (machine,) = json.loads(told("estimate", "on=epyc-vla-150m", "tokens=4", "--json"))["machines"]
    (engine,) = machine["engines"]
    assert {part["bound"] for part in engine["parts"]} == {"measured"}
    assert engine["ms"] == pytest.approx(
        1e3 * read_profile(ROOT / "results/bench/epyc-vla-150m-profile.json").decode(4)
    )
    assert "chunks of 16 tokens" in refusal("estimate", "on=epyc-vla-150m", "tokens=17", code=2)


def config(folder: Path, **fields: object) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps(fields))
    return f"model={folder}"


LLAMA = {
    "vocab_size": 32064,
    "hidden_size": 4096,
    "intermediate_size": 11008,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
}


def test_a_config_of_hugging_face_gives_the_shape(tmp_path):
    timm = ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"]
    text = {"model_type": "llama", "vocab_size": 32064}
    openvla = config(tmp_path / "a", model_type="openvla", text_config=text, timm_model_ids=timm)
    known = answer("model=openvla-7b")
    assert answer(openvla)["engines"] == known["engines"]
    assert answer(f"{openvla}/config.json")["engines"] == known["engines"]
    plain = config(tmp_path / "b", model_type="prismatic", text_config=LLAMA)
    assert answer(plain)["engines"][0]["ms"] == pytest.approx(known["engines"][0]["ms"], rel=0.01)
    vision = {"hidden_size": 1152, "num_hidden_layers": 27, "image_size": 224, "patch_size": 14}
    shared = {**LLAMA, "num_key_value_heads": 8}
    small = answer(config(tmp_path / "c", text_config=shared, vision_config=vision))
    assert small["engines"][0]["ms"] < known["engines"][0]["ms"]


@pytest.mark.parametrize("fields", [{"type": "smolvla", "chunk_size": 50}, {"type": "pi0", "vocab_size": 1}, {}])
def test_a_policy_without_action_tokens_is_told_what_applies(tmp_path, fields):
    words = config(tmp_path / "flow", **fields)
    for line in (told("estimate", words), told("estimate", "tokens=0"), told("estimate", "weights=3B", "tokens=0")):
        assert len(line.splitlines()) == 1
        assert "does not apply" in line
        assert "rollout.clock=real" in line
        assert "chunks" in line
    assert json.loads(told("estimate", words, "--json"))["applies"] is False


def test_wrong_words_are_refused(tmp_path):
    assert "h100, a100, 4090" in refusal("estimate", "weights=7B", "device=h200", code=2)
    assert "weights=7B" in refusal("estimate", code=2)
    assert "one of" in refusal("estimate", "weights=7B", "model=openvla-7b", code=2)
    for word in ("weights=many", "vision=ms", "vision=8B"):
        words = [word] if word.startswith("weights") else ["weights=7B", word]
        assert word.partition("=")[0] in refusal("estimate", *words, code=2)
    assert "no target" in refusal("estimate", "model=nothing", f"results={tmp_path}", code=2)
    assert "does not describe" in refusal("estimate", config(tmp_path / "x", vocab_size="many", hidden_size=8), code=1)
    eye = {"hidden_size": 8, "num_hidden_layers": 2, "patch_size": 0}
    for name, words in (
        ("num_attention_heads", config(tmp_path / "x", **LLAMA | {"num_attention_heads": 0})),
        ("patch_size", config(tmp_path / "y", **LLAMA, vision_config=eye)),
    ):
        assert f"does not describe a policy ({name}=0)" in refusal("estimate", words, code=1)
    assert "leave out weights, vision" in refusal("estimate", "on=epyc-vla-150m", "weights=7B", "vision=8ms", code=2)
    (tmp_path / "config.json").write_text("{")
    assert "JSON" in refusal("estimate", f"model={tmp_path}", code=1)


def test_the_help_names_the_settings():
    shown = kerv("estimate", "--help").output
    for word in ("weights", "tokens", "device", "vision"):
        assert word in shown


def test_an_estimate_of_a_shape_is_the_sum_of_its_parts():
    policy = described(EstimateSettings(model="openvla-7b"))
    for costs in computed(policy, DEVICES["h100"]):
        one = Estimate(costs, 7)
        assert sum(seconds for seconds, _ in one.parts.values()) == pytest.approx(one.seconds)


# --- traces


@pytest.fixture(scope="module")
def swept_results(tmp_path_factory):
    """A study of synthetic episodes, its trace, and what the report says of it on a computed profile."""
    results = tmp_path_factory.mktemp("results")
    swept(results, threshold_study(["reach-v3", "push-v3"], radii=(9,)))
    words = (f"results={results}", "--json")
    (trace,) = json.loads(told("runs", "export", "threshold", "--to", "trace", *words))["written"]
    store = Study(opened(results), "threshold")
    rows = repriced(load_study(store), open_profiles(results, ["a100-openvla-7b-eager"]))
    return Path(trace), prices_table(rows).set_index("label").to_dict("index")


def priced_trace(trace: Path, *words: str) -> list[dict]:
    rows: list[dict] = json.loads(told("estimate", f"trace={trace}", *words, "--json"))["rows"]
    return rows


def test_an_exported_trace_costs_what_the_report_says(swept_results):
    trace, report = swept_results
    rows = {row["setting"]: row for row in priced_trace(trace, "on=a100-openvla-7b-eager")}
    assert rows.keys() == report.keys()
    for label, row in rows.items():
        assert row["ms_per_episode"] == pytest.approx(report[label]["time_per_episode_ms"])
        faster = rows["ar"]["ms_per_episode"] / row["ms_per_episode"]
        assert faster == pytest.approx(report[label]["episode_speedup"])
        assert row["low"] <= row["speed"] <= row["high"]
    assert rows["ar"]["speed"] == pytest.approx(1, rel=0.05), "the report adds recorded host seconds"


def test_a_trace_is_priced_on_several_devices(swept_results):
    trace, report = swept_results
    rows = priced_trace(trace, "model=openvla-7b", "prompt=281", "device=a100,h100")
    assert {(row["machine"], row["engine"]) for row in rows} == {
        (DEVICES[name].title, engine) for name in ("a100", "h100") for engine in ENGINES
    }
    for row in rows:
        if (row["machine"], row["engine"]) == (DEVICES["a100"].title, "eager"):
            assert row["ms_per_episode"] == pytest.approx(report[row["setting"]]["time_per_episode_ms"], rel=1e-3)
    assert "speed against AR" in told("estimate", f"trace={trace}", "weights=7B")


def write_trace(path: Path, *lines: dict) -> Path:
    path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")
    return path


def chained(accepted: list[int], drafted: int, size: int, episode: int) -> dict:
    """A decode in which every round drafts a chain, as far as tokens are left."""
    start, rounds = 1, [{"committed": 1}]
    for taken in accepted:
        depth = min(drafted, size - start - 1)
        if depth < 1:
            rounds += [{"start": start}] * (start < size)
            break
        taken = min(taken, depth)
        chain = list(range(-1, depth - 1))
        rounds.append(
            {"start": start, "proposer": "drafter", "parents": chain, "accepted": taken, "committed": taken + 1}
        )
        start += taken + 1
    return {"episode": str(episode), "tokens": size, "rounds": rounds}


def test_the_length_that_would_have_been_fastest_is_found(tmp_path):
    """Two tokens are always accepted and a third never: chains of two, and the others cost what the model says."""
    trace = write_trace(tmp_path / "t.jsonl", *(chained([2] * 10, 6, 10, episode) for episode in range(4)))
    words = ("model=openvla-7b", "device=orin,h100", "choose=draft")
    rows = priced_trace(trace, *words)
    for row in rows:
        assert (row["best"], row["sure"], len(row["speeds"])) == (2, 1, 7)
        assert row["speeds"][0]["speed"] == pytest.approx(1)
        assert row["speeds"][2]["low"] == pytest.approx(row["speeds"][2]["high"])
    recorded_length = priced_trace(trace, *words[:1], "device=h100")[0]["speed"]
    chosen = next(row for row in rows if "H100" in row["machine"])
    assert chosen["speeds"][6]["speed"] == pytest.approx(recorded_length, rel=0.01)
    assert chosen["speeds"][2]["speed"] > recorded_length
    shown = told("estimate", f"trace={trace}", *words[::2])
    assert "says nothing of longer chains" in shown
    assert "assumed" in shown


def test_an_interval_holds_what_differs_between_episodes(tmp_path):
    lines = [chained([6 * (episode % 2)] * 16, 6, 16, episode) for episode in range(6)]
    (row, _) = priced_trace(write_trace(tmp_path / "t.jsonl", *lines), "model=openvla-7b", "choose=draft")
    speed = row["speeds"][6]
    assert speed["low"] < speed["speed"] < speed["high"]
    (one, _) = priced_trace(write_trace(tmp_path / "u.jsonl", *lines[:1]), "model=openvla-7b", "choose=draft")
    assert one["speeds"][6]["low"] is None


def test_a_tree_is_known_by_its_parents(tmp_path):
    parents = [-1, -1, 0, 0, 1, 2]
    of_parents = {"start": 1, "proposer": "drafter", "parents": parents, "accepted": 2, "committed": 3}
    of_counts = {**of_parents, "parents": [], "nodes": 6, "levels": 3}
    prices = []
    for draft in (of_parents, of_counts, {**of_counts, "levels": 0}):
        line = {"episode": "0", "tokens": 7, "rounds": [{}, draft, {"start": 4}, {"start": 5}, {"start": 6}]}
        prices.append(priced_trace(write_trace(tmp_path / "t.jsonl", line), "model=openvla-7b")[0]["ms_per_decode"])
    assert prices[0] == prices[1] != prices[2]


def test_an_unverified_chunk_costs_its_encoder_and_its_draft(tmp_path):
    skipped = {"mode": "skip", "proposer": "early", "accepted": 7, "committed": 7}
    line = {"episode": "0", "tokens": 7, "rounds": [skipped]}
    row = priced_trace(write_trace(tmp_path / "t.jsonl", line), "on=a100-openvla-7b-eager")[0]
    shipped = read_profile(ROOT / "results/bench/a100-openvla-7b-eager-profile.json")
    assert row["ms_per_decode"] == pytest.approx(1e3 * (shipped.seconds("encode", 1) + shipped.seconds("early", 1)))


def test_the_log_of_another_engine_becomes_a_trace(tmp_path):
    log, trace = tmp_path / "log.jsonl", tmp_path / "trace.jsonl"
    request = {"session_id": "kitchen 7", "method": "eagle3", "prompt_tokens": 281}
    drafts = {"num_draft_tokens": [3, 1, 0], "num_accepted_tokens": [2, 1, 0]}
    log.write_text(json.dumps({**request, **drafts}) + "\n")
    trace_of_log.convert(log, trace)
    (row, _) = priced_trace(trace, "model=openvla-7b", "device=a100")
    assert (row["setting"], row["tokens"], row["episodes"]) == ("eagle3", 7, 1)
    profile = priced(SHAPES["openvla-7b"], DEVICES["a100"], ENGINES["tuned"])
    rounds = (
        FIRST,
        Round("verify", "drafter", 1, accepted=2, committed=3, tree_size=3),
        Round("verify", "drafter", 4, accepted=1, committed=2, tree_size=1),
        Round("decode", start=6, committed=1),
    )
    assert row["ms_per_decode"] == pytest.approx(1e3 * prices(work_of_record(decode(*rounds)), profile)[0])


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "t.jsonl:2 is no JSON"),
        ('{"tokens": 7}', "t.jsonl:2 is damaged: episode"),
        ('{"episode": "0", "tokens": 7, "rounds": [{"accepted": 3, "parents": [-1]}]}', "accepted=3 of 1"),
        ('{"episode": "0", "tokens": 7, "rounds": [{"parents": [0]}]}', "parents"),
        ('{"episode": "0", "tokens": 7, "rounds": [{"start": -1}]}', "start=-1"),
        ('{"episode": "0", "tokens": 7, "rounds": [{"mode": "fast"}]}', "mode=fast"),
        ('{"episode": "0", "tokens": 7, "rounds": []}', "rounds"),
    ],
)
def test_a_broken_trace_is_refused_by_its_line(tmp_path, line, says):
    trace = tmp_path / "t.jsonl"
    trace.write_text('{"episode": "0", "tokens": 7, "rounds": [{}]}\n' + line)
    refused = refusal("estimate", f"trace={trace}", "model=openvla-7b", code=1)
    assert says in refused
    assert "t.jsonl:2" in refused


def test_a_trace_that_cannot_be_answered_is_refused(tmp_path, swept_results):
    trace = write_trace(tmp_path / "t.jsonl", {"episode": "0", "tokens": 100, "rounds": [{}]})
    assert "64 tokens" in refusal("estimate", f"trace={trace}", "model=openvla-7b", code=2)
    trace = write_trace(tmp_path / "t.jsonl", {"episode": "0", "tokens": 7, "rounds": [{}]})
    assert "no drafted chain" in refusal("estimate", f"trace={trace}", "model=openvla-7b", "choose=draft", code=2)
    assert "weights=7B" in refusal("estimate", f"trace={trace}", code=2)
    assert "cannot be read: No such" in refusal("estimate", f"trace={tmp_path / 'none'}", "weights=7B", code=1)


def test_a_trace_that_a_profile_cannot_price_says_what_measures_the_cost(tmp_path):
    document = json.loads((shipped_dir().parent / "bench" / "epyc-vla-150m-profile.json").read_text())
    del document["profile"]["phases"]["draft"]
    (tmp_path / "mine.json").write_text(json.dumps(document))
    drafted = {"start": 1, "nodes": 3, "accepted": 2, "committed": 3, "proposer": "drafter"}
    lines = {"episode": "0", "tokens": 7, "setting": "chain", "rounds": [{}, drafted]}
    trace = write_trace(tmp_path / "t.jsonl", lines)
    needed = "no cost of 'draft', which setting 'chain' needs. Measure it with 'kerv bench target=vla-150m tokens=7'"
    for more in ((), ("choose=draft",)):
        assert needed in refusal("estimate", f"trace={trace}", f"on={tmp_path / 'mine.json'}", *more, code=2)
    assert "needs trace=FILE" in refusal("estimate", "weights=7B", "choose=draft", code=2)


def test_the_example_on_the_page_is_a_trace(tmp_path):
    (line,) = re.findall(r"```json\n(.*?)\n```", (ROOT / "docs/trace.md").read_text(encoding="utf-8"))
    trace = tmp_path / "t.jsonl"
    trace.write_text(line, encoding="utf-8")
    assert priced_trace(trace, "model=openvla-7b")[0]["speed"] > 1


# --- the page


def test_the_page_of_ones_own_policy_is_short_and_shows_the_example_as_it_is():
    page = (ROOT / "docs/your-policy.md").read_text(encoding="utf-8")
    assert len(page.split()) <= 600
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(code.splitlines()) <= 30
    assert code in dedent_class((ROOT / "tests/examples/own_policy.py").read_text(encoding="utf-8"))
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## ")[0]
    assert "docs/your-policy.md" in first_screen
    assert "kerv estimate" in first_screen


def dedent_class(text: str) -> str:
    return re.sub("^    ", "", text, flags=re.MULTILINE)


def test_the_range_on_the_page_is_that_of_the_tables():
    page = (ROOT / "docs/measuring.md").read_text(encoding="utf-8")
    for table in ("papers", "papers_libero"):
        ratios, profile = [], measured_profile(table)
        for one in recorded(table):
            decodes = Decodes(profile, one.tokens, one.drafts)
            ratios.append(decodes.speed([decodes.acceptance_for(one.forwards)]) / one.speed)
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{table}`, {len(ratios)} settings")]
        assert f"{min(ratios):.2f} to {max(ratios):.2f}" in row
