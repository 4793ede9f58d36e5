"""Host work of a decode round: draft, acceptance, bookkeeping, launches, with a model that costs nothing.

The stand-in target has the protocol of a target, and its forward looks its states up in a table; so has the drafter
beside it. What is left of a decode is what the host does whatever the model's size: on a GPU, the time in which the
device may have nothing to do. Every draft has wrong tokens, so that rejections, rectifications and trees are among it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.bench.machine import synchronise
from kerv_cli.bench.model import layer_weights
from kerv_cli.config import compose as compose_settings
from kerv_cli.decoding.boundary import BoundaryRanges
from kerv_cli.decoding.build import compose
from kerv_cli.decoding.calibration_file import NEVER
from kerv_cli.decoding.decoder import Decoder
from kerv_cli.drafting.datastore import Datastore, Manifest
from kerv_cli.drafting.early import EarlyDraft
from kerv_cli.drafting.kinematics import FILTERS, Noise, Predictor, build_predictor
from kerv_cli.environments.metaworld.spec import SPEC
from kerv_cli.settings import RolloutSettings, TrainTargetSettings
from kerv_cli.spaces import Observation
from kerv_cli.targets.attention import Buffered, attention_mask

METHODS = ("ar", "naive_sd", "spec_vla", "spec_vla_paper", "kerv", "heisd", "one_pass_strict", "one_pass")
PROMPT, TASK, ENTRIES = 31, "metaworld/bench", 2000
WRONG = {3: 2, 9: 60}  # place in the chunk -> how many bins its draft is off: within a wide radius, beyond any
PROJECTED_SHAPE, PROJECTED_BANDWIDTH = "openvla-7b", 4.8e12  # bytes per second, an H200's published rate


@dataclass(frozen=True)
class HostWork:
    """Of one method. forwards: per decode. seconds: of a whole decode, the least of the repeats: other
    programs add to it, nothing takes from it. per_round: seconds over forwards."""

    method: str
    forwards: int
    seconds: float

    @property
    def per_round(self) -> float:
        """Seconds of host work for each forward."""
        return self.seconds / self.forwards


def projected_token() -> float:
    """Seconds of one token of PROJECTED_SHAPE in bfloat16 at PROJECTED_BANDWIDTH: its weights read once. A projection:
    nobody measured it."""
    shape = compose_settings("train_target", [f"target={PROJECTED_SHAPE}"], TrainTargetSettings).target
    numbers = layer_weights(shape) * shape.layers + shape.width * SPEC.actions.tokens
    return 2.0 * numbers / PROJECTED_BANDWIDTH


class StandInCache(Buffered):
    """Slots without content, but for a number each."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self.fixed = device.type == "cuda"
        self.buffer = torch.zeros(capacity + self.fixed, 1, device=device)
        self.capacity, self.length = capacity, 0


class StandIn:
    """A target, and a drafter of it: the state at a position says which token follows. wrong: by place, as WRONG."""

    cameras: tuple[str, ...] = ()
    max_prompt = PROMPT
    dtype = torch.float32

    def __init__(self, device: torch.device, steps: int, script: np.ndarray, places: int) -> None:
        """script (N,): the tokens."""
        self.actions, self.chunk, self.device = SPEC.actions, steps, device
        self.width = self.pooled_width = self.actions.tokens
        self.segments = {"scene": slice(0, PROMPT)}
        following = np.resize(script, places + 1)
        self.states = torch.zeros(PROMPT + places, self.width)
        self.states[torch.arange(places + 1) + PROMPT - 1, torch.from_numpy(following)] = 1.0
        self.states = self.states.to(device)
        self.table = torch.zeros(self.width, self.width, device=device)
        self.prompt = torch.ones(1, PROMPT, self.width, device=device)

    def encode(self, observation: Observation) -> Tensor:
        """As `Target.encode`."""
        return self.prompt

    def pooled(self, prompt: Tensor) -> Tensor:
        """As `ReadableTarget.pooled`."""
        return prompt.mean(1)

    def embed(self, tokens: Tensor) -> Tensor:
        """As `Target.embed`."""
        return self.table[tokens]

    def new_cache(self, batch: int, capacity: int) -> StandInCache:
        """As `Target.new_cache`."""
        return StandInCache(capacity, self.device)

    def forward(self, x: Tensor, positions: Tensor, cache: Any = None, seen: Any = None) -> Tensor:
        """As `Target.forward`; the mask is made, nothing attends."""
        attention_mask(seen, x.shape[1], cache, x)
        if cache is not None:
            cache.length += x.shape[1]
        return self.states[positions][None]

    def head(self, hidden: Tensor) -> Tensor:
        """As `Target.head`."""
        return hidden


class StandInDrafter:
    """As `DraftsStates`: predicts the stand-in's next state, that of another script."""

    def __init__(self, of: StandIn) -> None:
        self.of = of

    def new_cache(self, batch: int, capacity: int) -> StandInCache:
        """An empty cache."""
        return self.of.new_cache(batch, capacity)

    def draft_position(self, place: int) -> int:
        """`place`."""
        return place

    def __call__(
        self, following: Tensor, hidden: Tensor, positions: Tensor, cache: Any = None, seen: Any = None
    ) -> Tensor:
        return self.of.forward(hidden, positions + 1, cache, seen)


class StandInEarly:
    """As `EarlyDrafter`, with a known draft that it is not sure of."""

    def __init__(self, tokens: np.ndarray, device: torch.device) -> None:
        self.tokens = torch.tensor([*tokens.tolist(), 0.0], dtype=torch.float64, device=device)
        self.logits = torch.zeros(len(tokens), 1, device=device)

    def unread(self, features: Tensor, history: np.ndarray, radius: int) -> tuple[Tensor, Tensor]:
        """As `EarlyDrafter.unread`."""
        return self.tokens, self.logits

    def drafted(self, features: Tensor, history: np.ndarray, radius: int) -> EarlyDraft:
        """As `EarlyDrafter.drafted`."""
        return EarlyDraft.of(self.tokens.cpu().numpy(), self.logits)


class StandInCalibration:
    """As `Calibration`: plausible figures; nothing is skipped."""

    def k_s(self, task: str) -> float:
        """K_S."""
        return 0.1

    def ranges(self, window: int) -> BoundaryRanges:
        """Ranges of R and D."""
        return BoundaryRanges(0.01, 1.0, 0.001, 0.1)

    def skip_levels(self, task: str, datastore: str) -> tuple[float, float, float]:
        """No cosine reaches them."""
        return NEVER, NEVER, NEVER

    def predictor(self, kind: str, horizon: int) -> Predictor:
        """The predictor `kind`."""
        noise = dict.fromkeys(FILTERS, Noise.uniform(SPEC.actions.dofs, 1.0))
        return build_predictor(kind, SPEC.actions.is_strict, noise, horizon=horizon)


def datastore_of(tokens: np.ndarray, width: int, steps: int) -> Datastore:
    """ENTRIES random keys in few directions, as a policy's are; chunks near `tokens` (N,)."""
    random = np.random.default_rng(0)
    vectors = (random.standard_normal((ENTRIES, 16)) @ random.standard_normal((16, width))).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    chunks = (tokens + random.integers(0, 3, (ENTRIES, len(tokens)))) % SPEC.actions.tokens
    files = {"vectors.npy": "", "payload.parquet": ""}
    manifest = Manifest(2, "datastore", ("scene",), width, ENTRIES, steps, SPEC.actions, "", "", files, {})
    numbers = np.arange(ENTRIES)
    far = np.full(ENTRIES, 10 * steps)
    return Datastore(manifest, vectors, chunks.astype(np.uint8), numbers, numbers, far, {TASK: slice(0, ENTRIES)})


def decoder_of(method: str, device: torch.device, tokens: int) -> Decoder:
    """A method around the stand-in, in an episode that has begun. tokens: N, cut to whole control steps."""
    steps = max(1, tokens // SPEC.actions.dofs)
    script = np.random.default_rng(0).integers(80, 160, steps * SPEC.actions.dofs)
    drafted = script.copy()
    for place, off in WRONG.items():
        drafted[place % len(drafted)] += off
    places = 2 * len(script) + 2
    target, wrong = (StandIn(device, steps, tokens, places) for tokens in (script, drafted))
    made: dict[str, Any] = {
        "drafter": StandInDrafter(wrong),
        "early": StandInEarly(drafted, device),
        "calibration": StandInCalibration(),
        "datastore": datastore_of(drafted, target.width, steps),
    }
    settings = compose_settings("rollout", [f"method={method}"], RolloutSettings)
    decoder = compose(settings.parts(), target, made.__getitem__, TASK)
    random = np.random.default_rng(0)
    decoder.reset(TASK, 0, np.zeros(3))
    for step in range(10):
        decoder.observe(random.uniform(-0.5, 0.5, SPEC.actions.dofs), np.array([0.01 * step, 0.0, 0.1]))
    return decoder


def measure_host(device: torch.device, tokens: int, repeats: int) -> list[HostWork]:
    """Every method's host work for chunks of N = `tokens`, cut to whole control steps; rounds of the methods turn by
    turn, so that a busy moment of the machine is nobody's."""
    decoders = {method: decoder_of(method, device, tokens) for method in METHODS}
    observation = Observation(np.zeros(1), np.zeros(1), "", {})
    for decoder in decoders.values():
        decoder.decode(observation)
    seconds: dict[str, list[float]] = {method: [] for method in METHODS}
    forwards: dict[str, int] = {}
    for _ in range(repeats):
        for method, decoder in decoders.items():
            synchronise(device)
            record = decoder.decode(observation)
            seconds[method].append(record.seconds)
            forwards[method] = record.forwards
    return [HostWork(method, forwards[method], min(seconds[method])) for method in METHODS]
