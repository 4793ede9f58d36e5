"""skip=risk (docs/methods.md §4.6): the certificate, the audit, the gate in the decode loop, the recording."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from examples.own_target import MockTarget
from test_streak import ByPlace, near
from test_unverified import SHOWN, Near
from typer.testing import CliRunner

from kerv_cli.cli.app import app
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.loss import auc, chunk_loss, target_tokens
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.lab.episode import run_episode
from kerv_cli.methods.certified.betting import more_to_decide, p_value, wealth
from kerv_cli.methods.risk import RiskSkipSettings
from kerv_cli.methods.risk.alarm import Audit, Evidence, alarm_level, largest_evidence
from kerv_cli.methods.risk.gate import RiskSkip
from kerv_cli.methods.risk.recording import RiskArtifact, RiskRecording, certify, episodes_needed
from kerv_cli.methods.risk.scores import Draft
from kerv_cli.report.risk import coverage
from kerv_cli.training import risk_recording

# --- the certificate


def population(seed: int, episodes: int, decodes: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scores, losses and episodes: a lower score loses more often, and decodes of an episode resemble each other."""
    random = np.random.default_rng(seed)
    mood = np.repeat(random.normal(size=episodes), decodes)
    scores = mood + random.normal(size=episodes * decodes)
    odds = 1 / (1 + np.exp(2.0 * scores + 1.5))
    return scores, (random.random(len(scores)) < odds).astype(float), np.repeat(np.arange(episodes), decodes)


def lost_and_won(random: np.random.Generator, pairs: int, lost: float, won: float) -> np.ndarray:
    """v of paired episodes of which these shares are solved by the baseline, by the method alone."""
    return random.choice([1.0, 0.5, 0.0], size=pairs, p=[lost, 1 - lost - won, won])


@pytest.mark.parametrize("groups", [1, 10])
def test_a_bet_against_a_true_hypothesis_errs_no_oftener_than_it_says(groups: int) -> None:
    """Means at the bound: skewed ones, two-point ones, those of tasks that differ in random order, and of pairs."""
    random, bound = np.random.default_rng(0), 0.1
    hard = np.repeat(np.linspace(0, 2 * bound, groups) if groups > 1 else [bound], 200 // groups)

    def share(draw: Callable[[], np.ndarray], at: float = bound) -> float:
        return float(np.mean([p_value(draw(), at, 0.1) <= 0.1 for _ in range(400)]))

    most = 0.1 + 3 * math.sqrt(0.09 / 400)
    assert share(lambda: random.permutation(random.beta(0.2 * hard + 1e-9, 0.2 * (1 - hard)))) <= most
    assert share(lambda: (random.random(200) < random.permutation(hard)).astype(float)) <= most
    for lost, won in ((0.05, 0.0), (0.08, 0.03), (0.15, 0.1)):
        assert share(lambda lost=lost, won=won: lost_and_won(random, 210, lost, won), 0.525) <= most  # type: ignore[misc]


def test_bets_show_that_pairs_that_seldom_differ_lose_less_than_five_points() -> None:
    random = np.random.default_rng(1)
    shown = [p_value(lost_and_won(random, 210, 0.01, 0.01), 0.525, 0.1) <= 0.1 for _ in range(300)]
    assert np.mean(shown) >= 0.95


def test_bets_know_nothing_of_the_values_to_come() -> None:
    values = np.random.default_rng(2).random(30)
    changed = np.concatenate([values[:20], 1 - values[20:]])
    assert wealth(values, 0.5, 0.1)[:20] == pytest.approx(wealth(changed, 0.5, 0.1)[:20])
    assert p_value(np.zeros(0), 0.5, 0.1) == 1.0


def test_how_many_values_more_would_decide() -> None:
    """Pairs that agree: each multiplies the wealth by as much, so that the number is exact up to the first bets."""
    short = np.full(60, 0.5)
    more = more_to_decide(short, 0.525, 0.1)
    growth = math.log1p(0.75 / 0.475 * 0.025)
    assert more == math.ceil((math.log(10) - math.log(wealth(short, 0.525, 0.1)[-1])) / growth)
    assert more_to_decide(np.full(200, 0.5), 0.525, 0.1) == 0
    assert more_to_decide(np.full(60, 0.6), 0.525, 0.1) == math.inf
    assert more_to_decide(np.zeros(0), 0.525, 0.1) == math.inf


def test_a_certified_risk_holds_in_repeated_calibrations() -> None:
    """200 calibrations on 120 episodes each; the truth is that of 4,000 others."""
    scores, losses, episodes = population(1, 4000)
    epsilon, delta, held, shares = 0.15, 0.1, [], []
    for seed in range(200):
        found = certify(*population(100 + seed, 120), epsilon, delta)
        shares.append(found.share)
        skipped = scores >= found.level
        if not skipped.any():
            held.append(True)
            continue
        sums = np.bincount(episodes[skipped], losses[skipped], 4000)
        counts = np.bincount(episodes[skipped], minlength=4000)
        held.append(bool((sums[counts > 0] / counts[counts > 0]).mean() <= epsilon))
    assert np.mean(held) >= 1 - delta
    assert np.median(shares) > 0.15  # it is not empty


def test_nothing_is_certified_where_the_draft_is_bad_or_episodes_are_few() -> None:
    scores, losses, episodes = population(2, 100)
    assert certify(scores, np.ones_like(losses), episodes, 0.1, 0.1).level == math.inf
    few = episodes < episodes_needed(0.1, 0.1) - 1
    assert certify(scores[few], np.zeros(few.sum()), episodes[few], 0.1, 0.1).level == math.inf
    enough = episodes < episodes_needed(0.1, 0.1)
    found = certify(scores[enough], np.zeros(enough.sum()), episodes[enough], 0.1, 0.1)
    assert found.share == 1.0
    assert found.risk == 0.0


def test_coverage_and_auc_by_hand() -> None:
    scores, losses = np.array([3.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.5])
    shares, risks = coverage(scores, losses)
    assert shares.tolist() == pytest.approx([1 / 3, 2 / 3, 1])
    assert risks.tolist() == pytest.approx([0.0, 0.25, 0.5])
    assert auc(scores, np.array([False, True, False])) == 1.0
    assert auc(np.array([1.0, 1.0, 1.0]), np.array([False, True, False])) == 0.5


# --- the audit


def test_evidence_is_seldom_large_where_there_is_no_shift() -> None:
    """Ville: with a mean of ε the e-value reaches 10 in at most a tenth of the sequences, whenever one looks."""
    random, reached = np.random.default_rng(0), [0, 0]
    for _ in range(500):
        evidence = Evidence(0.1)
        largest = [1.0, 1.0]
        for loss in random.beta(0.2, 1.8, 60):
            evidence.add(float(loss))
            largest = [max(largest[0], evidence.above), max(largest[1], evidence.below)]
        reached = [count + (value >= 10) for count, value in zip(reached, largest, strict=True)]
    assert max(reached) <= 500 * 0.1


SHIPPED = Path(__file__).parents[1] / "results/pretrained/mt10-vision/risk"


def test_the_alarm_is_false_as_often_as_it_says_on_recorded_episodes_that_set_no_level() -> None:
    """The shipped recording, whose tasks differ in risk: half of its episodes set level and alarm, the others count."""
    drafts = RiskRecording(RiskArtifact().read(SHIPPED), pq.read_table(SHIPPED / "decodes.parquet")).losses("early")
    scores, losses, settings = drafts.scores["odds"], drafts.losses, RiskSkipSettings()
    decodes = [np.flatnonzero(drafts.episodes == number) for number in range(int(drafts.episodes.max()) + 1)]
    random, rates = np.random.default_rng(0), []
    for _ in range(8):
        order = random.permutation(len(decodes))
        seen, fresh = ([decodes[number] for number in half] for half in np.split(order, 2))
        rows, numbers = np.concatenate(seen), np.repeat(np.arange(len(seen)), [len(part) for part in seen])
        trusted = scores >= certify(scores[rows], losses[rows], numbers, settings.epsilon, settings.delta).level
        raised = alarm_level([(trusted[part], losses[part]) for part in seen], settings)
        rates += [(largest_evidence(trusted[part], losses[part], settings, random) > raised).mean() for part in fresh]
    assert 0.05 <= np.mean(rates) <= settings.delta + 0.03


def test_an_alarm_comes_within_ten_audits_and_goes_when_losses_stay_away() -> None:
    audit = Audit(0.1, 0.1)
    count = 0
    while not audit.alarm:
        audit.add(1.0)
        count += 1
    assert count <= 3
    for _ in range(200):
        audit.add(0.0)
        if not audit.alarm:
            break
    assert not audit.alarm
    audit.add(1.0)
    audit.reset()
    assert audit.evidence.above == 1.0


# --- the loss


@torch.inference_mode()
def test_the_loss_is_a_share_of_the_scale_and_one_where_a_strict_dof_flips() -> None:
    target = MockTarget()
    space, truth = target.actions, np.array(near(target).drafted)
    strict = space.strict_tokens(len(truth))
    off = np.where(strict, truth, np.where(truth + 4 < space.tokens, truth + 4, truth - 4))
    expected = 4 * 2 / space.tokens * (~strict).mean()
    assert chunk_loss(space, off, truth, 1.0) == pytest.approx(expected)
    assert chunk_loss(space, off, truth, expected / 2) == 1.0
    flipped = truth.copy()
    flipped[np.flatnonzero(strict)[0]] ^= 1
    assert chunk_loss(space, flipped, truth, 1.0) == 1.0


class Fixed:
    """A score that is given."""

    def __init__(self, *values: float) -> None:
        self.values = list(values)

    def of(self, draft: Draft) -> float:
        return self.values.pop(0) if len(self.values) > 1 else self.values[0]


def decoder_of(source: Near, target: MockTarget, score: Any = None, level: float = 0.0, **settings: Any) -> Decoder:
    wanted = RiskSkipSettings(**{"audit": 0.0, "opening": 0, **settings})
    skip = RiskSkip(wanted, source, score or Fixed(1.0), level, 0.1)
    made = Decoder(target, Parts(prefill_draft=source, skip=skip))
    made.reset("t", 0, np.zeros(3))
    return made


def reasons(decoder: Decoder, decodes: int) -> list[str]:
    return [trust_of(decoder.decode(SHOWN)).reason for _ in range(decodes)]


def trust_of(record: DecodeRecord) -> Any:
    assert record.trust is not None
    return record.trust


@torch.inference_mode()
def test_a_trusted_draft_is_executed_and_another_is_verified() -> None:
    target = MockTarget()
    decoder = decoder_of(near(target, 3), target, Fixed(1.0, -1.0))
    first, second = (decoder.decode(SHOWN) for _ in range(2))
    assert first.skipped
    assert first.tokens == tuple(near(target, 3).drafted)
    assert (first.forwards, first.unverified) == (0, len(first.tokens))
    assert not second.skipped
    assert second.tokens == tuple(near(target).drafted)  # verified strictly: AR's tokens
    assert [trust_of(r).reason for r in (first, second)] == ["trusted", "gate"]
    assert trust_of(first).loss is None


@torch.inference_mode()
def test_the_opening_decodes_of_every_episode_are_verified_and_audited() -> None:
    target = MockTarget()
    decoder = decoder_of(near(target), target, opening=2)
    assert reasons(decoder, 3) == ["opening", "opening", "trusted"]
    decoder.finish(True)
    decoder.reset("t", 1, np.zeros(3))
    record = decoder.decode(SHOWN)
    assert trust_of(record).audited
    assert trust_of(record).loss == 0.0


@torch.inference_mode()
def test_audits_are_a_random_share_that_the_episode_determines() -> None:
    target = MockTarget()
    one, other = (decoder_of(near(target), target, audit=0.3) for _ in range(2))
    drawn = reasons(one, 300)
    assert drawn == reasons(other, 300)
    assert 60 <= drawn.count("audit") <= 120
    one.reset("t", 1, np.zeros(3))
    assert reasons(one, 300) != drawn


@torch.inference_mode()
def test_bad_drafts_raise_an_alarm_after_which_everything_is_verified() -> None:
    target = ByPlace()
    source = near(target, 60)
    decoder = decoder_of(source, target, opening=3)
    records = [decoder.decode(SHOWN) for _ in range(6)]
    found = [trust_of(r).reason for r in records]
    assert found[0] == "opening"
    assert found[-1] == "alarm"
    assert all(trust_of(r).loss == 1.0 for r in records)
    assert found.index("alarm") <= 3
    first = next(r for r in records if trust_of(r).alarm)
    assert trust_of(first).audited
    decoder.reset("t", 1, np.zeros(3))
    assert reasons(decoder, 1) == ["opening"]


@torch.inference_mode()
def test_a_verified_loss_is_followed_by_another_verification() -> None:
    """A draft that is off by little, far from an alarm."""
    target = ByPlace()
    truth = np.array(near(target).drafted)
    source = near(target, 3)
    source.drafted = np.where(target.actions.strict_tokens(len(truth)), truth, source.drafted).tolist()
    decoder = decoder_of(source, target, opening=1, epsilon=0.1, delta=0.001, doubt=0.1)
    record = decoder.decode(SHOWN)
    assert 0.1 < trust_of(record).loss < 0.5
    assert reasons(decoder, 1) == ["doubt"]
    source.drafted = truth.tolist()
    assert reasons(decoder, 2) == ["doubt", "trusted"]


@torch.inference_mode()
def test_the_audited_loss_is_that_of_a_forward_over_the_draft() -> None:
    """The verification's own tokens against an independent forward, with a draft that is rejected on its way."""
    target = ByPlace()
    source = near(target, 5)
    decoder = decoder_of(source, target, opening=1)
    record = decoder.decode(SHOWN)
    chunk = Chunk(target.encode(SHOWN), decoder.steps, target.actions, decoder.cache, decoder.situation)
    wanted = target_tokens(target, chunk, source.drafted)
    n = len(wanted) - 1  # the prefill judges all but the last token
    assert trust_of(record).loss == pytest.approx(chunk_loss(target.actions, source.drafted[:n], wanted[:n], 0.1))


# --- the command line


def kerv(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def recorded(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with the policy `nano-state`, an early drafter and a recording of its risk."""
    from kerv_cli.methods.artifacts import MadeFor
    from kerv_cli.methods.early import EarlySettings
    from kerv_cli.methods.early.drafter import EarlyArtifact, EarlyDrafter
    from kerv_cli.targets.checkpoint import load_target

    results = tmp_path_factory.mktemp("risk")
    shutil.copytree(policies, results, dirs_exist_ok=True)
    target, description = load_target(results / "artifacts/target/nano-state")
    for name, seed in (("nano-state", 0), ("other", 1)):
        torch.manual_seed(seed)
        early = EarlyDrafter.beside(EarlySettings(width=16, layers=1), target)
        folder, own = results / "artifacts/early" / name, {"settings": asdict(early.settings)}
        EarlyArtifact().save(folder, early, MadeFor.of(description), {}, **own)
    code, output = kerv("calibrate", "risk", *common(results), "episodes=2", "features=true", "world.horizon=24")
    assert code == 0, output
    return results


def common(results: Path) -> tuple[str, ...]:
    return "task=[reach,push]", "policy.target=nano-state", f"results={results}"


def rollout(results: Path, *words: str) -> tuple[int, str]:
    method = ("method=one_pass_risk", "proposer=none", "record=0", "episodes=1", "world.horizon=24")
    return kerv("rollout", *common(results), *method, *words)


def test_a_recording_certifies_a_gate_and_names_what_is_missing(recorded: Path) -> None:
    folder = recorded / "artifacts/risk/nano-state"
    assert {path.name for path in folder.iterdir()} == {
        "risk.json",
        "decodes.parquet",
        "features.npy",
        "coverage.png",
    }
    code, output = rollout(recorded)
    assert code == 1
    assert "4 recorded episodes cannot certify a risk of 0.15 at δ = 0.1: 19 are needed" in output
    assert rollout(recorded, "skip.epsilon=0.9", "skip.delta=0.5")[0] == 0
    code, output = rollout(recorded, "skip.epsilon=0.9", "skip.delta=0.5", "skip.score=similarity")
    assert code == 1
    assert "no datastore" in output


def test_another_drafter_than_the_recorded_one_is_refused(recorded: Path) -> None:
    code, output = rollout(recorded, "skip.epsilon=0.9", "skip.delta=0.5", "policy.early=other")
    assert code == 1
    assert "was recorded for early drafter" in output
    assert "not for" in output


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("threshold.r=5", "threshold.r=9, not 5"),
        ("acceptance=strict", "acceptance.kind=relaxed, not strict"),
        ("chunk=2", "chunk=4, not 2"),
        ("runtime.dtype=bfloat16", "runtime.dtype=float32, not bfloat16"),
    ],
)
def test_a_level_of_another_decoding_is_refused_with_the_command_that_records_anew(
    recorded: Path, word: str, message: str
) -> None:
    code, output = rollout(recorded, "skip.epsilon=0.9", "skip.delta=0.5", word)
    assert code == 1
    assert f"the risk was recorded with {message}: run 'kerv calibrate risk {word} " in output


def test_a_recording_of_the_method_s_own_decoding_is_used(recorded: Path) -> None:
    decoding = ("threshold.r=5", "acceptance.strict_dofs=false", "chunk=2")
    code, output = kerv("calibrate", "risk", *common(recorded), *decoding, "name=own", "episodes=1", "world.horizon=24")
    assert code == 0, output
    gate = ("skip.epsilon=0.9", "skip.delta=0.5", "policy.risk=own", *decoding)
    code, output = rollout(recorded, *gate)
    assert code == 0, output


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("skip.epsilon=0", "skip.epsilon"),
        ("skip.delta=0.9", "skip.delta"),
        ("skip.score=odd", "did you mean odds"),
        ("prefill_draft=none", "it executes what one source drafts"),
    ],
)
def test_bad_input_gets_one_line(recorded: Path, word: str, message: str) -> None:
    code, output = rollout(recorded, word)
    assert code == 2
    assert message in output


def test_training_and_evaluation_seeds_are_not_calibrated_on(recorded: Path) -> None:
    for seed in (0, 100_000):
        code, output = kerv("calibrate", "risk", *common(recorded), f"seed={seed}")
        assert code == 2
        assert "seeds for selection are 50000 to 99999" in output


def test_a_damaged_recording_is_refused(recorded: Path, tmp_path: Path) -> None:
    results = tmp_path / "copy"
    shutil.copytree(recorded, results)
    path = results / "artifacts/risk/nano-state/decodes.parquet"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    code, output = rollout(results, "skip.epsilon=0.9", "skip.delta=0.5")
    assert code == 1
    assert "does not match its manifest" in output


@pytest.mark.bits
def test_an_interrupted_recording_goes_on_and_ends_as_an_undisturbed_one(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interrupted in the third of four episodes, the second one's record damaged; all the while the older recording
    stays in place."""
    folder = recorded / "artifacts/risk/nano-state"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    command = ("calibrate", "risk", *common(recorded), "episodes=2", "features=true", "world.horizon=24")
    ran: list[tuple[str, int]] = []

    def counted(world: Any, decoder: Any, seed: int) -> Any:
        ran.append((world.task, seed))
        if len(ran) == 3:
            raise KeyboardInterrupt
        return run_episode(world, decoder, seed)

    monkeypatch.setattr(risk_recording, "run_episode", counted)
    code, output = kerv(*command)
    assert code == 130
    assert "interrupted: finished episodes are kept" in output
    assert {name: (folder / name).read_bytes() for name in before} == before
    kept = sorted(folder.glob("records/*/*/*.safetensors"))
    assert [path.stem for path in kept] == ["050100", "050101"]
    kept[1].write_bytes(kept[1].read_bytes()[:-1] + b"\xff")
    assert "1 of them are recorded" in kerv(*command, "--plan")[1]
    assert "of them" not in kerv(*command, "unverified=0.5", "--plan")[1]  # another run's episodes are not taken
    code, output = kerv(*command)
    assert code == 0, output
    assert ran[3:] == [("reach-v3", 50_101), ("push-v3", 50_100), ("push-v3", 50_101)]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_learned_score_is_trained_and_used(recorded: Path) -> None:
    code, output = kerv("train", "score", "policy.target=nano-state", f"results={recorded}", "steps=20")
    assert code == 0, output
    assert "loss_of_all" in output
    again = ("episodes=2", "world.horizon=24", "seed=50200", "scores=[learned,odds]", "name=second")
    code, output = kerv("calibrate", "risk", *common(recorded), *again)
    assert code == 0, output
    gate = ("skip.score=learned", "skip.epsilon=0.9", "skip.delta=0.5", "policy.risk=second")
    code, output = rollout(recorded, *gate)
    assert code == 0, output
    made = json.loads((recorded / "artifacts/risk/second/risk.json").read_text())
    assert set(made["made_from"]) == {"early", "score"}
    code, output = rollout(recorded, *gate, "skip.level=0", "policy.early=other")
    assert code == 1
    assert "was trained for early drafter" in output
    third = ("policy.target=nano-state", f"results={recorded}", "steps=21", "policy.score=third")
    code, output = kerv("train", "score", *third)
    assert code == 0, output
    code, output = rollout(recorded, *gate, "policy.score=third")
    assert code == 1
    assert "was recorded for learned score" in output


def test_decodes_keep_why_they_were_verified(recorded: Path) -> None:
    import pandas as pd

    words = ("skip.level=-1e9", "skip.audit=0.5", "skip.opening=1", "skip.doubt=2", "skip.delta=1e-9")
    code, output = rollout(recorded, *words)
    assert code == 0, output
    path = max((recorded / "rollouts").glob("*/cells/*/decodes.parquet"), key=lambda found: found.stat().st_mtime)
    decodes, episodes = pd.read_parquet(path), pd.read_parquet(path.with_name("episodes.parquet"))
    assert decodes["reason"].iloc[0] == "opening"
    assert set(decodes["reason"]) <= {"opening", "audit", "alarm", "trusted", "doubt"}
    judged = decodes["loss"].notna()
    assert (judged == ~decodes["skipped"]).all()
    audits = decodes[decodes["reason"] == "audit"]
    assert episodes["audits"].sum() == len(audits) > 0
    assert episodes["audit_loss"].sum() == pytest.approx(audits["loss"].sum())
