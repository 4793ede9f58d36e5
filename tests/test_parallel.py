"""A target that decodes all tokens of a chunk at once (docs/methods.md §6)."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.parallel import ParallelPass
from kerv_cli.targets.compact.folder import save_target
from kerv_cli.targets.compact.packable import pack
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.training.imitation import check_init, continued_target
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC

WORDS = WordTokenizer.build(["pull the drawer open"])


def nano(*overrides: str) -> TargetSettings:
    words = ["target=nano", "target.observation=state", "target.chunk=2", *overrides]
    return compose("train_target", words, TrainTargetSettings).target


def target(*overrides: str) -> CompactTarget:
    torch.manual_seed(1)
    made = CompactTarget(nano(*overrides), SPEC.actions, SPEC.observation, WORDS)
    torch.nn.init.normal_(made.head.weight, std=1.0)
    return made.eval()


def some_observation(seed: int = 0) -> Observation:
    rng = np.random.default_rng(seed)
    space = SPEC.observation
    return Observation(
        rng.normal(size=len(space.proprioception)), rng.normal(size=space.state), "pull the drawer open", {}
    )


def oracle(policy: CompactTarget, prompt: torch.Tensor) -> list[int]:
    """The tokens by explicit loops over rows: the prompt is causal, every query sees everything."""
    x = torch.cat([prompt, policy.queries[None]], 1)
    length, size = x.shape[1], prompt.shape[1]
    mask = torch.full((length, length), -torch.inf)
    for row in range(length):
        mask[row, : row + 1 if row < size else length] = 0
    rotary = policy.trunk.rotary(torch.arange(length))
    for layer in policy.trunk.layers:
        x = layer(x, rotary, mask=mask)
    return policy.head(policy.trunk.norm(x))[0, size:].argmax(-1).tolist()


@pytest.mark.bits
@torch.inference_mode()
@pytest.mark.parametrize("packed", [False, True])
def test_all_tokens_come_from_one_forward_in_which_they_see_each_other(packed):
    policy = target("target.parallel=true")
    wanted = oracle(policy, policy.encode(some_observation()))
    if packed:
        pack(policy)
    decoder = Decoder(policy, Parts(skip=ParallelPass(policy)))
    decoder.reset("", 0, np.zeros(3))
    record = decoder.decode(some_observation())
    assert list(record.tokens) == wanted
    assert len(set(wanted)) > 1
    assert (record.forwards, record.mode, record.unverified) == (1, "parallel", policy.chunk * policy.actions.dofs)
    assert record.phases["prefill"] > 0


@pytest.mark.bits
def test_training_shows_it_no_action_token():
    policy = target("target.parallel=true")
    one = some_observation()
    inputs: Inputs = policy.inputs(one)
    first = torch.zeros(1, 8, dtype=torch.long)
    logits = [policy.teacher_forced(inputs, tokens)[0] for tokens in (first, first + 5)]
    assert torch.equal(*logits)


def test_it_continues_an_autoregressive_target_with_fresh_queries():
    plain = target()
    made = continued_target(nano("target.parallel=true"), plain, "")
    assert torch.equal(made.head.weight, plain.head.weight)
    assert made.queries.shape == (8, plain.width)
    described = type("D", (), {"settings": vars(plain.settings), "cameras": plain.cameras})()
    check_init(nano("target.parallel=true"), "", described, Path("x"))
    with pytest.raises(UsageError):
        check_init(nano("target.parallel=true", "target.width=64"), "", described, Path("x"))


@pytest.fixture
def results(tmp_path):
    for name, policy in (("plain", target()), ("parallel", target("target.parallel=true"))):
        save_target(tmp_path / "artifacts/target" / name, policy, "metaworld", {})
    return tmp_path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("policy.target=plain method=parallel", "decodes token by token"),
        ("policy.target=parallel method=ar", "use method=parallel"),
        ("policy.target=parallel method=spec_vla", "use method=parallel"),
        ("policy.target=parallel method=parallel proposer=jacobi", "proposer=jacobi: nothing is drafted"),
        ("policy.target=parallel method=parallel deviation_every=2", "no AR to differ from"),
    ],
)
def test_target_and_method_must_fit(results, words, message):
    settings = compose("rollout", [f"results={results}", "task=drawer-open-v3", *words.split()], RolloutSettings)
    with pytest.raises(UsageError, match=message):
        check(settings)
