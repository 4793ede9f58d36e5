"""A proposer with weights that is not kerv's: two files under examples/, and everything that kerv's own can do."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from command import told
from examples.own_proposer_table import FollowDrafter, FollowTable
from test_calibration import write_dataset

from kerv_cli.base.config import compose
from kerv_cli.base.spaces import Observation
from kerv_cli.catalogue.entries import find_runs, matching
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import RolloutSettings, settings_from
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.compose import Method
from kerv_cli.worlds.metaworld.spec import SPEC


def settings_of(results: Path, *overrides: str, name: str = "mine") -> RolloutSettings:
    words = [f"results={results}", "policy.target=nano-state", f"policy.artifacts.follow={name}", *overrides]
    return compose("rollout", words, RolloutSettings)


def files_of(asked: RolloutSettings) -> Artifacts:
    return Artifacts(asked.results, asked.policy)


@pytest.fixture
def results(policies, tmp_path):
    """The small policies, and a table of `nano-state`."""
    copied = Path(shutil.copytree(policies, tmp_path / "results"))
    random = np.random.default_rng(0)
    table = FollowTable.fit([random.integers(0, 255, (400, 4))], SPEC.actions)
    description = files_of(settings_of(copied)).description
    FollowDrafter().save(copied / "artifacts/follow/mine", table, MadeFor.of(description), {})
    return copied


@pytest.mark.bits
@pytest.mark.parametrize(
    ("overrides", "wanted"),
    [
        ("proposer=follow", {"follow"}),
        ("prefill_draft=follow proposer=drafter", {"follow", "drafter"}),
        ("prefill_draft=merged prefill_draft.sources=[follow] prefill_draft.fallback=[hold]", {"follow"}),
    ],
)
def test_every_place_loads_its_weights_once_and_decodes_ars_tokens(results, overrides, wanted):
    asked = settings_of(results, *overrides.split())
    method = Method.of(asked)
    assert set(method.needs) == wanted
    identity = check(asked)
    assert {"target", *wanted} == set(identity) - {"observation"}
    assert settings_from(dataclasses.asdict(asked)) == asked
    files = files_of(asked)
    assert files.load("follow") is files_of(asked).load("follow")
    decoder = method.decoder(files.target, files.load)
    plain = Decoder(files.target)
    state = np.random.default_rng(1).uniform(0, 0.5, 39)
    for chosen in (decoder, plain):
        chosen.reset("reach-v3", 0, np.zeros(3))
        chosen.observe(np.zeros(4), np.zeros(3))
    observation = Observation(state[:4], state, "reach the goal")
    record = decoder.decode(observation)
    assert record.tokens == plain.decode(observation).tokens
    assert any(r.proposer == "follow" or r.proposer == "merged" for r in record.rounds)


def test_its_weights_are_a_run_of_the_results_folder(results):
    (run,) = matching(find_runs(results), {"kind": "follow"})
    assert (run.id, run.state, run.is_training) == ("follow/mine", "complete", True)
    assert set(run.made_from) == {"target"}


@pytest.mark.usefixtures("quick_training")
def test_it_is_trained_from_the_command_line_and_drafts_in_a_rollout(results):
    write_dataset(results / "artifacts/demos/few")
    policy = ("policy.target=nano-state", "policy.artifacts.follow=learnt", f"results={results}")

    def run(*words):
        return told(*words, *policy)

    few = ("demos=few", "drafter.share=0.5", "train.steps=6", "train.batch=8", "train.validate_every=3", "train.lr=0.1")
    assert "table of" in run("train", "drafter", "drafter=follow", *few, "--plan")
    assert "score" in run("train", "drafter", "drafter=follow", *few)
    described = json.loads((results / "artifacts/follow/learnt/follow.json").read_text())
    assert described["settings"] == {"kind": "follow", "share": 0.5}
    run("rollout", "task=[reach]", "prefill_draft=follow", "episodes=1", "world.horizon=12", "record=0")
    files = files_of(settings_of(results, name="learnt"))
    assert files.check(["follow"])["follow"] == described["sha256"]
    assert not torch.equal(files.load("follow").logits, FollowTable(4, 255).logits)
