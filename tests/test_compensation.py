"""Accepted prefix + prediction (METHODS §3.1) for every rejection position, and what the loop does with it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_decoding_lossless import plain_greedy, random_prompt, random_target

from kerv_cli.decoding.chunk import Chunk, Situation
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.decoding.rectify import Compensation, assemble
from kerv_cli.drafting.kinematics import ActionHistory, Hold, Linear
from kerv_cli.drafting.tree import TokenTree
from kerv_cli.errors import UsageError
from kerv_cli.settings import AcceptanceSettings, MethodSettings, OpeningSettings, RectifierSettings
from kerv_cli.spaces import values_of

D, N = 4, 16


def history_of(*actions: list[float]) -> ActionHistory:
    history = ActionHistory(D)
    for action in actions:
        history.append(np.array(action))
    return history


PAST = history_of([0.1, 0.2, 0.3, 1.0], [0.2, 0.1, 0.3, 1.0])


def chunk_with(history: ActionHistory) -> Chunk:
    target = random_target(0, 1, 1, N // D)
    return Chunk(torch.zeros(1, 1, 16), N, D, target.trunk.new_cache(1, 4), Situation("t", history))


@pytest.mark.parametrize("known", range(N + 1))
@pytest.mark.parametrize("min_verified", [0, 1, 2, 3])
def test_assembly_for_every_position(known: int, min_verified: int) -> None:
    """Transcribed from the definition: step by step, DoF by DoF, with `hold` as the prediction."""
    tokens = [10 * i for i in range(known)]
    settings = RectifierSettings("compensate", min_verified=min_verified)
    actions = assemble(tokens, chunk_with(PAST), Hold(D, minimum=1), settings)
    assert actions is not None
    expected: list[list[float]] = []
    last = [0.2, 0.1, 0.3, 1.0]
    for step in range(N // D):
        have = tokens[step * D : step * D + D]
        if step > 0 and (not have or len(have) < min_verified):
            break
        row = [float(values_of(np.array(t))) for t in have]
        last = row + last[len(row) :]
        expected.append(last)
    assert actions == pytest.approx(np.array(expected))
    assert np.isfinite(actions).all()


def test_further_steps_are_predicted_from_the_accepted_prefix() -> None:
    settings = RectifierSettings("compensate", steps=3)
    tokens = [127, 127, 127, 254, 150]
    actions = assemble(tokens, chunk_with(PAST), Linear(D, minimum=2), settings)
    assert actions is not None
    assert actions.shape == (4, 4)
    first = values_of(np.array(tokens[:4]))
    slope = first - np.array([0.2, 0.1, 0.3, 1.0])
    assert actions[2, :3] == pytest.approx(np.clip(first + 2 * slope, -1, 1)[:3])
    assert actions[1, 0] == pytest.approx(values_of(np.array(150)))
    assert actions[1:, 3] == pytest.approx(first[3])


def test_without_enough_history_the_target_decodes_on() -> None:
    chunk = chunk_with(history_of())
    chunk.tokens = [1, 2]
    assert not Compensation(RectifierSettings("compensate"), Hold(D, minimum=1)).close(chunk)
    assert chunk.closed is None


@pytest.mark.parametrize(("known", "closed"), [(5, [False, False, True]), (9, [False, True, True]), (13, [True] * 3)])
def test_a_chunk_is_not_closed_where_too_much_would_be_dropped(known: int, closed: list[bool]) -> None:
    found = []
    for most in (0, 1, 2):
        chunk = chunk_with(PAST)
        chunk.tokens = [100] * known
        found.append(Compensation(RectifierSettings("compensate", max_dropped=most), Hold(D, minimum=1)).close(chunk))
    assert found == closed


def test_the_filter_rests_after_a_compensation() -> None:
    compensation = Compensation(RectifierSettings("compensate", rest=2), Hold(D, minimum=1))
    closed = []
    for _ in range(7):
        chunk = chunk_with(PAST)
        chunk.tokens = [1, 2]
        closed.append(compensation.close(chunk))
        compensation.next_decode()
    assert closed == [True, False, False, True, False, False, True]
    compensation.reset()
    assert compensation.resting == 0


@pytest.mark.parametrize("use_verdict", [True, False])
@pytest.mark.parametrize("wrong", range(N))
def test_one_forward_whatever_is_rejected(wrong: int, use_verdict: bool) -> None:
    """An opening whose token `wrong` is off: one forward, target's tokens up to it, the step's rest predicted."""
    target = random_target(3, 2, 2, N // D)
    prompt = random_prompt(target, 3)
    truth = plain_greedy(target, prompt)

    class Opening:
        name = "opening"
        needs_states = False

        def begin(self, chunk: Chunk) -> None:
            raise AssertionError("nothing follows the prefill")

        committed = begin

        def propose(self, chunk: Chunk, depth: int) -> TokenTree:
            drafted = list(truth)
            drafted[wrong] = (drafted[wrong] + 100) % 255
            return TokenTree.chain(drafted)

    rectifier = RectifierSettings("compensate", use_verdict=use_verdict)
    opening = OpeningSettings(["opening"], N)
    method = MethodSettings("test", acceptance=AcceptanceSettings("strict"), rectifier=rectifier, opening=opening)
    decoder = Decoder(
        target, method, Parts(opening=Opening(), compensation=Compensation(rectifier, Hold(D, minimum=1)))
    )
    decoder.situation = Situation("t", PAST)
    chunk = decoder.decode_prompt(prompt)
    assert chunk.forwards == 1
    known = wrong + use_verdict
    assert chunk.tokens == truth[:known]
    assert sum(r.committed for r in chunk.rounds) == known
    if wrong == N - 1 and use_verdict:
        assert chunk.closed is None
        return
    steps = max(1, -(-known // D))
    assert chunk.closed is not None
    assert chunk.closed.shape == (steps, D)
    actions, predicted = decoder.actions_of(chunk)
    assert predicted == steps * D - known
    assert actions.reshape(-1)[:known] == pytest.approx(values_of(np.array(truth[:known], dtype=int)), abs=1e-6)


@pytest.mark.parametrize("wrong", range(N - 1))
def test_what_the_rejected_draft_had_goes_before_the_prediction(wrong: int) -> None:
    """predictor=draft: behind the verdict the step is filled with the draft's own values, at the first decode too."""
    target = random_target(3, 2, 2, N // D)
    prompt = random_prompt(target, 3)
    truth = plain_greedy(target, prompt)
    drafted = [(t + 100) % 255 if i == wrong else t if i < wrong else i for i, t in enumerate(truth)]

    class Opening:
        name = "opening"
        needs_states = False

        def propose(self, chunk: Chunk, depth: int) -> TokenTree:
            return TokenTree.chain(drafted[:depth])

    rectifier = RectifierSettings("compensate", predictor="draft")
    opening = OpeningSettings(["opening"], N)
    method = MethodSettings("test", acceptance=AcceptanceSettings("strict"), rectifier=rectifier, opening=opening)
    parts = Parts(opening=Opening(), compensation=Compensation(rectifier, Hold(D, minimum=1)))  # type: ignore[arg-type]
    decoder = Decoder(target, method, parts)
    chunk = decoder.decode_prompt(prompt)
    assert chunk.forwards == 1
    end = min(-(-(wrong + 1) // D) * D, N)
    if (
        end == N
    ):  # the last token of all was not drafted, the bonus would have filled it: without a history it is decoded
        assert chunk.closed is None or len(chunk.closed) == N // D
        return
    expected = [*truth[: wrong + 1], *drafted[wrong + 1 : end]]
    assert chunk.closed is not None
    assert chunk.closed.reshape(-1) == pytest.approx(values_of(np.array(expected)))
    assert decoder.actions_of(chunk)[1] == end - wrong - 1


def test_a_draft_that_goes_on_needs_the_verdict() -> None:
    with pytest.raises(UsageError, match="use_verdict"):
        Compensation(RectifierSettings("compensate", predictor="draft", use_verdict=False), Hold(D, minimum=1))


def test_an_opening_that_needs_states_is_refused() -> None:
    class Late:
        name = "late"
        needs_states = True

    with pytest.raises(UsageError, match="needs the target's states"):
        Decoder(random_target(0, 1, 1, 1), MethodSettings(), Parts(opening=Late()))  # type: ignore[arg-type]
