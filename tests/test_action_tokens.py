"""Actions <-> tokens: round trips, both ends, the order of tokens."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kerv_cli.errors import UsageError
from kerv_cli.spaces import CENTRES, EDGES, VOCABULARY, ActionTokenizer, bins_of, values_of
from kerv_cli.targets.compact.text import PAD, UNKNOWN, WordTokenizer

WIDTH = 2 / 255  # of a bin


def openvla_bin(value: float) -> int:
    """OpenVLA's rule in its own terms: digitize over 256 edges, ids counted from one, then clipped to the centres."""
    return int(np.clip(np.digitize(np.clip(value, -1, 1), np.linspace(-1, 1, 256)) - 1, 0, 254))


def test_both_ends_belong_to_the_outermost_bins() -> None:
    assert len(EDGES) == 256
    assert VOCABULARY == len(CENTRES) == 255
    assert bins_of(np.array([-1.0, 1.0, -7.0, 7.0])).tolist() == [0, 254, 0, 254]
    assert values_of(np.array([0, 254])) == pytest.approx([-1 + WIDTH / 2, 1 - WIDTH / 2])


def test_every_token_survives_the_round_trip() -> None:
    tokens = np.arange(VOCABULARY)
    assert (bins_of(values_of(tokens)) == tokens).all()


@given(st.floats(-1.0, 1.0))
def test_the_round_trip_is_within_half_a_bin_and_equals_openvla(value: float) -> None:
    token = bins_of(np.array(value))
    assert token == openvla_bin(value)
    assert abs(values_of(token) - value) <= WIDTH / 2 + 1e-12


def test_statistics_are_the_percentiles_and_a_still_dof_stays_finite() -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-3, 5, (5000, 4))
    actions[:, 3] = 0.25
    tokenizer = ActionTokenizer.fit(actions)
    assert tokenizer.low[:3] == pytest.approx(np.quantile(actions[:, :3], 0.01, axis=0))
    assert tokenizer.high[:3] == pytest.approx(np.quantile(actions[:, :3], 0.99, axis=0))
    back = tokenizer.decode(tokenizer.encode(actions))
    inside = (actions > tokenizer.low) & (actions < tokenizer.high)
    assert np.abs(back - actions)[inside].max() <= (8 / 255) / 2 + 1e-9
    assert back[:, 3] == pytest.approx(0.25, abs=WIDTH)


def test_words_keep_their_ids_and_a_long_sentence_is_refused() -> None:
    words = WordTokenizer.build(["open the drawer", "close the door"])
    ids = words.encode("Open the window", 5)
    assert ids[2] == UNKNOWN
    assert ids[3:] == [PAD, PAD]
    assert len({*words.encode("open the drawer close door", 5)}) == 5
    with pytest.raises(UsageError, match="5 words, the policy takes 4"):
        words.encode("open the drawer close door", 4)
