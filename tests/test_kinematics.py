"""Kinematic prediction: precomputed weights against weighted least squares, closed forms, held DoFs, the history."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kerv_cli.engine.chunk import WINDOW, ActionHistory
from kerv_cli.methods.kerv.prediction import (
    FILTERS,
    HORIZON,
    PREDICTORS,
    Hold,
    Linear,
    Noise,
    Predictor,
    kalman_weights,
)

DOFS = 4
HELD = (False, False, False, True)


def noise_of(q: float, r: float, damping: float) -> Noise:
    """The same for all DoFs."""
    return Noise((q,) * DOFS, (r,) * DOFS, (damping,) * DOFS)


NOISE = {name: noise_of(5.0, 0.5, 0.8 if name == "damped" else 1.0) for name in FILTERS}


@functools.cache
def predictor(kind: str, held: tuple[bool, ...] = HELD, **shape: int) -> Predictor:
    return PREDICTORS[kind](np.array(held), NOISE.get(kind), **shape)


def most_probable_path(window: np.ndarray, q: float, r: float, steps: int, damping: float = 1.0) -> np.ndarray:
    """(steps,): the reference, without a recursion. The first state and every random push are unknowns; the most
    probable ones are a weighted least-squares solution, and what is ahead goes on from them without a push."""
    transition, push = np.array([[1, damping], [0, damping]]), np.array([0.5, 1.0])
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


windows = st.integers(2, WINDOW).flatmap(lambda n: arrays(np.float64, n, elements=st.floats(-1, 1)))
log_scale = st.floats(-4, 3).map(lambda x: 10.0**x)


@settings(deadline=None)  # the machine is shared
@given(windows, log_scale, log_scale, st.integers(1, HORIZON), st.sampled_from([1.0, 0.7]))
def test_the_weights_are_those_of_the_most_probable_path(window, q, r, steps, damping):
    weights = kalman_weights(q, r, len(window), steps, damping)
    assert weights.shape == (steps, len(window))
    expected = most_probable_path(window, q, r, steps, damping)
    np.testing.assert_allclose(weights @ window, expected, rtol=1e-6, atol=1e-6)


@settings(deadline=None)  # the machine is shared
@given(arrays(np.float64, st.tuples(st.integers(3, 14), st.just(DOFS)), elements=st.floats(-1, 1)))
def test_predict_goes_on_along_the_newest_actions_most_probable_path_clipped(history):
    for kind in FILTERS:
        noise = NOISE[kind]
        ahead = predictor(kind, minimum=3).predict(history, 4)
        for dof in range(DOFS - 1):
            window = history[-WINDOW:, dof]
            expected = most_probable_path(window, noise.q[dof], noise.r[dof], 4, noise.damping[dof])
            np.testing.assert_allclose(ahead[:, dof], np.clip(expected, -1, 1), atol=1e-9)


def test_hold_and_linear():
    history = np.array([[0.9, 0.0, 0.1, 1.0], [0.2, 0.0, 0.2, 1.0], [0.3, 0.5, 0.1, -1.0]])
    held = Hold(np.array(HELD), minimum=1).predict(history, 2)
    np.testing.assert_allclose(held, [history[-1]] * 2)
    line = Linear(np.array(HELD), minimum=2).predict(history, 3)
    np.testing.assert_allclose(
        line, [[0.4, 1.0, 0.0, -1.0], [0.5, 1.0, -0.1, -1.0], [0.6, 1.0, -0.2, -1.0]], atol=1e-12
    )


@settings(deadline=None)  # the machine is shared
@given(
    st.sampled_from(tuple(PREDICTORS)),
    arrays(np.float64, (7, DOFS), elements=st.floats(-1, 1)),
    st.tuples(*[st.booleans()] * DOFS),
    st.integers(0, HORIZON),
)
def test_predictions_are_bounded_and_held_dofs_keep_their_last_value(kind, history, held, steps):
    ahead = predictor(kind, held).predict(history, steps)
    assert ahead.shape == (steps, DOFS)
    assert (np.abs(ahead) <= 1).all()
    assert (ahead[:, held] == history[-1, held]).all()
    moving = np.logical_not(held)
    free = predictor(kind, (False,) * DOFS).predict(history, steps)
    assert (ahead[:, moving] == free[:, moving]).all()


@pytest.mark.parametrize("kind", PREDICTORS)
def test_a_short_history_gives_no_prediction(kind):
    built = predictor(kind, minimum=5)
    assert built.predict(np.zeros((4, DOFS)), 1) is None
    assert built.predict(np.zeros((0, DOFS)), 1) is None
    assert built.predict(np.zeros((5, DOFS)), 1) is not None


def test_the_history_keeps_the_newest():
    history = ActionHistory(DOFS, window=3)
    assert history.values().shape == (0, DOFS)
    for i in range(5):
        history.append(np.full(DOFS, i / 10))
    assert len(history.values()) == 3
    np.testing.assert_allclose(history.values()[:, 0], [0.2, 0.3, 0.4])
    extended = history.values(np.full((2, DOFS), 0.9))  # known steps of the chunk take the newest places
    np.testing.assert_allclose(extended[:, 0], [0.4, 0.9, 0.9])
    np.testing.assert_allclose(history.values()[:, 0], [0.2, 0.3, 0.4])
    history = ActionHistory(DOFS, window=3)
    np.testing.assert_allclose(history.values(np.full((1, DOFS), 0.9)), np.full((1, DOFS), 0.9))
