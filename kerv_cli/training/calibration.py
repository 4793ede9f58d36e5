"""Calibration on the training demonstrations (METHODS §3): the noise of the kinematic predictors, their errors on
held-out episodes, and each task's reference level K_S of the kinematic variability. One JSON holds all of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.decoding.calibration import Calibration, calibration_beside, save_calibration
from kerv_cli.drafting.kinematics import MINIMUM
from kerv_cli.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.places import artifact, find_target
from kerv_cli.provenance import provenance
from kerv_cli.settings import CalibrateSettings, MethodSettings, RolloutSettings, as_plain
from kerv_cli.sim.demo_dataset import DemoDataset
from kerv_cli.sim.tasks import resolve_tasks, task
from kerv_cli.training.prediction import (
    HISTORIES,
    Windows,
    choose_episodes,
    fit_filters,
    prediction_errors,
    read_windows,
)
from kerv_cli.vla.action_tokens import CENTRES, ActionTokenizer, values_of

if TYPE_CHECKING:
    from kerv_cli.rollouts.episode import ActionDecoder
    from kerv_cli.sim.demo_file import DemoEpisode

Progress = Callable[[int, int], None]
PRESAMPLED = 6  # episodes per task that pre-sampling spreads its decodes over, where there are so many


def kinematic_variability(drafted: np.ndarray, verdicts: np.ndarray) -> np.ndarray:
    """K (METHODS §3.2): drafted tokens (..., k) and the verdicts at the same places (..., k) -> (...,).

    The sum over the compared places of the absolute difference, in normalised action units.

    Raises:
        ValueError: the shapes differ.
    """
    if np.shape(drafted) != np.shape(verdicts):
        raise ValueError(f"{np.shape(drafted)} drafted tokens cannot be compared with {np.shape(verdicts)} verdicts")
    return np.abs(values_of(drafted) - values_of(verdicts)).sum(-1)


def reference_level(levels: Sequence[float]) -> float:
    """K_S: the median K of pre-sampled decodes, at least one bin so that it can divide.

    Raises:
        ValueError: no decode compared anything.
    """
    if not levels:
        raise ValueError("no decode compared a draft with a verdict")
    return max(float(np.median(levels)), float(CENTRES[1] - CENTRES[0]))


def presample(decoder: ActionDecoder, episode: DemoEpisode, instruction: str, decodes: int) -> list[float]:
    """K of up to `decodes` decodes, spread evenly over the observations of a demonstration.

    The decoder sees every executed action in between, so that methods with a history have one.
    """
    chosen = np.unique(np.linspace(0, len(episode.frame_steps) - 1, decodes).round().astype(int))
    levels, seen = [], 0
    decoder.reset(episode.task, instruction)
    for index in chosen:
        step = int(episode.frame_steps[index])
        for t in range(seen, step):
            decoder.observe(episode.executed[t], episode.end_effector[t + 1])
        seen = step
        frame = episode.frames[index] if decoder.needs_frame else None
        record = decoder.decode(frame, episode.states[step])
        if record.variability is not None:
            levels.append(record.variability)
    return levels


class CalibrationRun:
    """`kerv calibrate`."""

    def __init__(self, settings: CalibrateSettings) -> None:
        from kerv_cli.vla.checkpoint import read_description

        self.settings = settings
        _check_settings(settings)
        self.tasks = resolve_tasks(settings.task)
        folder = find_target(settings.results, settings.policy.target)
        self.described = read_description(folder, "target")
        self.chunk = int(self.described["settings"]["chunk"])
        if not 0 <= settings.fit_steps <= self.chunk:
            raise UsageError(
                f"fit_steps={settings.fit_steps}: at most the target's chunk of {self.chunk}, 0 for all of it"
            )
        self.path = calibration_beside(folder)
        if settings.name is not None:
            self.path = artifact(settings.results, "calibration", settings.name) / "calibration.json"
        self.dataset = DemoDataset.open(artifact(settings.results, "demos", settings.demos))
        self.chosen = choose_episodes(self.dataset, self.tasks, settings.episodes, settings.held_out)
        self.windows: Windows | None = None

    def plan(self) -> str:
        held_out, proposer = sum(self.chosen.values()), self.settings.proposer.kind
        return (
            f"{self.path}: predictors fitted on {len(self.chosen) - held_out} demonstrations of {len(self.tasks)} "
            f"tasks, tested on {held_out}; {self.settings.decodes} decodes per task with {proposer} drafts"
        )

    def load(self, progress: Progress) -> None:
        """Reads the actions of the chosen episodes."""
        s, statistics = self.settings, self.described["actions"]
        actions = ActionTokenizer(*(np.asarray(statistics[name]) for name in ("low", "high")))
        self.windows = read_windows(self.dataset, self.chosen, actions, s.history, s.window, self.chunk, progress)

    def presample(self, progress: Progress) -> dict[str, dict[str, float]]:
        """task -> K_S and how K is spread, from decodes of training observations with the settings' method."""
        if not self.settings.decodes:
            return {}
        decoder, size = self.decoder()
        share = math.ceil(self.settings.decodes / PRESAMPLED)
        found: dict[str, dict[str, float]] = {}
        for number, name in enumerate(self.tasks):
            levels: list[float] = []
            for index in self._training(name):
                episode = self.dataset.load(index)
                if decoder.needs_frame and episode.frames.shape[1] != size:
                    raise CheckpointError(
                        f"the demonstrations' frames have {episode.frames.shape[1]} pixels, not {size}"
                    )
                budget = min(share, self.settings.decodes - len(levels))
                levels += presample(decoder, episode, task(name).instruction, budget)
                if len(levels) >= self.settings.decodes:
                    break
            if not levels:
                raise KervError(f"{name}: no decode compared a draft with a verdict, so there is no K to take K_S from")
            found[name] = spread(levels)
            progress(number + 1, len(self.tasks))
        return found

    def _training(self, name: str) -> list[int]:
        return [i for i, held in self.chosen.items() if not held and self.dataset.episodes[i].task == name]

    def decoder(self) -> tuple[ActionDecoder, int]:
        """The decoder that pre-samples, and the pixels of the frames it takes."""
        from kerv_cli.rollouts.assemble import build_decoder
        from kerv_cli.rollouts.policy import load_policy

        s = self.settings
        policy = load_policy(
            RolloutSettings(policy=s.policy, proposer=s.proposer, runtime=s.runtime, results=s.results)
        )
        method = MethodSettings("presampling", s.proposer, s.acceptance, s.threshold)
        return build_decoder(policy, method), policy.target.settings.image_size

    def finish(self, variability: dict[str, dict[str, float]]) -> Calibration:
        """Fits, measures and writes the calibration."""
        assert self.windows is not None
        noise = fit_filters(self.windows, self.settings.fit_steps or self.chunk)
        made = {
            "command": "kerv calibrate",
            "settings": as_plain(self.settings),
            **provenance(self.settings.runtime.device),
        }
        calibration = Calibration(
            target={"sha256": self.described["sha256"], "chunk": self.chunk, "dofs": len(self.windows.past[0, 0])},
            demos={"sha256": self.dataset.sha256, "tasks": self.windows.episodes},
            window=self.settings.window,
            noise=noise,
            errors=prediction_errors(self.windows, noise),
            variability=variability,
            provenance=made,
        )
        save_calibration(self.path, calibration)
        return calibration


def _check_settings(settings: CalibrateSettings) -> None:
    if settings.history not in HISTORIES:
        raise UnknownName("history", settings.history, HISTORIES)
    if settings.window < MINIMUM:
        raise UsageError(f"window={settings.window}: at least {MINIMUM}")
    if settings.decodes < 0:
        raise UsageError(f"decodes={settings.decodes}: 0 for none, or the number per task")
    if settings.decodes and settings.proposer.kind == "none":
        raise UsageError("proposer.kind=none drafts nothing to compare: choose a proposer, or decodes=0")


def spread(levels: Sequence[float]) -> dict[str, float]:
    """K_S and the quartiles of pre-sampled levels of K."""
    low, high, top = np.percentile(levels, [25, 75, 90]).tolist()
    return {"k_s": reference_level(levels), "decodes": len(levels), "p25": low, "p75": high, "p90": top}
