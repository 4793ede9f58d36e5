"""The scout, the certificate of success, and the bets that a certificate rests on."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from command import kerv
from conftest import refused
from loaded import of_target

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_json
from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import Observation
from kerv_cli.cli.prepare import unsolved_by
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Use
from kerv_cli.methods.certified import CertifiedSkipSettings, ScopedSettings, certified, scoped
from kerv_cli.methods.certified.certificate import Candidate, Certificate, CertificateArtifact
from kerv_cli.methods.context import Context
from kerv_cli.methods.early import ScoutSettings
from kerv_cli.methods.early.drafter import ScoutDrafter, ScoutNetwork, ScoutProposer, check_sees
from kerv_cli.methods.merged import MergedProposerSettings
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.methods.unverified import AlwaysSkip, StreakSkip, StreakSkipSettings
from kerv_cli.report.certificate import folder_of, p_value, wealth
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.training.settings import PrepareSettings

pytestmark = pytest.mark.usefixtures("quick_report")

SMALL = ScoutSettings(width=24, rank=4, keypoints=4, cell_width=8, cell_features=2, word_width=4)
TASK = "drawer-close-v3"


@pytest.fixture(scope="module")
def target(policies):
    return load_target(policies / "artifacts/target/nano-vision")[0]


@pytest.fixture
def scout(target):
    torch.manual_seed(0)
    scout = ScoutDrafter().network(SMALL, target).eval().requires_grad_(False)
    for parameter in scout.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    return scout


def observed(target: CompactTarget, seed: int) -> Observation:
    random = np.random.default_rng(seed)
    size = target.settings.image_size
    images = {name: random.integers(0, 256, (size, size, 3), dtype=np.uint8) for name in target.cameras}
    state = random.normal(size=target.observation.state)
    return Observation(state[: len(target.observation.proprioception)], state, "close the drawer", images)


def decoder(target: CompactTarget, proposer: ScoutProposer, **parts: Any) -> Decoder:
    made = Decoder(target, Parts(prefill_draft=proposer, **parts))
    made.reset(TASK, 1, np.zeros(3))
    return made


def test_an_unverified_decode_never_runs_the_targets_encoder(target, scout, monkeypatch):
    proposer = ScoutProposer(scout, target)
    unverified = decoder(target, proposer, skip=AlwaysSkip(proposer))
    seen = [observed(target, i) for i in range(3)]
    monkeypatch.setattr(type(target), "encode_batch", lambda self, inputs: pytest.fail("encoded"))
    records = [unverified.decode(one) for one in seen]
    assert all(record.forwards == 0 and record.phases["vision"] == 0 for record in records)
    assert len({record.actions.tobytes() for record in records}) == 3  # it looks
    batch = BatchDecoder(unverified)
    episodes = [batch.new_episode() for _ in seen]
    for state in episodes:
        state.reset(TASK, 1, np.zeros(3))
    for one, together in zip(records, batch.decode(episodes, seen), strict=True):
        assert (one.actions == together.actions).all()


def test_verified_strictly_its_drafts_change_no_token(target, scout):
    plain, drafted = Decoder(target), decoder(target, ScoutProposer(scout, target))
    plain.reset(TASK, 1, np.zeros(3))
    for seed in range(4):
        one = observed(target, seed)
        record = drafted.decode(one)
        assert (record.actions == plain.decode(one).actions).all()
        assert record.phases["vision"] > 0  # encoded once, when the prefill asked


@pytest.mark.parametrize("views", [1, 2])
def test_packed_weights_give_the_same_draft(target, scout, views):
    inputs = target.inputs(observed(target, 0))
    inputs = dataclasses.replace(inputs, images=torch.cat([inputs.images, 255 - inputs.images][:views], -1))
    made = ScoutNetwork(scout.settings, target, views).eval().requires_grad_(False)
    with torch.no_grad():
        for part in made.modules():
            if isinstance(part, (torch.nn.Linear, torch.nn.RMSNorm, torch.nn.GroupNorm)):
                part.weight.normal_(0, 0.3)
    with torch.inference_mode():
        plain, places = made(inputs)
        compile_parts(made)
        assert made.compiled is not None
        compiled, again = made(inputs)
        other = made(dataclasses.replace(inputs, images=255 - inputs.images))[0]
        assert (other - compiled).abs().max() > 10 * (compiled - plain).abs().max()  # it reads the image
    assert torch.allclose(compiled, plain, rtol=1e-3, atol=1e-3)
    assert torch.allclose(again, places, atol=1e-4)


@pytest.mark.usefixtures("quick_training")
def test_it_is_trained_from_the_command_line_for_its_target_alone(demonstrated):
    words = ["train", "drafter", "drafter=scout", "demos=few", "policy.target=nano-vision"]
    words += ["policy.artifacts.scout=mine", "drafter.width=24", "drafter.rank=4", "train.batch=8", "train.steps=4"]
    words += ["train.scene_steps=2", "train.held_out=0.34", "train.validate_every=4"]
    done = kerv(*words, f"results={demonstrated}")
    assert "object_error_cm" in done.stdout
    target, description = load_target(demonstrated / "artifacts/target/nano-vision")
    files, folder = ScoutDrafter(), demonstrated / "artifacts/scout/mine"
    assert files.load(folder, of_target(description, target)).settings.width == 24
    state = load_target(demonstrated / "artifacts/target/nano-state")[0]
    with pytest.raises(CheckpointError):
        check_sees(state)
    rollout = ["rollout", "method=scout_unverified", f"task={TASK}", "episodes=1", "record=0", "world.horizon=12"]
    rollout += ["policy.target=nano-vision", f"results={demonstrated}"]
    kerv(*rollout, "policy.artifacts.scout=mine")
    missing = kerv(*rollout, code=1)
    assert "no scout in" in missing.stderr
    assert "kerv prepare policy.target=nano-vision" in missing.stderr


# --- the certificate


def certificate(target: CompactTarget, chosen: int | None, **changes: Any) -> Certificate:
    rules = [StreakSkipSettings(most=8, opening=1), NoSettings("always")]
    candidates = [
        Candidate(f"rule {i}", dataclasses.asdict(rule), 100, 95, 95, 1, 1, 0.01) for i, rule in enumerate(rules)
    ]
    plain = RolloutSettings().parts()
    method = {kind: dataclasses.asdict(part) for kind, part in plain.items() if kind not in ("prefill_draft", "skip")}
    fields: dict[str, Any] = {
        "target": target.sha256,
        "actions": target.actions,
        "chunk": target.chunk,
        "environment": "metaworld",
        "tasks": [TASK],
        "drafts": {"scout": "a"},
        "method": method,
        "world": {"camera": {"size": 96}, "horizon": 500},
        "dtype": "float32",
        "margin": 5.0,
        "delta": 0.1,
        "seeds": "50500-50519",
        "candidates": candidates,
        "chosen": chosen,
    }
    return Certificate(**{**fields, **changes})


def context(target: CompactTarget, artifacts: dict[str, Any], task: str, **method: Any) -> Context:
    settings = RolloutSettings(**{"prefill_draft": ScopedSettings(), **method}).parts()
    return Context(target, artifacts.__getitem__, task, {}, settings, 0)


def test_a_certified_task_gets_its_rule_and_any_other_a_streak(target, scout):
    artifacts: dict[str, Any] = {"certificate": certificate(target, 1), "scout": scout}
    drafts = ScopedSettings(outside="hold")
    for task, source, rule in ((TASK, "scout", AlwaysSkip), ("reach-v3", "hold", StreakSkip)):
        where = context(target, artifacts, task)
        where.built["prefill_draft"] = scoped(drafts, where)
        assert where.built["prefill_draft"].name == source
        assert isinstance(certified(CertifiedSkipSettings(most=4), where), rule)
    assert (
        "rule 1: not more than 5 points below AR on these 1 instruction, 90 % confidence"
        in artifacts["certificate"].sentence()
    )
    nothing = {**artifacts, "certificate": certificate(target, None)}
    assert certified(CertifiedSkipSettings(), context(target, nothing, TASK)) is None  # verified always
    first = {**artifacts, "certificate": certificate(target, 0)}
    where = context(target, first, TASK)
    where.built["prefill_draft"] = scoped(drafts, where)
    skip = certified(CertifiedSkipSettings(), where)
    assert isinstance(skip, StreakSkip)
    assert (skip.settings.most, skip.settings.opening) == (8, 1)


def test_a_certificate_of_another_draft_method_chunk_format_or_world_is_refused(target):
    def deploy(issued, **method):
        certified(CertifiedSkipSettings(), context(target, {"certificate": issued}, TASK, **method))

    issued = certificate(target, 0)
    with pytest.raises(UsageError, match=r"acceptance.kind=relaxed: the certificate is of strict"):
        deploy(issued, acceptance=NoSettings("relaxed"))
    for other in (NoSettings("early"), MergedProposerSettings()):
        with pytest.raises(UsageError, match=rf"prefill_draft={other.kind}: .* set prefill_draft=scoped"):
            deploy(issued, prefill_draft=other)
    issued.check_method(RolloutSettings(prefill_draft=NoSettings("scout")).parts(), "float32")  # the certified one
    with pytest.raises(UsageError, match=r"runtime.dtype=float32: the certificate is of bfloat16"):
        deploy(certificate(target, 0, dtype="bfloat16"))
    with pytest.raises(UsageError, match=r"chunk=4: the certificate is of 8"):
        deploy(certificate(target, 0, chunk=8))
    world = {"camera": {"size": 96}, "horizon": 500, "stress": {"kind": "push"}}
    CertificateArtifact().check_use(issued, Use({}, "float32", "metaworld", world=world))
    with pytest.raises(UsageError, match=r"world.horizon=120: the certificate is of 500"):
        CertificateArtifact().check_use(issued, Use({}, "float32", "metaworld", world={**world, "horizon": 120}))


def test_a_study_becomes_a_certificate_and_the_certificate_a_method(demonstrated, monkeypatch):
    study = demonstrated / "tiny.yaml"
    study.write_text(
        "common: method=early_unverified prefill_draft=hold proposer=none threshold.r=9 "
        f"task={TASK} seed=50500 episodes=2 record=0 world.horizon=8 policy.target=nano-vision\n"
        "block: 2\nsettings:\n  ar: method=ar prefill_draft=none\n  half: skip=streak skip.most=1\n  all: skip=always\n"
    )
    words = ["calibrate", "success", f"study={study}", "study.repeats=2", f"results={demonstrated}"]
    words += ["margin=99", "delta=0.5"]
    unsolved = kerv(*words)
    assert "nothing is certified: AR solved 0 of 2 episodes" in unsolved.stdout
    prepared = PrepareSettings(results=str(demonstrated), policy=PolicySettings(target="nano-vision"))
    assert "autoregressive decoding does not solve these tasks (0 % of its" in unsolved_by(prepared)
    monkeypatch.setattr("kerv_cli.report.certificate.SOLVED_BY_AR", 0.0)
    done = kerv(*words)
    assert "0/2" in done.stdout  # a repeat is no pair
    written = next(demonstrated.rglob("certificate.json"))
    serve = ["serve", "--plan", "policy.target=nano-vision", f"results={demonstrated}", "port=0"]
    serve += ["prefill_draft=scoped", "prefill_draft.outside=hold", "skip=certified"]
    kerv(*serve)
    deploy = ["rollout", "--plan", "method=one_pass_certified", "prefill_draft.outside=hold"]
    deploy += ["policy.target=nano-vision", f"task={TASK}", "threshold.r=9", "world.horizon=8"]
    deploy.append(f"results={demonstrated}")
    other = kerv(*deploy, code=2)  # before anything runs
    assert "with proposer.kind=drafter: the certificate is of none" in other.stderr
    kerv(*deploy, "proposer=none")
    issued = written.read_text()
    written.write_text(issued.replace('"environment": "metaworld"', '"environment": "elsewhere"'))
    refused = kerv(*serve, code=2)
    assert "with a policy of metaworld: the certificate is of elsewhere" in refused.stderr
    written.write_text(issued)
    kerv(*words)  # the same test again is no second test
    assert read_json(written)["earlier"] == []
    few = [*words[:-2], "margin=1", "delta=0.5", "policy.artifacts.certificate=few"]
    rollout = ["rollout", "method=ar", "policy.target=nano-vision", f"task={TASK}", "seed=50510", "episodes=1"]
    kerv(*rollout, "record=0", "world.horizon=8", f"results={demonstrated}")
    for more, says in (
        ([], "again=true to test on other seeds at delta=0.25"),
        (["again=true"], "seeds 50500-50501 served an earlier test"),
        (["again=true", "seed=50509"], "ran this policy on some of these seeds"),
    ):
        assert says in kerv(*few, *more, code=2).stderr
    assert "nothing is certified" in kerv(*few, "again=true", "seed=50520", "--json").stdout
    issued = read_json(demonstrated / "artifacts/certificate/few/certificate.json")
    (earlier,) = issued["earlier"]
    assert (issued["delta"], issued["seeds"]) == (0.25, "50520-50521")
    assert (earlier["seeds"], earlier["delta"], earlier["margin"]) == ("50500-50501", 0.5, 99.0)
    assert (earlier["order"], earlier["pairs"], earlier["certified"]) == (["half", "all"], 2, "all")
    kerv(*words, "seed=100000", code=2)


@pytest.mark.parametrize(
    ("ar", "scout", "common", "says"),
    [
        ("", "chunk=2", "", "setting 'scout' differs in chunk=: a certificate is of settings that differ in"),
        ("", "runtime.dtype=bfloat16", "", "setting 'scout' differs in runtime.dtype="),
        ("world.horizon=9", "", "", "setting 'ar' differs in world="),
        ("proposer=drafter", "", "", "'ar' has proposer=drafter: a certificate compares with AR, set proposer=none"),
        ("", "", "world.stress.kind=push world.stress.level=1", "says nothing of a stressed world"),
        ("", "", "rollout.clock=real", "rollout.clock=real: a certificate is of a world that waits"),
    ],
)
def test_settings_of_other_conditions_get_no_certificate(policies, tmp_path, ar, scout, common, says):
    study = tmp_path / "mixed.yaml"
    study.write_text(
        f"settings:\n  early: method=early_unverified\n  scout: method=scout_unverified {scout}\n  ar: method=ar {ar}\n"
    )
    words = f"policy.target=nano-vision task={TASK} seed=50500 {common} results={policies}"
    with refused(says, error=UsageError):
        folder_of(resolve([f"study={study}", *words.split()]))


def test_the_shipped_study_of_certificates_passes(policies):
    words = ["study=certify", "proposer=none", "policy.target=nano-vision", "policy.artifacts.certificate=mine"]
    assert folder_of(resolve([*words, f"results={policies}"])) == policies / "artifacts/certificate/mine"


# --- betting


def lost_and_won(random: np.random.Generator, pairs: int, lost: float, won: float) -> np.ndarray:
    """v of paired episodes of which these shares are solved by the baseline, by the method alone."""
    return random.choice([1.0, 0.5, 0.0], size=pairs, p=[lost, 1 - lost - won, won])


@pytest.mark.parametrize("groups", [1, 10])
def test_a_bet_against_a_true_hypothesis_errs_no_oftener_than_it_says(groups):
    """Means at the bound: skewed ones, two-point ones, those of tasks that differ in random order, and of pairs."""
    random, bound = np.random.default_rng(0), 0.1
    hard = np.repeat(np.linspace(0, 2 * bound, groups) if groups > 1 else [bound], 200 // groups)

    def share(draw, at=bound):
        return float(np.mean([p_value(draw(), at, 0.1) <= 0.1 for _ in range(400)]))

    most = 0.1 + 3 * math.sqrt(0.09 / 400)
    assert share(lambda: random.permutation(random.beta(0.2 * hard + 1e-9, 0.2 * (1 - hard)))) <= most
    assert share(lambda: (random.random(200) < random.permutation(hard)).astype(float)) <= most
    for lost, won in ((0.05, 0.0), (0.08, 0.03), (0.15, 0.1)):
        assert share(lambda lost=lost, won=won: lost_and_won(random, 210, lost, won), 0.525) <= most  # type: ignore[misc]


def test_bets_show_that_pairs_that_seldom_differ_lose_less_than_five_points():
    random = np.random.default_rng(1)
    shown = [p_value(lost_and_won(random, 210, 0.01, 0.01), 0.525, 0.1) <= 0.1 for _ in range(300)]
    assert np.mean(shown) >= 0.95


def test_bets_know_nothing_of_the_values_to_come():
    values = np.random.default_rng(2).random(30)
    changed = np.concatenate([values[:20], 1 - values[20:]])
    assert wealth(values, 0.5, 0.1)[:20] == pytest.approx(wealth(changed, 0.5, 0.1)[:20])
    assert p_value(np.zeros(0), 0.5, 0.1) == 1.0
