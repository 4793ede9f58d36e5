"""The recorded decodes that certify a gate's level: drafts, their scores and their losses, read and checked (docs/
methods.md §4.6).

`kerv calibrate risk` writes them (training/risk_recording.py); `skip=risk` reads them. The certificate is computed when
a method is built, so that ε and δ are settings of the method.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import sha256_of, write_folder, write_json
from kerv_cli.base.registry import find
from kerv_cli.engine.chunk import steps_of
from kerv_cli.methods.artifacts import Artifact, MadeFor, Request
from kerv_cli.methods.certified.betting import p_value
from kerv_cli.methods.risk import RiskSkipSettings, hash_of_recording
from kerv_cli.methods.risk.alarm import alarm_level

GRID = 40  # candidate levels: quantiles of the scores
DECODES, FEATURES = "decodes.parquet", "features.npy"
AGAIN = "run 'kerv calibrate risk'"
ROW = [("source", pa.string()), ("task", pa.string()), ("seed", pa.int64()), ("index", pa.int64())]
"""Columns of DECODES before `loss` and one column per score: what drafted, the episode, the decode in it."""

_DECODING = ("acceptance", "threshold")
_OLDER_DECODING = {
    "acceptance.kind": "relaxed",
    "acceptance.strict_dofs": True,
    "threshold.kind": "fixed",
    "threshold.r": 9,
}


def decoding_of(method: Mapping[str, Any], chunk: int, target: Any) -> dict[str, Any]:
    """What drafts, scores and losses depend on besides artifacts, as flat settings: acceptance and threshold, by whose
    radius a drafter chooses its tokens, chunk length and number format. method: kind -> settings. chunk: 0: the
    target's."""
    parts = {f"{kind}.{name}": value for kind in _DECODING for name, value in asdict(method[kind]).items()}
    dtype = str(target.dtype).removeprefix("torch.")
    return {**parts, "chunk": steps_of(chunk, target.chunk), "runtime.dtype": dtype}


@dataclass(frozen=True)
class RiskManifest:
    """Description of a recording. sources: proposer of the drafts -> hash of its artifact, empty where it has none.
    scale: ε_a. tasks: task -> seeds, all of them selection seeds. scores: columns. files: name ->
    SHA-256. made_from: what sources and scores read, kind of artifact -> hash. decoding: as `decoding_of`. Both are
    absent from older recordings."""

    target: MadeFor
    sources: dict[str, str]
    scale: float
    tasks: dict[str, list[int]]
    scores: list[str]
    files: dict[str, str]
    provenance: dict[str, Any] = field(default_factory=dict)
    made_from: dict[str, str] = field(default_factory=dict)
    decoding: dict[str, Any] = field(default_factory=dict)
    format: Literal[1] = 1
    kind: Literal["risk"] = "risk"

    def __post_init__(self) -> None:
        if not self.scale > 0 or not set(self.files) <= {DECODES, FEATURES}:
            raise ValueError("the scale is not above 0, or another file is named")

    @property
    def artifacts(self) -> dict[str, str]:
        """Kind -> hash of the artifacts it was made from; an older recording names the early drafter alone."""
        return self.made_from or {name: digest for name, digest in self.sources.items() if digest}

    @property
    def decoded_with(self) -> dict[str, Any]:
        """`decoding`; an older recording was made with the one method that there was."""
        runtime = self.provenance.get("settings", {}).get("runtime", {})
        older = {"chunk": self.target.chunk, "runtime.dtype": runtime.get("dtype", "float32")}
        return self.decoding or {**_OLDER_DECODING, **older}

    def read_by(self, source: str, scores: Sequence[str]) -> dict[str, str]:
        """Those of `artifacts` that a source's drafts and these scores read."""
        parts = [find("proposer", source), *(find("score", name) for name in scores)]
        kinds = {kind for part in parts for kind in part.needs(None)}
        return {kind: digest for kind, digest in self.artifacts.items() if kind in kinds}


@dataclass(frozen=True)
class Losses:
    """n recorded decodes of one source. scores: name -> (n,). losses: (n,) in [0, 1]. episodes: (n,) numbers."""

    scores: dict[str, np.ndarray]
    losses: np.ndarray
    episodes: np.ndarray


class RiskRecording:
    """The recorded decodes of a policy's drafts."""

    def __init__(self, manifest: RiskManifest, table: pa.Table) -> None:
        self.manifest, self._table = manifest, table
        self._certified: dict[tuple[Any, ...], Certified] = {}

    def losses(self, source: str) -> Losses:
        """Decodes of one source.

        Raises:
            CheckpointError: it was not recorded.
        """
        if source not in self.manifest.sources:
            names = ", ".join(self.manifest.sources)
            raise CheckpointError(f"the risk of drafts from {source} was not recorded, only of {names}: {AGAIN}")
        columns = self._table.filter(pa.compute.equal(self._table["source"], source))
        tasks, seeds = (columns[name].to_numpy(zero_copy_only=False) for name in ("task", "seed"))
        _, numbers = np.unique(tasks, return_inverse=True)
        _, episodes = np.unique(np.stack([numbers, seeds]), axis=1, return_inverse=True)
        scores = {name: columns[f"score.{name}"].to_numpy() for name in self.manifest.scores}
        return Losses(scores, columns["loss"].to_numpy(), episodes.reshape(-1))

    def certified(self, source: str, score: str, epsilon: float, delta: float) -> Certified:
        """The lowest level of `score` from which on drafts of `source` may be executed unverified.

        Raises:
            CheckpointError: source or score was not recorded.
        """
        key = source, score, epsilon, delta
        if key not in self._certified:
            losses = self.losses(source)
            if score not in losses.scores:
                raise CheckpointError(
                    f"score {score} was not recorded, only {', '.join(losses.scores)}: {AGAIN} scores=[…,{score}]"
                )
            finite = np.isfinite(losses.scores[score])
            values = np.where(finite, losses.scores[score], -math.inf)
            self._certified[key] = certify(values, losses.losses, losses.episodes, epsilon, delta)
        return self._certified[key]

    def alarm_level(self, source: str, settings: RiskSkipSettings, level: float) -> float:
        """Evidence at which the alarm of a gate with this least trusted score is raised; see `alarm.alarm_level`."""
        losses = self.losses(source)
        trusted = losses.scores[settings.score] >= level
        decodes = [np.flatnonzero(losses.episodes == number) for number in range(int(losses.episodes.max()) + 1)]
        return alarm_level([(trusted[part], losses.losses[part]) for part in decodes], settings)

    def check_decoding(self, used: Mapping[str, Any]) -> None:
        """Refuses a method that decodes otherwise than this recording did. used: as `decoding_of`.

        Raises:
            CheckpointError: it does; names both values and the command that records anew.
        """
        recorded = self.manifest.decoded_with
        others = [name for name in used if name in recorded and used[name] != recorded[name]]
        kinds = {name.split(".")[0] for name in others if name.endswith(".kind")}
        others = [name for name in others if name.split(".")[0] not in kinds or name.endswith(".kind")]
        if others:
            values = " and ".join(f"{name}={recorded[name]}, not {used[name]}" for name in others)
            words = " ".join(f"{name.removesuffix('.kind')}={used[name]}" for name in others)
            raise CheckpointError(f"the risk was recorded with {values}: run 'kerv calibrate risk {words}'")

    def check_size(self, source: str, epsilon: float, delta: float) -> None:
        """Refuses a recording of too few episodes to certify anything.

        Raises:
            CheckpointError: it is.
        """
        episodes, needed = len(np.unique(self.losses(source).episodes)), episodes_needed(epsilon, delta)
        if episodes < needed:
            raise CheckpointError(
                f"{episodes} recorded episodes cannot certify a risk of {epsilon:g} at δ = {delta:g}: {needed} are "
                f"needed, without any loss: {AGAIN} with more episodes"
            )


Draw = Callable[[RiskRecording, Path], object]
"""Draws pictures of a recording into a folder."""


def save_risk(
    folder: Path,
    manifest: RiskManifest,
    rows: Sequence[Mapping[str, Any]],
    features: np.ndarray | None = None,
    draw: Draw | None = None,
) -> RiskRecording:
    """Writes manifest, decodes and pictures atomically, in place of all that the folder held -> the recording.
    features: (n, F) float16, pooled prompts of the first source's decodes."""
    schema = pa.schema([*ROW, ("loss", pa.float64()), *((f"score.{name}", pa.float64()) for name in manifest.scores)])
    table = pa.Table.from_pylist(list(rows), schema=schema)
    recording = RiskRecording(manifest, table)

    def fill(temporary: Path) -> None:
        pq.write_table(table, temporary / DECODES, compression="zstd")
        if features is not None:
            np.save(temporary / FEATURES, features)
        files = {path.name: sha256_of(path) for path in sorted(temporary.iterdir())}
        write_json(temporary / "risk.json", asdict(replace(manifest, files=files)))
        if draw is not None:
            draw(recording, temporary)

    write_folder(folder, fill, replace=True)
    return recording


class RiskArtifact(Artifact[RiskManifest]):
    """The recording's files."""

    kind, noun, made, again = "risk", "risk recording", "recorded", AGAIN
    schema = RiskManifest

    def sources(self, description: RiskManifest) -> Mapping[str, str]:
        """What sources and scores read."""
        return description.artifacts

    def digest(self, place: Path, description: RiskManifest) -> str:
        """Of the description and of what is made of it: another certificate is other work."""
        return hash_of_recording(self.json(place))

    def load(self, place: Path, request: Request) -> RiskRecording:
        """The recorded decodes."""
        return RiskRecording(self.checked(place, request.description), pq.read_table(place / DECODES))


# --- levels at which a gate's risk is certified: Learn-then-Test over episodes (Angelopoulos et al. 2021)


@dataclass(frozen=True)
class Certified:
    """Result for one gate. level: least score that skips, inf where nothing could be certified. share: of the decodes
    that it skips. risk: mean loss of those. p: of the level's test, or of the safest level's where that failed.
    episodes: tested on."""

    level: float
    share: float
    risk: float
    p: float
    episodes: int


def episode_means(skipped: np.ndarray, losses: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Mean loss over the skipped decodes of every episode that has some.

    skipped (n,) bool, losses (n,), episodes (n,) of n decodes. Decodes of an episode depend on each other, episodes do
    not: the episode is the unit of every test.
    """
    _, at = np.unique(episodes[skipped], return_inverse=True)
    means: np.ndarray = np.bincount(at, losses[skipped]) / np.bincount(at)
    return means


def shuffled(means: np.ndarray) -> np.ndarray:
    """The values (n,) in a random order that their number determines: the recording's is task by task."""
    return np.random.default_rng(0).permutation(means)


def certify(scores: np.ndarray, losses: np.ndarray, episodes: np.ndarray, epsilon: float, delta: float) -> Certified:
    """The lowest level λ such that, with probability 1 − δ over the episodes, the risk of score ≥ λ is at most ε. The
    risk is an episode's mean loss over its skipped decodes, expected over episodes that skip.

    scores, losses, episodes: (n,) of n decodes, in which every draft was compared with the target. Levels are tested
    from the safest on that skips in enough episodes to be certified at all, each at δ, up to the first that fails
    (fixed-sequence testing); which episodes skip is known without their losses.
    """
    needed, best, p = episodes_needed(epsilon, delta), None, 1.0
    levels = np.unique(np.quantile(scores, np.linspace(0, 1, GRID + 1)[:-1], method="inverted_cdf"))[::-1]
    for level in levels.tolist():
        skipped = scores >= level
        if len(np.unique(episodes[skipped])) < needed:
            continue
        means = episode_means(skipped, losses, episodes)
        p = p_value(shuffled(means), epsilon, delta)
        if p > delta:
            break
        best = Certified(level, float(skipped.mean()), float(means.mean()), p, len(means))
    return best or Certified(math.inf, 0.0, math.nan, p, len(np.unique(episodes)))


@functools.cache
def episodes_needed(epsilon: float, delta: float) -> int:
    """Fewest episodes that certify anything, none of them with a loss."""
    n = 1
    while p_value(np.zeros(n), epsilon, delta) > delta:
        n += 1
    return n
