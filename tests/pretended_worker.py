"""Plugin of worker processes in tests: `kerv work` runs episodes of studies_synthetic, and little time passes.

Variables: PRETENDED is the name of the function that runs the episodes; LAPSE the seconds after which a claim lapses.
"""

import os

import studies_synthetic

from kerv_cli.lab import runs, work

work.EpisodeRunner = lambda *_: getattr(studies_synthetic, os.environ["PRETENDED"])
work.checked = lambda *_: None  # the weights are pretended, too
work.POLL_SECONDS = 0.05
runs.LAPSE_SECONDS = float(os.environ.get("LAPSE", "30"))
runs.BEAT_SECONDS = min(runs.BEAT_SECONDS, runs.LAPSE_SECONDS / 6)
