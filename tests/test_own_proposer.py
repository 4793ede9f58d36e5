"""A proposer with weights that is not kerv's: two files under examples/, and everything that kerv's own can do."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
import torch
from command import told
from examples.own_proposer_table import FollowProposer, FollowTable
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_target import MockTarget
from test_calibration import write_dataset
from test_decoding_lossless import assert_adds_up, plain_greedy, random_prompt, random_target

from kerv_cli.base.config import compose
from kerv_cli.base.settings import read_settings
from kerv_cli.base.spaces import Observation
from kerv_cli.catalogue.entries import find_runs, matching
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import opened
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.compose import Method
from kerv_cli.methods.kerv.prediction import Hold, PredictionProposer
from kerv_cli.methods.merged import MergedProposer

POLICY = ("policy.target=nano-state", "policy.artifacts.follow=learnt")
PLACES = {
    "proposer=follow": {"follow"},
    "prefill_draft=follow proposer=drafter": {"follow", "drafter"},
    "prefill_draft=merged prefill_draft.sources=[follow] prefill_draft.fallback=[hold]": {"follow"},
}
"""Overrides that put the proposer in every place -> the artifacts that the method then needs."""


@pytest.mark.bits
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), chunk=st.sampled_from([1, 2, 4]), depth=st.integers(0, 20), data=st.data())
@pytest.mark.parametrize("place", ["proposer", "prefill_draft", "merged"])
@pytest.mark.parametrize("mock", [True, False])
def test_it_is_lossless_wherever_it_drafts(place, mock, seed, chunk, depth, data):
    if mock:
        target: Any = MockTarget(chunk=chunk, seed=seed)
        prompt = torch.randn(1, 5, target.width, generator=torch.Generator().manual_seed(seed)).double()
    else:
        target = random_target(seed, 2, 2, chunk)
        prompt = random_prompt(target, seed)
    space, random = target.actions, np.random.default_rng(seed)
    truth = plain_greedy(target, prompt)
    before = random.integers(0, space.tokens, (1, space.dofs))
    steps = np.concatenate([before, np.reshape(truth, (chunk, space.dofs))])
    own = FollowProposer(FollowTable.fit([steps[: data.draw(st.integers(1, len(steps)))]], space), depth)
    hold = PredictionProposer(Hold(space.is_strict, minimum=1, horizon=chunk))
    parts = {
        "proposer": Parts(proposer=own),
        "prefill_draft": Parts(prefill_draft=own, proposer=own),
        "merged": Parts(prefill_draft=MergedProposer([own], 40, [hold])),
    }[place]
    decoder = Decoder(target, parts)
    if data.draw(st.booleans(), "executed"):
        decoder.observe(space.unnormalise(space.values_of(before[0])), np.zeros(3))
    for _ in range(2):
        result = decoder.decode_prompt(prompt)
        assert result.tokens == truth
        assert_adds_up(result)


@pytest.mark.bits
@pytest.mark.usefixtures("quick_training")
def test_it_is_trained_from_the_command_line_and_drafts_in_every_place(results):
    write_dataset(results / "artifacts/demos/few")

    def run(*words):
        return told(*words, *POLICY, f"results={results}")

    few = ("demos=few", "drafter.share=0.5", "train.steps=6", "train.batch=8", "train.validate_every=3", "train.lr=0.1")
    assert "table of" in run("train", "drafter", "drafter=follow", *few, "--plan")
    assert "score" in run("train", "drafter", "drafter=follow", *few)
    (entry,) = matching(find_runs(opened(results)), {"kind": "follow"})
    assert (entry.id, entry.state) == ("follow/learnt", "complete")
    assert "target" in entry.made_from
    described = json.loads((results / "artifacts/follow/learnt/follow.json").read_text())
    assert described["settings"] == {"kind": "follow", "share": 0.5}
    run("rollout", "task=[reach]", "prefill_draft=follow", "episodes=1", "world.horizon=12", "record=0")
    for overrides, wanted in PLACES.items():
        asked = compose("rollout", [*POLICY, "task=reach", f"results={results}", *overrides.split()], RolloutSettings)
        method, files = Method.of(asked), Artifacts(asked.results, asked.policy)
        assert set(method.needs) == wanted
        identity = check(asked)
        assert set(identity) - {"observation"} == {"target", *wanted}
        assert identity["follow"] == described["sha256"]
        assert read_settings(RolloutSettings, dataclasses.asdict(asked)) == asked
        assert files.load("follow") is Artifacts(asked.results, asked.policy).load("follow")
        assert not torch.equal(files.load("follow").logits, FollowTable(4, 255).logits)
        plain, drafting = Decoder(files.target), method.decoder(files.target, files.load)
        state = np.random.default_rng(1).uniform(0, 0.5, 39)
        for decoder in (plain, drafting):
            decoder.reset("reach-v3", 0, np.zeros(3))
            decoder.observe(np.zeros(4), np.zeros(3))
        record, truth = (one.decode(Observation(state[:4], state, "reach the goal")) for one in (drafting, plain))
        assert record.tokens == truth.tokens
        assert any("follow" in r.proposer.split("+") for r in record.rounds)
