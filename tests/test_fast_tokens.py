"""Targets with FAST tokens: what drafts for them, what is refused, acceptance and stopping by motion."""

from dataclasses import replace

import numpy as np
import pytest
from mock_target import SEVEN, MockTarget

from kerv_cli.base.codes import FastCode
from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import BoundaryPart, part_of
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decisions import TokenTree
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.compose import Method
from kerv_cli.methods.context import Context
from kerv_cli.methods.motion import MotionRule
from kerv_cli.methods.reuse import LookupProposer, LookupProposerSettings
from kerv_cli.methods.settings import MethodSettings
from kerv_cli.report.viewing.token_outcomes import chunk_size, decode_table, outcomes_of, token_names

RNG = np.random.default_rng(0)
CHUNKS = np.cumsum(RNG.normal(0, 0.2, (400, 4, 7)), 1).clip(-1, 1)
SPACE = replace(SEVEN, low=(-1.0,) * 7, high=(1.0,) * 7, code=FastCode.learn(CHUNKS))
TARGET = MockTarget(SPACE, 4, seed=2)


def shown(number: int) -> Observation:
    return Observation(np.array([0.1 * number]), np.zeros(0), "word " * 3)


def chosen(**names: str) -> Method:
    """A method of default parts, and of these."""
    settings = MethodSettings(**{kind: part_of(kind, name).default for kind, name in names.items()})
    return Method.of(settings)


@pytest.mark.parametrize(
    "parts",
    [
        {"acceptance": "relaxed"},
        {"acceptance": "sequence"},
        {"threshold": "offset"},
        {"rectifier": "compensate"},
        {"proposer": "kalman"},
        {"prefill_draft": "hold"},
        {"skip": "streak", "prefill_draft": "early"},
    ],
)
def test_parts_that_need_a_distance_are_refused_in_one_line(parts):
    chosen(acceptance="strict").check(TARGET)
    with pytest.raises(UsageError, match=r"needs a distance between tokens.*method=naive_sd"):
        chosen(**{"acceptance": "strict", **parts}).check(TARGET)


@pytest.mark.parametrize("parts", [{"acceptance": "motion"}, {"boundary": "coarse"}])
def test_what_needs_a_code_is_refused_for_bins(parts):
    with pytest.raises(UsageError, match=r"tokens are bins.*target\.code=fast"):
        chosen(**{"acceptance": "strict", **parts}).decoder(MockTarget(SEVEN, 4, seed=2), lambda kind: None)


def test_lookup_drafts_what_followed_in_earlier_chunks_and_loses_nothing():
    proposer = LookupProposer(LookupProposerSettings())
    plain = Decoder(TARGET)
    fast = Decoder(TARGET, Parts(prefill_draft=proposer, proposer=proposer))
    accepted = 0
    for number in (0, 0, 1, 1, 2):  # the same observation again gives the same chunk, which is accepted whole
        expected, record = plain.decode(shown(number)), fast.decode(shown(number))
        assert record.tokens == expected.tokens
        accepted += sum(one.accepted for one in record.rounds)
    assert accepted
    chunk = fast._new_chunk(TARGET.encode(shown(0)))
    chunk.episode.decoded[:] = [[3, 5, 6, 2, 4], [5, 6, 7, 5, 6, 8, 9]]
    for committed, drafted in (
        ([], [5, 6, 7]),
        ([5, 6], [7, 5, 6]),
        ([1, 5, 6], [7, 5, 6]),
        ([1, 1, 1, 5, 6], [8, 9]),
        ([7, 9, 1], [5, 6, 8]),
        ([3, 5, 6], [2, 4]),
    ):
        chunk.tokens[:] = committed
        assert proposer.chains(chunk, 3) == [drafted]


def test_motion_accepts_what_moves_alike_and_the_actions_stay_within_the_tolerance():
    code, tolerance = SPACE.code, 0.2
    assert code is not None
    rule, middle = MotionRule(SPACE, tolerance), code.highest
    near, far = middle + 1, middle + 20  # the first coefficient, 1 or 20 above zero
    gap = np.abs(code.values([1]) - code.values([0])).max()
    assert rule.difference([], near, middle) == pytest.approx(gap)
    # after other tokens, too, and for a merged token against the end
    before, merged = [middle, far, near], code.end - 1
    found = code.decode([*before, merged])
    unclipped = rule.basis[: len(found)].T @ np.array(found) - rule.basis[: len(before)].T @ np.array(
        code.decode(before)
    )
    assert rule.difference(before, merged, code.end) == pytest.approx(np.abs(unclipped).max())
    tree = TokenTree.build([near, far, near], [-1, -1, 0])
    assert rule.judge_after([], tree, [middle, middle, middle, middle], 0) == ((0, 2), None)
    assert rule.judge_after([], tree, [far, middle, middle, middle], 0) == ((1,), None)
    assert MotionRule(SPACE, 0.0).judge_after([], tree, [near, near, far, far], 0) == ((0, 2), None)
    # later coefficients are the target's to choose: no end in place of a zero, no token of more coefficients
    assert rule.difference([], code.end, middle) == 0
    assert rule.judge_after([], TokenTree.build([code.end], [-1]), [middle, middle], 0).path == ()
    longer = next(token for token in range(2 * middle + 1, code.end) if set(code.parts[token][1:]) <= {0})
    first = code.parts[longer][0] + middle
    assert rule.judge_after([], TokenTree.build([longer], [-1]), [first, middle], 0).path == ()
    assert rule.judge_after([], TokenTree.build([first], [-1]), [longer, middle], 0).path == (0,)
    # nothing is accepted after an end token
    ended = TokenTree.build([code.end, near], [-1, 0])
    assert rule.judge_after([], ended, [code.end, near, near], 0).path == (0,)


def test_a_coarse_boundary_ends_chunks_early_with_a_complete_motion():
    context = Context(TARGET, lambda kind: None)
    settings = BoundaryPart.find("coarse").settings(tokens=3)
    coarse = BoundaryPart.find("coarse").built(settings, context)
    record, whole = (Decoder(TARGET, parts).decode(shown(1)) for parts in (Parts(boundary=coarse), Parts()))
    assert record.tokens == whole.tokens[:3]
    assert record.size == record.forwards == 3
    assert record.actions.shape == whole.actions.shape


def test_tokens_of_a_code_are_shown_by_their_place_alone():
    decoder = Decoder(TARGET)
    records = [decoder.decode(shown(number)) for number in range(4)]
    assert token_names(records, SPACE.names) == ["token"]
    size = chunk_size(records, 1)
    assert size == max(len(record.tokens) for record in records)
    for record in records:
        outcomes = outcomes_of(record, size, 1)
        kinds = [outcome.kind for outcome in outcomes]
        assert kinds == ["target"] * len(record.tokens) + ["ended"] * (size - len(record.tokens))
        *_, titles, _, rows = decode_table(record, 0, 0, outcomes, ["token"]).split("\n", 5)
        assert titles == "| token | draft | target | r | kept | outcome |"
        assert len(rows.splitlines()) == len(record.tokens)
    bins = Decoder(MockTarget(SEVEN, 4, seed=2)).decode(shown(1))
    assert token_names([bins], SEVEN.names) == SEVEN.names
    alone = replace(bins, actions=bins.actions[:, :1], tokens=bins.tokens[: len(bins.actions)])
    size = chunk_size([alone], 1)
    assert "| step | DoF |" in decode_table(alone, 0, 0, outcomes_of(alone, size, 1), ["x"]), "one DoF is no code"
