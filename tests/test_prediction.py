"""Kinematic predictors against references, and the accepted prefix that they complete (docs/methods.md §3.1)."""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mock_target import MockTarget
from test_decoding_lossless import plain_greedy

from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.chunk import WINDOW, Chunk, Follower
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.kerv import CompensateSettings, Compensation, find_predictor
from kerv_cli.methods.kerv.prediction import (
    HORIZON,
    PREDICTORS,
    Hold,
    Kalman,
    Linear,
    Noise,
    Predictor,
    Walk,
    assemble,
    kalman_weights,
)
from kerv_cli.worlds.metaworld.spec import SPEC

D, N = 4, 16
SPACE = SPEC.actions
TARGET = MockTarget(SPACE, chunk=N // D)
HOLD = Hold(SPACE.is_strict, minimum=1)


def compensation(**values: Any) -> Compensation:
    return Compensation(CompensateSettings(**values), HOLD)


def followed(follower: Any, *actions: list[float]) -> Any:
    for action in actions:
        follower.observe(SPACE.unnormalise(np.array(action)), np.zeros(3))
    return follower


ACTIONS = [0.1, 0.2, 0.3, 1.0], [0.2, 0.1, 0.3, 1.0]
PAST = followed(Follower(SPACE), *ACTIONS)


def chunk_with(episode: Follower) -> Chunk:
    return Chunk(N // D, SPACE, episode, None)  # type: ignore[arg-type]


@pytest.mark.parametrize("known", range(N + 1))
@pytest.mark.parametrize("min_verified", [0, 1, 2, 3])
def test_assembly_for_every_position(known, min_verified):
    """Transcribed from the definition: step by step, DoF by DoF, with `hold` as the prediction."""
    tokens = [10 * i for i in range(known)]
    settings = CompensateSettings(min_verified=min_verified)
    actions = assemble(tokens, chunk_with(PAST), HOLD, settings)
    expected: list[list[float]] = []
    last = [0.2, 0.1, 0.3, 1.0]
    for step in range(N // D):
        have = tokens[step * D : step * D + D]
        if step > 0 and (not have or len(have) < min_verified):
            break
        row = [float(SPACE.values_of(np.array(t))) for t in have]
        last = row + last[len(row) :]
        expected.append(last)
    assert actions == pytest.approx(np.array(expected))
    assert np.isfinite(actions).all()


@pytest.mark.parametrize("hold_strict", [True, False])
def test_a_drafts_gripper_fills_a_step_unless_strict_dofs_are_held(hold_strict):
    settings = CompensateSettings(hold_strict=hold_strict, min_verified=0)
    actions = assemble([10], chunk_with(PAST), HOLD, settings, drafted=[20, 30, 5])
    assert actions is not None
    assert actions[0, 3] == (1.0 if hold_strict else float(SPACE.values_of(np.array(5))))


def test_further_steps_are_predicted_from_the_accepted_prefix():
    settings = CompensateSettings(steps=3)
    tokens = [127, 127, 127, 254, 150]
    actions = assemble(tokens, chunk_with(PAST), Linear(SPACE.is_strict, minimum=2), settings)
    assert actions.shape == (4, 4)
    first = SPACE.values_of(np.array(tokens[:4]))
    slope = first - np.array([0.2, 0.1, 0.3, 1.0])
    assert actions[2, :3] == pytest.approx(np.clip(first + 2 * slope, -1, 1)[:3])
    assert actions[1, 0] == pytest.approx(SPACE.values_of(np.array(150)))
    assert actions[1:, 3] == pytest.approx(first[3])


def test_the_filter_rests_after_a_compensation():
    resting = compensation(rest=2)
    closed = []
    for _ in range(7):
        chunk = chunk_with(PAST)
        chunk.tokens = [1, 2]
        closed.append(resting.rectify(chunk) is not None)
        resting.next_decode()
    assert closed == [True, False, False, True, False, False, True]
    resting.reset()
    assert resting.resting == 0


def test_the_public_codes_filter_is_a_random_walk():
    """Against filterpy, with KERV's Q = 1 and R = 1e-3; the strict DoF is held, or filtered like the others."""
    actions = np.random.default_rng(0).uniform(-1, 1, (10, D))
    held = Walk(SPACE.is_strict)
    for predictor, strict in ((held, actions[-1, 3]), (held.released(), None)):
        expected = np.empty(D)
        for dof in range(D):
            model = KalmanFilter(dim_x=1, dim_z=1)
            model.F = model.H = np.eye(1)
            model.Q, model.R, model.P = np.array([[1.0]]), np.array([[1e-3]]), np.array([[1e-3]])
            model.x = actions[:1, dof : dof + 1]
            for action in actions[1:, dof]:
                model.predict()
                model.update(action)
            expected[dof] = model.x[0, 0]
        if strict is not None:
            expected[3] = strict
        assert predictor.predict(actions, 2) == pytest.approx(np.tile(expected, (2, 1)))


def test_a_gripper_is_filtered_only_with_a_fitted_noise():
    actions = np.random.default_rng(1).uniform(-1, 1, (10, D))
    unfitted, fitted = (Noise((1.0, 1.0, 1.0, q), (1.0,) * D) for q in (0.0, 1.0))
    assert Kalman(SPACE.is_strict, fitted).predict(actions, 1)[0, 3] == actions[-1, 3]
    free = Kalman(SPACE.is_strict, fitted).released().predict(actions, 1)[0]
    assert free[3] == pytest.approx(np.clip(kalman_weights(1.0, 1.0, 10, 1) @ actions[:, 3], -1, 1)[0])
    with pytest.raises(CheckpointError, match="replace=true"):
        Kalman(SPACE.is_strict, unfitted).released()


class Known(Proposer):
    """An in-prefill draft of these tokens; nothing may follow the prefill."""

    name = "known"

    def __init__(self, drafted: list[int]) -> None:
        self.drafted = drafted

    def begin(self, chunk: Chunk) -> None:
        raise AssertionError("nothing follows the prefill")

    committed = begin  # type: ignore[assignment]

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        return Draft.of(self.drafted)


PROMPT = torch.randn(1, 5, TARGET.width, generator=torch.Generator().manual_seed(3)).double()
TRUTH = plain_greedy(TARGET, PROMPT)


def rejected_at(wrong: int) -> list[int]:
    """The target's tokens, of which one is far off."""
    return [(token + 100) % 255 if i == wrong else token for i, token in enumerate(TRUTH)]


def decoder_of(drafted: list[int], rectifier: Compensation) -> Decoder:
    decoder = Decoder(TARGET, Parts(prefill_draft=Known(drafted), rectifier=rectifier))
    return followed(decoder, *ACTIONS)


@pytest.mark.parametrize("use_target_token", [True, False])
@pytest.mark.parametrize("wrong", range(N - 1))
def test_a_filled_step_drops_nothing(wrong, use_target_token):
    """The target's greedy tokens, given those that were filled; predicted values are executed without rounding."""
    drafted = rejected_at(wrong)[:-1]
    first = wrong + use_target_token
    filled = range(first, (wrong // D + 1) * D)
    rectifier = compensation(use_target_token=use_target_token, drop=False, min_verified=0, rest=4)
    decoder = decoder_of(drafted, rectifier)
    chunk = decoder.decode_prompt(PROMPT)
    if use_target_token and first % D == 0:  # a whole step would follow without a single token of the target
        filled = range(first, min(N, first + D))
    assert tuple(chunk.filled) == tuple(filled)
    assert chunk.closed is None
    assert len(chunk.tokens) == N
    assert chunk.tokens[:first] == TRUTH[:first]
    known = chunk.tokens[: first + len(filled)]
    rest = plain_greedy(TARGET, torch.cat([PROMPT, TARGET.embed(torch.tensor([known]))], 1))
    assert chunk.tokens == [*known, *rest][:N]
    step = first // D
    last = SPACE.values_of(np.array(chunk.tokens[step * D - D : step * D])) if step else PAST.history()[-1]
    executed = SPACE.normalise(chunk.actions(chunk.values(chunk.steps))).flatten()
    assert executed[list(filled)] == pytest.approx([last[index % D] for index in filled], abs=1e-6)
    assert decoder.parts.rectifier.resting == (5 if filled else 0)  # type: ignore[union-attr]


@pytest.mark.parametrize("use_target_token", [True, False])
@pytest.mark.parametrize("wrong", range(N - 1))
def test_one_forward_whatever_is_rejected(wrong, use_target_token):
    """An in-prefill draft whose token `wrong` is off: one forward, the target's tokens up to it, the rest predicted."""
    drafted = rejected_at(wrong)[:-1]
    rectifier = compensation(use_target_token=use_target_token)
    decoder = decoder_of(drafted, rectifier)
    chunk = decoder.decode_prompt(PROMPT)
    assert chunk.forwards == 1
    known = wrong + use_target_token
    assert chunk.tokens == TRUTH[:known]
    assert sum(r.committed for r in chunk.rounds) == known
    # where the target's own token was the last one nothing is missing, and nothing was predicted
    assert (chunk.closed is None) == (known == N)
    steps = max(1, -(-known // D))
    actions = chunk.actions(chunk.values(chunk.steps))
    assert actions.shape == (steps, D)
    assert chunk.compensated == steps * D - known
    assert actions.reshape(-1)[:known] == pytest.approx(SPACE.values_of(np.array(TRUTH[:known], dtype=int)), abs=1e-6)


@pytest.mark.parametrize("wrong", range(N - 1))
def test_what_the_rejected_draft_had_goes_before_the_prediction(wrong):
    """predictor=draft: behind the target's token come the draft's own values; the gripper is held."""
    drafted = [*rejected_at(wrong)[: wrong + 1], *range(wrong + 1, N)]
    decoder = decoder_of(drafted[:-1], compensation(predictor="draft"))
    chunk = decoder.decode_prompt(PROMPT)
    assert chunk.forwards == 1
    end = -(-(wrong + 1) // D) * D
    expected = SPACE.values_of(np.array([*TRUTH[: wrong + 1], *drafted[wrong + 1 : end]]))
    if end > wrong + 1:
        # whatever was drafted for the gripper, and whether or not it was: as in the step before
        expected[end - 1] = expected[end - 1 - D] if end > D else PAST.history()[-1][D - 1]
    assert chunk.closed.reshape(-1) == pytest.approx(expected)
    assert chunk.compensated == end - wrong - 1


@pytest.mark.parametrize("wrong", range(2 * D - 1))
def test_without_a_gripper_to_hold_the_drafts_is_taken(wrong):
    """predictor=draft at an episode's first decode: one forward all the same."""
    drafted = [*rejected_at(wrong)[: wrong + 1], *range(wrong + 1, N)]
    draft = Known(drafted[:-1])
    decoder = Decoder(TARGET, Parts(prefill_draft=draft, rectifier=compensation(predictor="draft")))
    chunk = decoder.decode_prompt(PROMPT)
    assert chunk.forwards == 1
    gripper = drafted[D - 1] if wrong < D - 1 else TRUTH[D - 1]  # the first step's, until it is known
    assert chunk.closed[-1, D - 1] == pytest.approx(SPACE.values_of(np.array(gripper)))


# --- kinematics

HELD = (False, False, False, True)


def noise_of(q: float, r: float) -> Noise:
    """The same for all DoFs."""
    return Noise((q,) * D, (r,) * D)


NOISE = {"kalman": noise_of(5.0, 0.5)}


@functools.cache
def predictor(kind: str, held: tuple[bool, ...] = HELD, **shape: int) -> Predictor:
    return PREDICTORS[kind](np.array(held), NOISE.get(kind), **shape)


def most_probable_path(window: np.ndarray, q: float, r: float, steps: int) -> np.ndarray:
    """(steps,): the reference, without a recursion. The first state and every random push are unknowns; the most
    probable ones are a weighted least-squares solution, and what is ahead goes on from them without a push."""
    transition, push = np.array([[1, 1], [0, 1]]), np.array([0.5, 1.0])
    pushes = len(window) - 1
    state = np.hstack([np.eye(2), np.zeros((2, pushes))])  # of time 0, in the unknowns
    first, rows = state.copy(), []
    for i in range(pushes):
        state = transition @ state
        state[:, 2 + i] += push
        rows.append(state[0].copy())
    pushed = np.eye(2 + pushes)[2:]
    known = [window[0], 0.0]
    weighted = np.vstack([first / np.sqrt(r), np.reshape(rows, (pushes, -1)) / np.sqrt(r), pushed / np.sqrt(q)])
    wanted = np.concatenate([np.array(known) / np.sqrt(r), window[1:] / np.sqrt(r), np.zeros(pushes)])
    unknowns, *_ = np.linalg.lstsq(weighted, wanted, rcond=None)
    ahead = []
    for _ in range(steps):
        state = transition @ state
        ahead.append(state[0] @ unknowns)
    return np.array(ahead)


log_scale = st.floats(-4, 3).map(lambda x: 10.0**x)


@given(
    arrays(np.float64, st.tuples(st.integers(2, 14), st.just(D)), elements=st.floats(-1, 1)),
    log_scale,
    log_scale,
    st.integers(1, HORIZON),
)
def test_a_filter_goes_on_along_the_newest_actions_most_probable_path_clipped(history, q, r, steps):
    ahead = PREDICTORS["kalman"](np.array(HELD), noise_of(q, r), minimum=2).predict(history, steps)
    for dof in range(D - 1):
        expected = most_probable_path(history[-WINDOW:, dof], q, r, steps)
        np.testing.assert_allclose(ahead[:, dof], np.clip(expected, -1, 1), rtol=1e-6, atol=1e-6)


def test_hold_and_linear():
    history = np.array([[0.9, 0.0, 0.1, 1.0], [0.2, 0.0, 0.2, 1.0], [0.3, 0.5, 0.1, -1.0]])
    held = Hold(np.array(HELD), minimum=1).predict(history, 2)
    np.testing.assert_allclose(held, [history[-1]] * 2)
    line = Linear(np.array(HELD), minimum=2).predict(history, 3)
    np.testing.assert_allclose(
        line, [[0.4, 1.0, 0.0, -1.0], [0.5, 1.0, -0.1, -1.0], [0.6, 1.0, -0.2, -1.0]], atol=1e-12
    )


@given(
    st.sampled_from(tuple(PREDICTORS)),
    arrays(np.float64, (7, D), elements=st.floats(-1, 1)),
    st.tuples(*[st.booleans()] * D),
    st.integers(0, HORIZON),
)
def test_predictions_are_bounded_and_held_dofs_keep_their_last_value(kind, history, held, steps):
    ahead = predictor(kind, held).predict(history, steps)
    assert ahead.shape == (steps, D)
    assert (np.abs(ahead) <= 1).all()
    assert (ahead[:, held] == history[-1, held]).all()
    moving = np.logical_not(held)
    free = predictor(kind, (False,) * D).predict(history, steps)
    assert (ahead[:, moving] == free[:, moving]).all()


@pytest.mark.parametrize(("kind", "least"), [("hold", 1), ("linear", 2), ("kalman", 4), ("walk", 4)])
def test_a_predictor_of_a_method_asks_for_as_many_actions_as_the_page_says(kind, least):
    calibrated = SimpleNamespace(noise=NOISE, window=WINDOW)
    target = SimpleNamespace(actions=SPACE, chunk=4)
    built = find_predictor(kind).predictor(Context(target, lambda kind: calibrated))
    assert built.predict(np.zeros((least - 1, D)), 1) is None
    assert built.predict(np.zeros((least, D)), 1) is not None
