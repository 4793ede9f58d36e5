"""Twenty seeded trials of the queue (`tests/reliability/trials.py`): killed, stopped, planned and removed meanwhile."""

import sys
from pathlib import Path

import pytest
from conftest import python

TRIAL = """
import sys
sys.path.insert(0, sys.argv[1])
import trials
wrong = trials.trial(int(sys.argv[2]), sys.argv[3])
print(*wrong, sep="\\n  ", file=sys.stderr)
sys.exit(bool(wrong))
"""
FOLDER = Path(__file__).parent / "reliability"


@pytest.mark.skipif(sys.platform != "linux", reason="uses namespaces of process ids")
@pytest.mark.parametrize("seed", range(20))
def test_a_trial_runs_each_planned_episode_once(seed, request):
    """Every other one in PostgreSQL. What happened is in the captured output."""
    server = request.getfixturevalue("postgresql") if seed % 2 else ""
    with python(TRIAL, FOLDER, seed, server) as process:
        process.join(180)
        assert process.exitcode == 0
