"""The shipped policy decodes what it has always decoded: tokens, forwards and successes of study=main, closed loop."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest


@pytest.mark.bits
def test_every_method_of_the_main_study_decodes_the_same_tokens() -> None:
    """Also under each of `make test-cpus`' kernels: the logits' last bits differ there, their argmax does not."""
    spec = importlib.util.spec_from_file_location("write_golden", Path(__file__).parent / "golden" / "write.py")
    assert spec is not None
    assert spec.loader is not None
    golden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(golden)
    assert golden.measure() == json.loads(golden.FILE.read_text())
