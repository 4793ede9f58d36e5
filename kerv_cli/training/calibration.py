"""`kerv calibrate`: one JSON of figures measured on the training demonstrations (docs/methods.md §3, §4).

It holds the noise of the kinematic predictors and their errors on held-out episodes, each task's reference level K_S,
the ranges of the hybrid boundary, and the similarity from which verification is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, write_json
from kerv_cli.base.places import artifact
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.calibration import (
    BoundarySection,
    Calibration,
    CalibrationArtifact,
    Demonstrations,
    SkipSection,
    Variability,
)
from kerv_cli.methods.compose import Method
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.targets.folders import check_not_shipped
from kerv_cli.targets.observations import observations_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.predictor_fit import choose_episodes, fit_filters, prediction_errors, read_windows
from kerv_cli.training.settings import CalibrateSettings
from kerv_cli.training.skip_levels import skip_section
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import OnProgress

PRESAMPLED = 6
"""Episodes per task over which the decodes of pre-sampling are spread, at most."""

Stage = Callable[[str], AbstractContextManager[OnProgress]]
"""Opens a part of the work by its title and yields what is told its progress."""


class CalibrationRun:
    """Checks that a calibration can be made; `run` makes it.

    Attributes:
        notes: One line per section that was not measured: why, and whether an earlier one was kept.

    Raises:
        UsageError: A number out of range, or an unknown task.
        CheckpointError: No such target or demonstrations, demonstrations of another environment, or a datastore of
            another target.
    """

    def __init__(self, settings: CalibrateSettings) -> None:
        self.settings, self.dataset = demos_for(settings)
        settings = self.settings
        self.tasks = resolve_tasks(settings.task or list(self.dataset.manifest.tasks))
        self.artifacts = Artifacts(settings.results, settings.policy, device=settings.runtime.device)
        self.description = self.artifacts.description
        self.description.check_autoregressive("kerv calibrate", "there is no draft to calibrate")
        self.path = self.artifacts.path("calibration")
        if settings.name is not None:
            self.path = artifact(settings.results, "calibration", settings.name) / self.path.name
        self.chosen = choose_episodes(self.dataset, self.tasks, settings.episodes, settings.held_out)
        self.datastore = self.artifacts.path("datastore")
        self.has_datastore = (self.datastore / "manifest.json").is_file()
        if self.has_datastore:
            self.artifacts.check(["datastore"])
        if not (self.has_datastore and self.path.is_file() and read_mapping(self.path).get("skip") is None):
            check_not_shipped(self.path, "name")  # a shipped one may get the levels of a datastore made since
        self.notes: list[str] = []

    def plan(self) -> str:
        """Return one line for --plan: demonstrations, decodes, boundary windows, skip levels and the file."""
        held_out, proposer = sum(self.chosen.values()), self.settings.proposer.kind
        skip = f"skip levels from {self.datastore}"
        if not self.has_datastore:
            skip = f"no skip levels: no datastore {self.datastore}"
        return (
            f"{self.path}: predictors fitted on {len(self.chosen) - held_out} demonstrations of {len(self.tasks)} "
            f"tasks, tested on {held_out}; {self.settings.decodes} decodes per task with {proposer} drafts; boundary "
            f"over {', '.join(map(str, self.settings.boundary_windows))} positions; {skip}"
        )

    def run(self, stage: Stage) -> Calibration:
        """Measure everything and write the calibration.

        A section that is not measured now is taken from an earlier calibration of the same target.

        Raises:
            CheckpointError: Frames of another size, or no path bends.
            KervError: No decode of a task compared a draft.
            StorageError: The disk refused.
        """
        space, chunk, settings = self.description.actions, self.description.chunk, self.settings
        with stage("reading demonstrations") as progress:
            windows = read_windows(self.dataset, self.chosen, space, settings.window, chunk, progress)
        variability, skip = self.presample(stage), self.skip(stage)
        with stage("boundary ranges") as progress:
            ranges = {}
            for number, window in enumerate(settings.boundary_windows, 1):
                ranges[str(window)] = BoundaryRanges.fit(windows.paths, window)
                progress(number, len(settings.boundary_windows))
        with stage("fitting the predictors"):
            noise = fit_filters(windows, chunk, space.is_strict)
            errors = prediction_errors(windows, noise, space)
        provenance = provenance_of("kerv calibrate", settings, settings.runtime.device)
        sections, kept = self._with_earlier({"variability": variability, "skip": skip})
        calibration = Calibration(
            target=MadeFor.of(self.description),
            demos=Demonstrations(self.dataset.sha256, windows.episodes),
            window=settings.window,
            noise=noise,
            errors=errors,
            boundary=BoundarySection(len(windows.paths), ranges),
            **sections,
            provenance={**provenance, "kept": kept} if kept else provenance,
        )
        write_json(self.path, asdict(calibration))
        return calibration

    def skip(self, stage: Stage) -> SkipSection | None:
        """Return the skip levels of the tasks, from the target's datastore; None without a datastore."""
        if not self.has_datastore:
            return None
        store = self.artifacts.load("datastore")
        with stage("skip levels") as progress:
            return skip_section(store, self.tasks, self.settings.epsilon, self.settings.confidence, progress)

    def presample(self, stage: Stage) -> dict[str, Variability]:
        """Return each task's K_S and percentiles of K, from decodes of training observations; empty for decodes=0."""
        decodes = self.settings.decodes
        if not decodes:
            return {}
        decoder, actions = self.decoder(), self.description.actions
        # the smallest K above 0: one token of a chunk is off by one bin
        least = 2.0 / actions.tokens / (self.description.chunk * int((~actions.is_strict).sum()))
        variability = {}
        with stage("pre-sampling") as progress:
            for number, name in enumerate(self.tasks, 1):
                levels: list[float] = []
                for index, held_out in self.chosen.items():
                    if not held_out and self.dataset.episodes[index].task == name and len(levels) < decodes:
                        budget = min(math.ceil(decodes / PRESAMPLED), decodes - len(levels))
                        levels += self.episode_levels(decoder, index, budget)
                if not levels:
                    raise KervError(f"{name}: no decode compared a draft with a target token, so there is no K_S")
                variability[name] = distribution(levels, least)
                progress(number, len(self.tasks))
        return variability

    def decoder(self) -> Decoder:
        """Return the decoder of pre-sampling: the settings' proposer, acceptance and threshold."""
        s = self.settings
        method = RolloutSettings(proposer=s.proposer, acceptance=s.acceptance, threshold=s.threshold)
        return Method.of(method).decoder(self.artifacts.target, self.artifacts.load)

    def episode_levels(self, decoder: Decoder, index: int, decodes: int) -> list[float]:
        """Return K of up to `decodes` decodes, spread evenly over a demonstration's observations.

        The decoder sees every executed action in between, because some methods have a history.
        """
        episode = self.dataset.load(index)
        rows = np.unique(np.linspace(0, len(episode.frame_steps) - 1, decodes).round().astype(int))
        steps, levels, executed = episode.frame_steps[rows], [], 0
        observations = observations_of(decoder.target, episode, steps, self.dataset.manifest.observation)
        decoder.reset(episode.task, episode.seed, episode.end_effector[0])
        for step, observation in zip(steps, observations, strict=True):
            for t in range(executed, step):
                decoder.observe(episode.executed[t], episode.end_effector[t + 1])
            executed = step
            record = decoder.decode(observation)
            if record.variability is not None:
                levels.append(record.variability)
        return levels

    def _with_earlier(self, sections: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Fill empty sections from an earlier calibration -> (sections, section -> provenance of its measurement)."""
        try:
            earlier = CalibrationArtifact().checked(self.path, self.description)
        except CheckpointError:  # missing, damaged or of another target: there is nothing to keep
            earlier = None
        reasons = {
            "variability": f"reference levels K_S: decodes={self.settings.decodes}",
            "skip": f"skip levels: no datastore of these tasks in {self.datastore} (kerv build datastore)",
        }
        kept = {}
        for name in [name for name, value in sections.items() if not value]:
            section = getattr(earlier, name) if earlier else None
            if earlier and section:
                sections[name] = section
                before = earlier.provenance.get("kept", {})
                kept[name] = before.get(name) or {k: v for k, v in earlier.provenance.items() if k != "kept"}
            self.notes.append(f"{reasons[name]}; {'kept from the earlier run' if section else 'left empty'}")
        return sections, kept


def distribution(levels: Sequence[float], least: float) -> Variability:
    """Return percentiles of K and its median K_S; K is divided by K_S, which is therefore at least `least`."""
    low, high, top = np.percentile(levels, [25, 75, 90]).tolist()
    return Variability(max(float(np.median(levels)), least), len(levels), low, high, top)
