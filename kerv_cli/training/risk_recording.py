"""Records drafts, their scores and their losses in closed loop, on selection seeds (docs/methods.md §4.6).

Training observations would flatter a draft: a drafter or a datastore was made from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.places import artifact
from kerv_cli.base.provenance import provenance, versions
from kerv_cli.base.registry import NoSettings, find
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import CalibrateRiskSettings, RolloutSettings, as_plain
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.loss import chunk_loss, target_tokens
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import DraftsChunks
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.lab.episode import run_episode
from kerv_cli.lab.identity import ENGINE
from kerv_cli.lab.run import close_worlds, open_world
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.compose import Method
from kerv_cli.methods.context import Context
from kerv_cli.methods.risk.gate import episode_numbers
from kerv_cli.methods.risk.recording import Draw, RiskManifest, RiskRecording, decoding_of, save_risk
from kerv_cli.methods.risk.scores import Draft, Score
from kerv_cli.training.risk_records import RiskRecords, Row
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.stress import build as build_stress
from kerv_cli.worlds.stress import check as check_stress

Progress = Callable[[int, int], None]


class Recorder(Skip):
    """Compares every source's draft with the target in an additional forward, and executes the draft of the first
    source unverified in a random share of the decodes. Its times mean nothing.

    rows: the rows of the current episode, one per decode and source. features: its pooled prompts (F,), one per draft
    of the first source, if the settings ask for them.
    """

    def __init__(
        self,
        target: ReadableTarget,
        sources: Sequence[DraftsChunks],
        scores: Mapping[str, Mapping[str, Score]],
        settings: CalibrateRiskSettings,
    ) -> None:
        self.target, self.sources, self.scores, self.settings = target, sources, scores, settings
        self.rows: list[Row] = []
        self.features: list[np.ndarray] = []
        self.random = np.random.default_rng(0)
        self.episode: Row = {}
        self.decodes = 0

    def begin(self, task: str, seed: int) -> None:
        """Begins the rows of an episode; see `Skip.begin`."""
        self.random = episode_numbers("risk", task, seed)
        self.episode, self.decodes = {"task": task, "seed": seed}, 0
        self.rows, self.features = [], []

    def take(self, chunk: Chunk) -> bool:
        """Records every source's draft, and executes the first one or not; see `Skip.take`."""
        chains = [self._record(chunk, source) for source in self.sources]
        if chains[0] and self.settings.features:
            self.features.append(self.target.pooled(chunk.prompt)[0].half().cpu().numpy())
        self.decodes += 1
        if self.random.random() >= self.settings.unverified or not chains[0]:
            return False
        chunk.skip(chains[0], self.sources[0].name)
        return True

    def _record(self, chunk: Chunk, source: DraftsChunks) -> tuple[int, ...]:
        """Adds the row of one source's draft -> the draft; empty where there is none."""
        drafted = source.chains(chunk, chunk.size)
        if not drafted or len(drafted[0]) < chunk.size:
            return ()
        chain = tuple(drafted[0])
        draft = Draft(chunk, source, chain)
        values = {f"score.{name}": score.of(draft) for name, score in self.scores[source.name].items()}
        loss = chunk_loss(chunk.space, chain, target_tokens(self.target, chunk, chain), self.settings.scale)
        self.rows.append({"source": source.name, **self.episode, "index": self.decodes, "loss": loss, **values})
        return chain


class RiskRun:
    """`kerv calibrate risk`: call `record`, then `finish`, which writes. Every episode is written to disk as soon as it
    has ended, so that the same command continues after an interruption; `finish` removes these files.

    Raises:
        UsageError: no such task, source or score; seeds that are not for selection. CheckpointError: no such target, or
            an artifact that a source or a score reads is missing or another target's.
    """

    def __init__(self, settings: CalibrateRiskSettings) -> None:
        self.settings = settings
        self.tasks = resolve_tasks(settings.task)
        self.seeds = range(settings.seed, settings.seed + settings.episodes)
        spec_of(self.tasks[0]).seeds.check(self.seeds, "selection", f"seed={settings.seed}")
        check_stress(settings.world.stress, spec_of(self.tasks[0]))
        for name in settings.sources:
            if not find("proposer", name, "source").traits.get("chains"):
                raise UsageError(f"sources: '{name}' does not draft whole chunks from the prompt")
        device, _ = set_up(settings.runtime)
        self.artifacts = Artifacts(
            settings.results, settings.policy, NoSettings("exact"), device, settings.runtime.dtype
        )
        self.artifacts.description.check_autoregressive("kerv calibrate risk", "there is no draft to calibrate")
        scores = [need for name in settings.scores for need in find("score", name, "score").needs(None)]
        sources = [need for name in settings.sources for need in find("proposer", name).needs(None)]
        self.hashes = self.artifacts.check(dict.fromkeys([*sources, *scores]))
        self.folder = self.artifacts.place("risk")
        if settings.name is not None:
            self.folder = artifact(settings.results, "risk", settings.name)
        self.records = RiskRecords(self.folder, self._identity(), settings.sources, settings.scores)

    def _identity(self) -> dict[str, Any]:
        """Everything that determines an episode's rows, besides its task and seed."""
        s, runtime = self.settings, self.settings.runtime
        return {
            "artifacts": self.hashes,
            "recorded": [s.sources, s.scores, s.unverified, s.scale, s.features],
            "decoding": [asdict(s.acceptance), asdict(s.threshold), s.chunk],
            "world": asdict(s.world),
            "runtime": [runtime.device, runtime.dtype, runtime.threads],
            "engine": ENGINE,
            "versions": versions(),
        }

    def plan(self) -> str:
        """One line for --plan."""
        s, seeds, episodes = self.settings, self.seeds, len(self.tasks) * len(self.seeds)
        left = sum(len(self.records.missing(task, self.seeds)) for task in self.tasks)
        recorded = f", {episodes - left} of them are recorded" if left < episodes else ""
        return (
            f"{self.folder}: {episodes} episodes on selection seeds {seeds.start} to {seeds.stop - 1}{recorded}, "
            f"about {left * 1.5 / 60:.0f} min (a guess); drafts of {', '.join(s.sources)}, scores {', '.join(s.scores)}"
        )

    def record(self, progress: Progress) -> None:
        """Runs the episodes that are not on disk yet, task by task.

        Raises:
            StorageError: writing failed.
        """
        missing = {task: self.records.missing(task, self.seeds) for task in self.tasks}
        total = len(self.tasks) * len(self.seeds)
        done = total - sum(map(len, missing.values()))
        stress = build_stress(self.settings.world.stress)
        for task, seeds in missing.items():
            if not seeds:
                continue
            decoder, recorder = self._decoder(task)
            for seed in seeds:
                run_episode(open_world(task, self.settings.world, stress), decoder, seed)
                self.records.write(task, seed, recorder.rows, recorder.features)
                progress(done := done + 1, total)
            close_worlds()

    def _decoder(self, task: str) -> tuple[Decoder, Recorder]:
        """A decoder that drafts from the first source, verifies and decodes on, and its recorder."""
        target: Any = self.artifacts.target
        context = Context(target, self.artifacts.load, task)
        sources: list[DraftsChunks] = [
            find("proposer", n).built(_default_settings(n), context) for n in self.settings.sources
        ]
        scores = {}
        for source in sources:
            beside = Context(target, self.artifacts.load, task, {"prefill_draft": source})
            names = self.settings.scores
            scores[source.name] = {n: find("score", n).built(NoSettings(n), beside) for n in names}
        recorder = Recorder(target, sources, scores, self.settings)
        method = RolloutSettings(acceptance=self.settings.acceptance, threshold=self.settings.threshold).parts()
        method["prefill_draft"] = _default_settings(self.settings.sources[0])
        decoder = Method(method, self.settings.chunk).decoder(target, self.artifacts.load, task)
        return Decoder(target, replace(decoder.parts, skip=recorder), self.settings.chunk), recorder

    def finish(self, draw: Draw | None = None) -> RiskRecording:
        """Writes the recording in one step -> the recording. draw: adds pictures to its folder.

        Raises:
            StorageError: writing failed. KervError: an episode is not on disk any more.
        """
        rows: list[Row] = []
        features: list[np.ndarray] = []
        for task in self.tasks:
            for seed in self.seeds:
                record = self.records.read(task, seed)
                if record is None:
                    raise KervError(f"the record of {task}, seed {seed}, is gone from {self.records.folder}: run again")
                rows += record[0]
                features += record[1]
        origin = {
            "command": "kerv calibrate risk",
            "settings": as_plain(self.settings),
            **provenance(self.settings.runtime.device),
        }
        manifest = RiskManifest(
            target=MadeFor.of(self.artifacts.description),
            sources={name: self._drafts_from(name) for name in self.settings.sources},
            scale=self.settings.scale,
            tasks={task: list(self.seeds) for task in self.tasks},
            scores=list(self.settings.scores),
            files={},
            provenance=origin,
            made_from={kind: digest for kind, digest in self.hashes.items() if kind != "target"},
            decoding=decoding_of(vars(self.settings), self.settings.chunk, self.artifacts.target),
        )
        return save_risk(self.folder, manifest, rows, np.array(features) if features else None, draw)

    def _drafts_from(self, source: str) -> str:
        """Hash of the artifact that a source drafts from; empty where it needs none."""
        return next((self.hashes[kind] for kind in find("proposer", source).needs(None)), "")


def _default_settings(name: str) -> Any:
    """Default settings of a proposer."""
    return find("proposer", name).settings(kind=name)
