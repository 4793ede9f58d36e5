"""What verified drafts can give a policy: against the cost model, and what the command says and refuses."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import refusal, told

from kerv_cli.bench.estimate import DRAFTS, LOOP, Draft, break_even, language_of, shape_of
from kerv_cli.bench.physics import DEVICES, ENGINES, SHAPES, Sizes, priced
from kerv_cli.engine.record import DecodeRecord, Round
from kerv_cli.episodes.cost import Profile, prices, read_profile, work_of_record

ROOT = Path(__file__).resolve().parent.parent
OPENVLA = priced(SHAPES["openvla-7b"], DEVICES["a100"], ENGINES["eager"])


def machine(*words: str) -> dict:
    document = json.loads(told("estimate", *words, "--json"))
    assert document["applies"]
    (one,) = document["machines"]
    return one


def drafts(*words: str, engine: int = 0) -> dict[str, dict]:
    return {one["method"]: one for one in machine(*words)["engines"][engine]["drafts"]}


def taken(*rounds: Round, size: int = 7, profile: Profile = OPENVLA) -> float:
    record = DecodeRecord(tuple(range(size)), None, len(rounds), rounds, "ar", 0.0, {"vision": 1.0}, size=size)
    return prices(work_of_record(record), profile)[0]


PUBLIC = priced(SHAPES["openvla-7b"], DEVICES["a100"], ENGINES["public"])
FIRST = Round("prefill", committed=1)
SINGLE = [Round("decode", start=n, committed=1) for n in range(7)]


@pytest.mark.parametrize(
    ("rounds", "more"),
    [
        ([FIRST, *SINGLE[1:]], [("verify", 1)]),  # AR runs N + 1 forwards
        (
            [FIRST, *(Round("verify", "drafter", n, accepted=2, committed=3, tree_size=4) for n in (1, 4))],
            [("draft", 4), ("verify", 5), ("feed", 3)],
        ),
        (
            [FIRST, Round("verify", "drafter", 1, accepted=5, committed=6, tree_size=49, levels=5)],
            [("tree", 5), ("verify", 50), ("feed", 6)],
        ),
        ([Round("prefill", "early", 0, accepted=6, committed=7, tree_size=6)], []),
        ([Round("skip", "retrieval", 0, accepted=0, committed=7, tree_size=7)], []),
    ],
)
def test_the_papers_own_program_runs_a_round_too_many_and_pays_for_each_draft(rounds, more):
    drafts = sum(one.proposer == "drafter" for one in rounds)
    extra = sum(PUBLIC.seconds(kind, rows) for kind, rows in more) + drafts * ENGINES["public"].draft
    assert taken(*rounds, profile=PUBLIC) == pytest.approx(taken(*rounds) + extra)


@pytest.mark.parametrize(
    ("draft", "chance", "rounds"),
    [
        (Draft("ar"), 0.0, [FIRST, *SINGLE[1:]]),
        (Draft("chain", 5), 1.0, [FIRST, Round("verify", "drafter", 1, accepted=5, committed=6, tree_size=5)]),
        (
            Draft("chain", 2),
            1.0,
            [FIRST, *(Round("verify", "drafter", n, accepted=2, committed=3, tree_size=2) for n in (1, 4))],
        ),
        (Draft("one", source="early"), 1.0, [Round("prefill", "early", 0, accepted=6, committed=7, tree_size=6)]),
        (
            Draft("one", source="early"),
            0.0,
            [Round("prefill", "early", 0, accepted=0, committed=1, tree_size=6), *SINGLE[1:]],
        ),
    ],
)
def test_a_decode_costs_what_the_cost_model_says_of_its_rounds(draft, chance, rounds):
    seconds = draft.seconds(OPENVLA, 7, chance)
    if draft.method == "ar":  # its prefill verifies a draft of the chunk
        seconds += OPENVLA.seconds("prefill", OPENVLA.prompt) - OPENVLA.seconds("prefill", OPENVLA.prompt + 6)
    assert seconds == pytest.approx(taken(*rounds))


def test_a_mean_is_that_of_all_outcomes():
    """Two places can be rejected: four outcomes, each with its own rounds."""
    accept, total = 0.3, 0.0
    last = SINGLE[3]
    both = Round("verify", "drafter", 1, accepted=2, committed=3, tree_size=2)
    one = Round("verify", "drafter", 1, accepted=1, committed=2, tree_size=2)
    none = Round("verify", "drafter", 1, accepted=0, committed=1, tree_size=2)
    again, failed = (Round("verify", "drafter", 2, accepted=n, committed=n + 1, tree_size=1) for n in (1, 0))
    total += accept**2 * taken(FIRST, both, size=4)
    total += accept * (1 - accept) * taken(FIRST, one, last, size=4)
    total += (1 - accept) * accept * taken(FIRST, none, again, size=4)
    total += (1 - accept) ** 2 * taken(FIRST, none, failed, last, size=4)
    assert Draft("chain", 2).seconds(OPENVLA, 4, accept) == pytest.approx(total)


@pytest.mark.parametrize("draft", DRAFTS, ids=lambda one: one.method)
@pytest.mark.parametrize("tokens", [2, 7, 30])
def test_from_the_break_even_on_a_method_is_as_fast_as_ar(draft, tokens):
    even, alone = break_even(draft, OPENVLA, tokens), OPENVLA.decode(tokens)
    if even is None:
        assert draft.seconds(OPENVLA, tokens, 1.0) > alone
    else:
        assert draft.seconds(OPENVLA, tokens, even) <= alone * 1.000001
        assert even == 0 or draft.seconds(OPENVLA, tokens, even - 0.002) > alone


# --- the command


def test_a_7b_on_every_device_in_a_second_without_torch():
    words = ["estimate", "weights=7B", "tokens=7", "device=h100,a100,4090,orin", "--json"]
    command = [sys.executable, "-X", "importtime", "-m", "kerv_cli", *words]
    environment = {**os.environ, "KERV_PLUGINS": ""}  # a plugin may load torch
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    assert not re.search(r"\| +(torch|pandas)$", shown.stderr, re.MULTILINE)
    machines = json.loads(shown.stdout)["machines"]
    for one, name in zip(machines, ("h100", "a100", "4090", "orin"), strict=True):
        assert DEVICES[name].title in one["machine"]
        tuned, eager = one["engines"]
        assert tuned["ms"] < eager["ms"]
        for engine in one["engines"]:
            assert sum(part["ms"] for part in engine["parts"]) == pytest.approx(engine["ms"])
            for draft in engine["drafts"]:
                speeds = [*draft["speeds"].values(), draft["ceiling"]]
                assert speeds == sorted(speeds)
    assert machines[0]["engines"][0]["parts"][2]["bound"] == "reading"
    assert machines[0]["engines"][1]["parts"][2]["bound"] == "launches"


def test_weights_alone_give_about_what_the_model_itself_gives():
    """OpenVLA-7B's checkpoint has 7.54 billion weights."""
    guessed, known = machine("weights=7.54B", "device=a100"), machine("weights=openvla-7b", "device=a100")
    for engine in (0, 1):
        assert guessed["engines"][engine]["ms"] == pytest.approx(known["engines"][engine]["ms"], rel=0.1)
        pairs = zip(guessed["engines"][engine]["drafts"], known["engines"][engine]["drafts"], strict=True)
        assert all(one["ceiling"] == pytest.approx(other["ceiling"], rel=0.1) for one, other in pairs)
    assert any("assumed" in line and "layers" in line for line in guessed["notes"])
    assert known["notes"] == []
    assert shape_of("pi0-fast")[0] is SHAPES["pi0-fast"]


@pytest.mark.parametrize("weights", [4.6e6, 135e6, 450e6, 3e9, 7e9, 70e9])
def test_an_assumed_shape_has_the_weights_that_were_asked_for(weights):
    assert Sizes.of(language_of(weights), 2).trunk_weights == pytest.approx(weights, rel=0.02)


def test_no_acceptance_is_taken_from_other_chunks_and_no_ceiling_beats_one_forward_for_all():
    """Only `accepted=` sets the acceptance. Other chunk lengths change the speed, not the acceptance."""
    shown = drafts("weights=7B", "tokens=7", "accepted=0.6")
    assert all(list(one["speeds"]) == ["0.6"] for one in shown.values())
    for tokens in (2, 7, 128):
        for one in drafts("weights=7B", f"tokens={tokens}").values():
            assert one["ceiling"] <= tokens
    high, low = (drafts("weights=7B", f"accepted={chance}") for chance in (1, 0))
    for method, one in high.items():
        assert one["speeds"]["1"] == one["ceiling"]
        assert low[method]["speeds"]["0"] < 1.01
    sentence = machine("weights=7B", "tokens=7", "accepted=0.6")["sentence"]
    assert "at acceptance 0.6" in sentence
    assert "method=last_action is the draft to try first" in sentence
    assert all(one["method"] in {draft.method for draft in DRAFTS} for one in shown.values())


def test_the_papers_loop_costs_a_draft_a_round_too_many_as_it_costs_ar_a_forward():
    (engine,) = machine("on=a100-openvla-7b-public", "tokens=7", "accepted=[0,1]")["engines"]
    assert sum(part["ms"] for part in engine["parts"]) == pytest.approx(engine["ms"])
    speeds = {one["method"]: one["speeds"] for one in engine["drafts"]}
    assert speeds["last_action"]["0"] < 1.001  # nothing is gained if nothing is accepted
    assert speeds["last_action"]["1"] > 2  # the prefill ends the decode, and no round follows


def test_what_is_recommended_does_not_change_the_policy():
    """Row 5 of the review: `one_pass` was named, which relaxes what is accepted."""
    from kerv_cli.base.config import compose
    from kerv_cli.episodes.settings import RolloutSettings

    for draft in DRAFTS:
        settings = compose("rollout", [f"method={draft.method}"], RolloutSettings)
        assert (settings.acceptance.kind, settings.skip.kind) == ("strict", "none")


def test_a_robots_rate_is_compared():
    text = told("estimate", "weights=3B", "tokens=7", "hz=20", "device=4090")
    assert "20 Hz leave 50 ms per chunk" in text
    assert re.search(r"At 7 tokens and [\d.]+ ms per chunk .* at most [\d.]+;.*what pays first is", text)
    assert "leave 250 ms" in told("estimate", "weights=3B", "hz=20", "actions=5")
    assert "times too slow, more than verified drafts give" in told("estimate", "weights=70B", "hz=1000")


def test_a_fast_policy_has_its_own_answer():
    shown = machine("weights=pi0-fast", "code=fast", "device=4090")
    assert shown["tokens"] == 30
    (line,) = shown["notes"]
    profile = priced(SHAPES["pi0-fast"], DEVICES["4090"], ENGINES["tuned"])
    assert f"always decodes {LOOP} tokens" in line
    assert f"{profile.decode(LOOP) / profile.decode(30):.1f} times less" in line
    assert "less often than bins" in line
    assert machine("weights=pi0-fast", "code=fast", "tokens=25")["tokens"] == 25


@pytest.mark.parametrize("words", [("code=flow",), ("tokens=0",), ("weights=3B", "tokens=0"), ("on=x", "code=flow")])
def test_a_flow_policy_is_told_what_applies(words):
    (line,) = told("estimate", *words).splitlines()
    assert "does not apply" in line
    assert "rollout.clock=real" in line
    assert json.loads(told("estimate", *words, "--json"))["applies"] is False


@pytest.mark.parametrize("words", [("tokens=1",), ("tokens=128",), ("weights=1M",), ("weights=400B",)])
def test_extremes_are_answered(words):
    words = words if any("weights" in word for word in words) else ("weights=7B", *words)
    assert "what pays first is" in told("estimate", *words)


def test_a_measured_profile_is_priced_as_it_is():
    (engine,) = machine("on=epyc-vla-150m", "tokens=4")["engines"]
    assert {part["bound"] for part in engine["parts"]} == {"measured"}
    stored = read_profile(ROOT / "results/bench/epyc-vla-150m-profile.json")
    assert engine["ms"] == pytest.approx(1e3 * stored.decode(4))
    assert "chunks of 16 tokens" in refusal("estimate", "on=epyc-vla-150m", "tokens=17", code=2)


def test_a_profile_without_a_drafter_prices_the_others(tmp_path):
    document = json.loads((ROOT / "results/bench/epyc-vla-150m-profile.json").read_text())
    for kind in ("draft", "early"):
        del document["profile"]["phases"][kind]
        (tmp_path / "mine.json").write_text(json.dumps(document))
        shown = drafts(f"on={tmp_path / 'mine.json'}")
        assert "naive_sd" not in shown
        assert ("one_pass_strict" in shown) == (kind == "draft")
    assert told("estimate", f"on={tmp_path / 'mine.json'}")


def test_wrong_words_are_refused():
    assert "h100, a100, 4090" in refusal("estimate", "weights=7B", "device=h200", code=2)
    assert "weights=7B" in refusal("estimate", code=2)
    assert "leave out weights" in refusal("estimate", "on=epyc-vla-150m", "weights=7B", code=2)
    for word in ("weights=many", "weights=7T", "weights=-7B", "weights=nan", "weights=config.json"):
        assert "such as 7B" in refusal("estimate", word, code=2)
    for word in ("accepted=2", "accepted=[]", "tokens=129", "hz=0", "model=openvla-7b", "trace=FILE"):
        assert word.partition("=")[0] in refusal("estimate", "weights=7B", word, code=2)


# --- the page


def test_the_page_of_ones_own_policy_is_short_and_shows_the_example_as_it_is():
    page = (ROOT / "docs/your-policy.md").read_text(encoding="utf-8")
    assert len(page.split()) <= 600
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(code.splitlines()) <= 30
    example = (ROOT / "tests/examples/own_policy.py").read_text(encoding="utf-8")
    assert code in re.sub("^    ", "", example, flags=re.MULTILINE)
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## ")[0]
    assert "docs/your-policy.md" in first_screen
    assert "kerv estimate" in first_screen
