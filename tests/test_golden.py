"""The shipped policy decodes what it has always decoded: tokens, forwards and successes of study=main, closed loop; and
`ENGINE`, by which stored results are reused, changes with them and never without."""

import json
from pathlib import Path

import pytest
from loaded import module_of

from kerv_cli.episodes.identity import ENGINE


@pytest.fixture(scope="module")
def golden():
    return module_of(Path(__file__).parent / "golden" / "write.py")


@pytest.mark.bits
def test_every_method_of_the_main_study_decodes_the_same_tokens(golden):
    """Also under each of `make test-cpus`' kernels: the logits' last bits differ there, their argmax does not."""
    assert golden.measure_engine() == json.loads(golden.FILE.read_text())
    presets = json.loads(golden.PRESETS.read_text())
    assert golden.measure_presets() == presets
    expected = json.loads(golden.FILE.read_text())["ar"]
    for label in ("last_action", "last_action_tree"):
        for task, seeds in presets[label].items():
            for seed, row in seeds.items():
                assert row["tokens"] == expected[task][seed]["tokens"]


def test_the_engine_is_that_of_the_golden_tokens(golden):
    engines = json.loads(golden.ENGINES.read_text())
    assert engines[str(ENGINE)] == golden.hash_of(json.loads(golden.FILE.read_text()))
    assert len(set(engines.values())) == len(engines), "it was raised without a change of tokens"


@pytest.mark.parametrize(
    ("engine", "digest", "told"),
    [
        (2, "b", ""),
        (3, "c", ""),
        (2, "c", "tokens changed: raise ENGINE from 2"),
        (3, "b", "ENGINE was raised and no token changed"),
        (1, "a", "ENGINE 1 is an earlier one"),
    ],
)
def test_tokens_and_engine_change_together(golden, engine, digest, told):
    assert golden.refusal({"1": "a", "2": "b"}, engine, digest) == told
