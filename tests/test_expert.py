"""The scripted expert in the policy's place: closed loop on real Meta-World, and every reader of its records."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from rerun_synthetic import read_recording

from kerv_cli.base.errors import KervError, UnknownName
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.episode import run_episode
from kerv_cli.episodes.policy import ExpertDecoder
from kerv_cli.episodes.rows import decodes_table, episode_row, read_decodes, table_blob
from kerv_cli.report.measures import MACRO, MICRO, measure
from kerv_cli.report.viewing import save_recording
from kerv_cli.report.viewing.token_outcomes import summary
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.settings import EVALUATION_SEED

NAME = "window-close-v3"
STAMPS = {"device": "cpu", "device_name": "x", "dtype": "float32", "threads": 1, "run": "r"}


@pytest.fixture(scope="module")
def world():
    with SPEC.open_world(NAME) as opened:
        yield opened


@pytest.fixture(scope="module")
def episode(world):
    return run_episode(world, ExpertDecoder(), EVALUATION_SEED)


def test_the_decoder_executes_the_experts_own_actions(world, episode):
    expert, observation, actions = SPEC.expert(NAME), world.reset(EVALUATION_SEED), []
    while not world.done:
        actions.append(expert(observation))
        observation = world.step(np.float32(actions[-1]))
    assert episode.success
    assert episode.steps == len(actions) > 10
    assert (episode.actions == np.float32(actions)).all()
    assert np.abs(episode.actions).max() == 1.0  # raw outputs reach far beyond


def test_a_record_has_one_step_and_no_target(episode):
    assert episode.decode_steps == tuple(range(episode.steps))
    for decode in episode.decodes:
        assert decode.actions.shape == (1, 4)
        assert decode.actions.dtype == np.float32
        assert (decode.mode, decode.forwards, decode.tokens, decode.rounds) == ("expert", 0, (), ())
        assert set(decode.phases) == set(PHASES)
        assert 0 < decode.seconds == pytest.approx(sum(decode.phases.values()))


def test_rows_keep_it_and_measures_are_undefined_instead_of_divided_by_zero(episode):
    row = episode_row(episode)
    assert (row["forwards"], row["verifications"], row["tokens"], row["first_rejected_count"]) == (0, 0, 0, 0)
    stored = read_decodes(table_blob(decodes_table(episode)))
    assert stored.equals(decodes_table(episode))
    third = stored.to_pylist()[3]
    assert third["actions"] == episode.decodes[3].actions.tolist()
    assert (third["mode"], third["tokens"], third["rounds"]) == ("expert", [], [])
    frame = pd.DataFrame([row | {"task": NAME, "seed": EVALUATION_SEED, "repeat": 0, "block": "b"}])
    frame = frame.assign(difficulty=SPEC.task(NAME).difficulty, initial_state=str(row["initial_state"]), **STAMPS)
    frame["decode_seconds"] = [np.array([decode.seconds for decode in episode.decodes])]
    slow = frame.assign(seconds=frame["seconds"] * 10, success=False)
    for averaging in (MICRO, MACRO):
        found = measure(frame, slow, averaging)
        assert found["success"] == 1.0
        assert (found["only_method"], found["both"]) == (1, 0)
        assert found["time_per_step_ms"] > 0
        assert found["forwards_per_step"] == found["skip_rate"] == 0.0
        assert all(math.isnan(found[name]) for name in ("AL", "accepted_per_round", "AFEP", "deviation"))


@pytest.mark.parametrize("frames", [False, True])
def test_its_recording_can_be_written_and_read(episode, tmp_path, frames):
    drawn = {i: np.zeros((8, 8, 3), dtype=np.uint8) for i in range(episode.steps + 1)} if frames else {}
    shown = dataclasses.replace(episode, frames=drawn)
    found = read_recording(save_recording(shown, tmp_path / "expert.rrd", method="expert"))
    rows = found["entities"]
    assert rows["/actions"] == rows["/decode/phases"] == rows["/decode/table"] == episode.steps
    assert rows["/mode"] == 1
    assert "/decode/acceptance" not in rows
    assert rows.get("/camera", 0) == len(drawn)
    assert found["blueprint"]
    assert found["episode"]["forwards"] == 0
    assert f"| modes | {episode.steps} expert |" in summary(shown, "expert")


def seen(state: np.ndarray) -> Observation:
    return Observation(state[:4], state)


def test_it_follows_the_task_and_refuses_what_it_cannot_answer():
    decoder = ExpertDecoder()
    with pytest.raises(KervError, match="reset it before decoding"):
        decoder.decode(seen(np.zeros(39)))
    decoder.reset(NAME, 0, np.zeros(3))
    state = np.random.default_rng(0).uniform(0, 0.3, 39)
    first = decoder.decode(seen(state)).actions
    decoder.reset("drawer-open-v3", 0, np.zeros(3))
    assert (decoder.decode(seen(state)).actions != first).any()
    with pytest.raises(KervError, match="a state it cannot read"):
        decoder.decode(seen(np.full(39, np.nan)))
    with pytest.raises(UnknownName, match="window-close"):
        decoder.reset("window-clos", 0, np.zeros(3))
