"""method=sp_vla (docs/methods.md §6.1): the regression, and when it takes the target's place."""

from typing import Any

import numpy as np
import pytest
import torch
from examples.own_target import MockTarget
from test_unverified import HOME, SHOWN

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.methods.kerv.prediction import Ridge
from kerv_cli.methods.sp_vla import SpeedSkip, SpeedSkipSettings
from kerv_cli.worlds.metaworld.spec import SPEC

SPACE = SPEC.actions


def least_squares(history: np.ndarray, penalty: float, steps: int) -> np.ndarray:
    """The ridge regression as ordinary least squares with two rows more, one per coefficient."""
    rows = np.stack([np.arange(len(history)), np.ones(len(history))], 1)
    left = np.concatenate([rows, np.sqrt(penalty) * np.eye(2)])
    right = np.concatenate([history, np.zeros((2, history.shape[1]))])
    slope, start = np.linalg.lstsq(left, right, rcond=None)[0]
    return np.stack([start + slope * (len(history) + ahead) for ahead in range(steps)])


@pytest.mark.parametrize("penalty", [0.0, 1e-4, 0.7, 50.0])
@pytest.mark.parametrize("window", [2, 6, 10])
def test_the_regression_is_that_of_least_squares(penalty, window):
    history = np.random.default_rng(window).uniform(-0.1, 0.1, (10, 4))  # small: nothing is clipped
    predicted = Ridge(SPACE.is_strict, penalty, window, 5).predict(history, 5)
    expected = least_squares(history[-window:], penalty, 5)
    expected[:, SPACE.is_strict] = history[-1, SPACE.is_strict]
    assert predicted == pytest.approx(expected, abs=1e-9)


def test_a_steep_line_ends_at_the_limits_and_a_short_history_gives_none():
    ridge = Ridge(SPACE.is_strict, 1e-4, 6, 4)
    climb = np.repeat(np.linspace(-0.5, 0.8, 6)[:, None], 4, 1)
    predicted = ridge.predict(climb, 4)
    assert predicted[-1] == pytest.approx([1.0, 1.0, 1.0, 0.8])
    assert ridge.predict(climb[1:], 4) is None


class Counting(MockTarget):
    """Counts the observations that it encodes."""

    encoded = 0

    def encode(self, observation: Observation) -> torch.Tensor:
        self.encoded += 1
        return super().encode(observation)


def played(speed: float, decodes: int, target: MockTarget, seeds: int = 1, **settings: Any) -> list[DecodeRecord]:
    """The decodes of episodes whose hand moves at `speed`, m/s, in every control step."""
    target_settings = SpeedSkipSettings(**settings)
    ridge = Ridge(SPACE.is_strict, target_settings.penalty, target_settings.buffer, target.chunk)
    decoder = Decoder(target, Parts(skip=SpeedSkip(target_settings, ridge)))
    records = []
    for seed in range(seeds):
        hand = HOME.copy()
        decoder.reset("t", seed, hand)
        for _ in range(decodes):
            records.append(decoder.decode(SHOWN))
            for action in records[-1].actions:
                hand = hand + np.array([0.6, 0.0, 0.8]) * speed / SPACE.control_hz
                decoder.observe(action, hand)
    return records


def schedule(records: list[DecodeRecord]) -> str:
    """t: the target decoded, r: the regression."""
    return "".join("r" if record.skipped else "t" for record in records)


@pytest.mark.parametrize(
    ("speed", "settings", "expected"),
    [
        (0.5, {}, "ttrtrtr"),  # six actions, then more than half of the last six must be the target's
        (0.29, {}, "ttttttt"),
        (0.5, {"v_max": 0.4}, "ttttttt"),
        (0.5, {"v_min": 0.51}, "ttttttt"),
        (0.5, {"share": 0.2}, "ttrrtrr"),
        (0.5, {"share": 1.0}, "ttttttt"),
        (0.5, {"buffer": 9}, "tttrrtt"),  # five of nine, then one of nine
        (0.5, {"buffer": 4}, "trtrtrt"),
    ],
)
def test_speed_and_the_targets_share_decide(speed, settings, expected):
    assert schedule(played(speed, 7, MockTarget(SPACE, 4), **settings)) == expected


def test_an_episode_begins_with_the_target_whatever_was_before():
    assert schedule(played(0.5, 3, MockTarget(SPACE, 4), seeds=2)) == "ttrttr"


def test_an_intuitive_decode_runs_nothing_of_the_target():
    target = Counting(SPACE, 4)
    *before, intuitive = played(0.5, 3, target)
    assert (intuitive.forwards, target.encoded) == (0, 2)
    assert [(r.mode, r.proposer) for r in intuitive.rounds] == [("skip", "ridge")]
    history = SPACE.normalise(np.concatenate([record.actions for record in before]))[-6:]
    line = np.clip(least_squares(history, 1e-4, 4), -1, 1)
    line[:, SPACE.is_strict] = history[-1, SPACE.is_strict]
    assert intuitive.tokens == tuple(SPACE.bins_of(line).flatten())
    assert intuitive.unverified == intuitive.actions.size == 16


def test_speeds_that_are_not_in_order_are_refused():
    with pytest.raises(UsageError, match=r"skip\.v_min=2 skip\.v_max=1"):
        check_settings(SpeedSkipSettings(v_min=2, v_max=1))
