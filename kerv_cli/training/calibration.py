"""Calibration on the training demonstrations (docs/methods.md §3, §4). One JSON holds the noise of the kinematic
predictors, their errors on held-out episodes, each task's reference level K_S of the kinematic variability, the ranges
of the hybrid boundary and the similarities from which on a verification is skipped."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, write_json
from kerv_cli.base.places import artifact, check_not_shipped
from kerv_cli.base.provenance import provenance_of
from kerv_cli.base.spaces import ObservationSpace
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
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.observations import observations_of
from kerv_cli.training.predictor_fit import (
    Windows,
    choose_episodes,
    fit_filters,
    prediction_errors,
    read_windows,
)
from kerv_cli.training.settings import CalibrateSettings
from kerv_cli.training.skip_levels import skip_section
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

PRESAMPLED = 6  # largest number of episodes per task that pre-sampling spreads its decodes over


def levels_of(decoder: Decoder, episode: DemoEpisode, space: ObservationSpace, decodes: int) -> list[float]:
    """K of up to `decodes` decodes, spread evenly over the observations of a demonstration; errors as
    `observations_of`.

    The decoder sees every executed action in between, so that methods with a history have one.
    """
    rows = np.unique(np.linspace(0, len(episode.frame_steps) - 1, decodes).round().astype(int))
    steps, levels, first = episode.frame_steps[rows], [], 0
    decoder.reset(episode.task, episode.seed, episode.end_effector[0])
    for step, observation in zip(steps, observations_of(decoder.target, episode, steps, space), strict=True):
        for t in range(first, step):
            decoder.observe(episode.executed[t], episode.end_effector[t + 1])
        first = step
        record = decoder.decode(observation)
        if record.variability is not None:
            levels.append(record.variability)
    return levels


def distribution(levels: Sequence[float], least: float) -> Variability:
    """K_S, the median of pre-sampled levels of K but at least `least`, so that it can divide, and their percentiles."""
    low, high, top = np.percentile(levels, [25, 75, 90]).tolist()
    return Variability(max(float(np.median(levels)), least), len(levels), low, high, top)


class CalibrationRun:
    """`kerv calibrate`: call `load`, then any of `presample`, `boundary` and `skip`, then `finish`, which writes.

    Attributes:
        notes: lines for the user, one per section that was not computed: why, and whether an earlier one stays.

    Raises:
        UsageError: a number out of range, an unknown task. CheckpointError: no such target or demonstrations,
            demonstrations of another environment, a datastore of another target.
    """

    def __init__(self, settings: CalibrateSettings) -> None:
        settings, self.dataset = demos_for(settings)
        self.settings = settings
        self.tasks = resolve_tasks(settings.task or list(self.dataset.manifest.tasks))
        self.artifacts = Artifacts(settings.results, settings.policy, device=settings.runtime.device)
        self.description = self.artifacts.description
        self.description.check_autoregressive("kerv calibrate", "there is no draft to calibrate")
        self.path = self.artifacts.path("calibration")
        if settings.name is not None:
            self.path = artifact(settings.results, "calibration", settings.name) / self.path.name
        self.chosen = choose_episodes(self.dataset, self.tasks, settings.episodes, settings.held_out)
        self.datastore = self.artifacts.path("datastore")
        self.stored = (self.datastore / "manifest.json").is_file()
        if self.stored:
            self.artifacts.check(["datastore"])
        if not (self.stored and self.path.is_file() and read_mapping(self.path).get("skip") is None):
            check_not_shipped(self.path, "name")  # a shipped one may be given the levels of a datastore made since
        self.windows: Windows | None = None
        self.notes: list[str] = []

    def plan(self) -> str:
        """One line for --plan: demonstrations, decodes, boundary windows, skip levels and the file."""
        held_out, proposer = sum(self.chosen.values()), self.settings.proposer.kind
        skip = f"skip levels from {self.datastore}" if self.stored else f"no skip levels: no datastore {self.datastore}"
        return (
            f"{self.path}: predictors fitted on {len(self.chosen) - held_out} demonstrations of {len(self.tasks)} "
            f"tasks, tested on {held_out}; {self.settings.decodes} decodes per task with {proposer} drafts; boundary "
            f"over {', '.join(map(str, self.settings.boundary_windows))} positions; {skip}"
        )

    def load(self, progress: OnProgress) -> None:
        """Reads the actions and paths of the chosen episodes."""
        space, window, chunk = self.description.actions, self.settings.window, self.description.chunk
        self.windows = read_windows(self.dataset, self.chosen, space, window, chunk, progress)

    def boundary(self, progress: OnProgress) -> BoundarySection:
        """Ranges of R and D over every window of every training episode, in metres; none is left out.

        Raises:
            CheckpointError: no path bends, or none moves.
        """
        assert self.windows is not None
        windows, paths, ranges = self.settings.boundary_windows, self.windows.paths, {}

        def counted(before: int) -> Iterator[np.ndarray]:
            for done, path in enumerate(paths, before + 1):
                yield path
                progress(done, len(paths) * len(windows))

        for number, window in enumerate(windows):
            ranges[str(window)] = BoundaryRanges.fit(counted(number * len(paths)), window)
        return BoundarySection(len(paths), ranges)

    def skip(self, progress: OnProgress) -> SkipSection | None:
        """Skip levels of the tasks, from the target's datastore; None without a datastore."""
        if not self.stored:
            return None
        store = self.artifacts.load("datastore")
        return skip_section(store, self.tasks, self.settings.epsilon, self.settings.confidence, progress)

    def presample(self, progress: OnProgress) -> dict[str, Variability]:
        """Task -> K_S and quartiles of K, from decodes of training observations with the settings' method; empty for
        decodes=0.

        Raises:
            CheckpointError: frames of another size. KervError: no decode of a task compared a draft.
        """
        if not self.settings.decodes:
            return {}
        decoder, space = self.decoder(), self.dataset.manifest.observation
        share = math.ceil(self.settings.decodes / PRESAMPLED)
        # the smallest K above 0: one token of a chunk is off by one bin
        actions = self.description.actions
        least = 2.0 / actions.tokens / (self.description.chunk * int((~actions.is_strict).sum()))
        variability: dict[str, Variability] = {}
        for number, name in enumerate(self.tasks):
            levels: list[float] = []
            for index in (i for i, held in self.chosen.items() if not held and self.dataset.episodes[i].task == name):
                budget = min(share, self.settings.decodes - len(levels))
                levels += levels_of(decoder, self.dataset.load(index), space, budget)
                if len(levels) >= self.settings.decodes:
                    break
            if not levels:
                raise KervError(f"{name}: no decode compared a draft with a target token, so there is no K for K_S")
            variability[name] = distribution(levels, least)
            progress(number + 1, len(self.tasks))
        return variability

    def decoder(self) -> Decoder:
        """The decoder of pre-sampling: the settings' proposer, acceptance and threshold."""
        s = self.settings
        method = RolloutSettings(proposer=s.proposer, acceptance=s.acceptance, threshold=s.threshold)
        return Method.of(method).decoder(self.artifacts.target, self.artifacts.load)

    def finish(
        self, variability: dict[str, Variability], boundary: BoundarySection | None, skip: SkipSection | None
    ) -> Calibration:
        """Fits the filters, measures the errors and writes the calibration. An empty section is taken from an earlier
        calibration of the same target.

        Raises:
            StorageError: writing failed.
        """
        assert self.windows is not None
        space, chunk = self.description.actions, self.description.chunk
        noise = fit_filters(self.windows, chunk, space.is_strict)
        provenance = provenance_of("kerv calibrate", self.settings, self.settings.runtime.device)
        sections, earlier = self._fill_empty({"variability": variability, "boundary": boundary, "skip": skip})
        calibration = Calibration(
            target=MadeFor.of(self.description),
            demos=Demonstrations(self.dataset.sha256, self.windows.episodes),
            window=self.settings.window,
            noise=noise,
            errors=prediction_errors(self.windows, noise, space),
            **sections,
            provenance={**provenance, "kept": earlier} if earlier else provenance,
        )
        write_json(self.path, asdict(calibration))
        return calibration

    def _fill_empty(self, sections: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Replaces empty sections by those of an earlier calibration of the same target -> (sections, provenance of the
        replaced ones)."""
        try:
            earlier = CalibrationArtifact().checked(self.path, self.description)
        except CheckpointError:  # missing, damaged or another target's: nothing to keep, and it is written anew
            earlier = None
        reasons = {
            "variability": f"reference levels K_S: decodes={self.settings.decodes}",
            "skip": f"skip levels: no datastore of these tasks in {self.datastore} (kerv build datastore)",
        }
        origins = {}
        for name in [name for name, value in sections.items() if not value]:
            section = getattr(earlier, name) if earlier else None
            if earlier and section:
                sections[name] = section
                origin = {key: value for key, value in earlier.provenance.items() if key != "kept"}
                before = earlier.provenance.get("kept")
                origins[name] = before.get(name, origin) if isinstance(before, dict) else origin
            self.notes.append(f"{reasons.get(name, name)}; {'kept from the earlier run' if section else 'left empty'}")
        return sections, origins
