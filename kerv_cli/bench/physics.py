"""Compute what a decode costs on a GPU from the model's shape and the GPU's published figures. Nothing is run.

A phase of a decode (prefill, verification, …) reads bytes and executes operations. Its floor is the longer of two
times: reading at the memory's full bandwidth, and computing at the full rate. An engine (a program that executes the
model) is slower. The constants here say by how much, and who measured it. This module needs no torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from kerv_cli.targets.openvla.config import TOWERS, Language, Tower

if TYPE_CHECKING:
    from kerv_cli.episodes.cost import Profile

_HALF = 2.0  # bytes of a bfloat16 number
_TREE_WIDTH = 8  # nodes per level of the drafter's tree
_TRUNK, _CHAIN, _LEVEL = 21, 13, 31  # kernels outside the layers, counted: of a trunk, a drafted token, a tree's level
_ENCODER = 20  # kernels of an encoder outside its blocks
_ROWS = (1, 2, 4, 8, 16, 32, 64, 128)
SYSTEM = "system time"
CHUNK = 128  # largest number of tokens per chunk for which a computed profile has times


@dataclass(frozen=True)
class Device:
    """A GPU, or a computer board that has one."""

    title: str
    bandwidth: float  # published bytes per second of the device's memory
    flops: float  # published operations per second of dense matrix multiplications in bfloat16 with sums in float32


# Devices by short name, with the figures of NVIDIA's data sheets. Orin's rate is half of its dense int8 rate.
DEVICES = {
    "h100": Device("H100 SXM", 3350e9, 989e12),
    "a100": Device("A100 80GB", 2039e9, 312e12),
    "4090": Device("RTX 4090", 1008e9, 165e12),
    "3090": Device("RTX 3090", 936e9, 71e12),
    "orin": Device("AGX Orin 64GB", 204.8e9, 42.5e12),
}


class Needs(NamedTuple):
    """Work of one phase of a decode, which is the same on every device."""

    read: float
    flops: float
    layers: int = 0  # number of layers of the language model or drafter that run one after the other
    blocks: int = 0  # number of blocks of a vision encoder that run one after the other
    kernels: int = 0  # number of GPU kernels outside of these layers and blocks
    asks: bool = False  # whether the phase runs the target's encoder or trunk


@dataclass(frozen=True)
class Engine:
    """How a program executes a decode.

    A phase takes its floor (shortest time that the device allows) ÷ `share`, or the time of launching its kernels if
    that is longer. The time of the surrounding program (`system`) is added.
    """

    name: str
    share: float  # share of the device's bandwidth and operations per second that the program reaches
    launch: float  # seconds of launching one kernel
    layer: int  # number of kernels per layer of the language model or of the drafter
    block: int  # number of kernels per block of a vision encoder
    system: float  # further seconds of each run of the target's encoder or trunk
    source: str
    draft: float = 0.0  # further seconds of each draft of the drafter
    extra_round: bool = False  # whether each decode runs one forward, or one round of drafting and verifying, too many

    def times(self, needs: Needs, device: Device) -> dict[str, float]:
        """Return the seconds of `reading`, `arithmetic`, `launches` and `system time` in a phase, by these names.

        A phase takes the longest of the first three times, plus the system time.
        """
        kernels = needs.layers * self.layer + needs.blocks * self.block + needs.kernels
        return {
            "reading": needs.read / device.bandwidth / self.share,
            "arithmetic": needs.flops / device.flops / self.share,
            "launches": kernels * self.launch,
            SYSTEM: self.system * needs.asks,
        }

    def seconds(self, needs: Needs, device: Device) -> float:
        times = self.times(needs, device)
        system = times.pop(SYSTEM)
        return max(times.values()) + system

    def bound(self, needs: Needs, device: Device) -> str:
        times = self.times(needs, device)
        return max(times, key=times.__getitem__)


# Share of the published bandwidth and operations per second that engines are assumed to reach. gpt-fast reads 1,397
# of an A100's 2,039 GB/s with Llama-2 7B, one sequence, in bfloat16.
SHARE = 0.69

# Engines by name. *tuned*: captured graphs and fused kernels. *eager*: ordinary code around a plain loop. *public*: the
# same kernels in the loop of Spec-VLA's repository, which KERV's and HeiSD's inherit.
ENGINES = {
    "tuned": Engine(
        "tuned",
        SHARE,
        launch=1.3e-6,
        layer=7,
        block=7,
        system=0.0,
        source="1.3 µs per kernel in a CUDA graph and 7 kernels per layer (Hazy Research, H100)",
    ),
    "eager": Engine(
        "eager",
        SHARE,
        launch=13.3e-6,
        layer=38,
        block=14,
        system=53e-3 / 8,
        source="38 and 14 kernels per layer and vision block (counted in transformers); 13.3 µs each, so that HeiSD's "
        "trunk takes 113 ms (A100, 7 forwards of 32 layers); HeiSD's 53 ms of system time, over encoder and 7 forwards",
    ),
}
ENGINES["public"] = replace(
    ENGINES["eager"],
    name="public",
    draft=53e-3 / 8,
    extra_round=True,
    source=f"{ENGINES['eager'].source}, and once more for each draft (a fit); N + 1 forwards, or one more draft and "
    "verification (Spec-VLA's repository: run_libero_goal_AR.py, and a loop until there are more than N tokens)",
)
# An ideal engine. Every phase takes exactly its floor, the shortest time that the device allows.
ROOFLINE = Engine("roofline", 1.0, 0.0, 0, 0, 0.0, "the floor: the longer of reading and computing")


@dataclass(frozen=True)
class Sizes:
    """The sizes of a target, from which the bytes and operations of its forwards are computed."""

    layers: int  # number of weights in the matrices of all layers
    head: int
    drafter: int  # number of weights that a pass of the drafter reads, the head's included
    # number of attention channels, summed over all layers. Each takes four operations for every key that a token
    # attends to.
    channels: int
    cached: int  # count of numbers that the key/value cache holds for each token, over all layers
    weight: float  # bytes of a weight, on average
    slot: float  # bytes of a number in the key/value cache
    # number of tokens that a prefill computes beyond the prompt. 0 except for grown targets, which are enlarged with
    # untrained weights and a longer prompt to cost as much as a larger model.
    padding: int = 0
    # number of tokens that the drafter computes beyond the prompt, when it reads the prompt's hidden states
    drafter_padding: int = 0

    @classmethod
    def of(cls, language: Language, number: float, drafted: int = 0, keys: int = 0) -> Sizes:
        """Return the sizes of a Llama-style target and its one-layer drafter.

        Args:
            number: Bytes of a weight.
            drafted: Number of tokens that the drafter chooses from, whose rows of the head it reads. 0: all tokens.
            keys: Number of channels of a key, all heads together. 0: the hidden size.
        """
        width, layers, keys = language.hidden_size, language.num_hidden_layers, keys or language.hidden_size
        layer = 2 * width * (width + keys) + 3 * width * language.intermediate_size
        head, channels, cached = width * language.vocab_size, layers * width, 2 * layers * keys
        drafter = layer + width * (2 * width + (drafted or language.vocab_size))
        return cls(layers * layer, head, drafter, channels, cached, number, number)

    @property
    def trunk_weights(self) -> int:
        return self.layers + self.head

    def forward(self, rows: int, cached: int) -> tuple[float, float]:
        """Return the bytes that a forward reads, and its number of arithmetic operations.

        Every weight, key and value counts as read once. There are two operations per weight and token, and four per
        channel of each key that a token attends to.
        """
        rows += 0 if cached else self.padding
        read = self.trunk_weights * self.weight + float(self.cached) * (cached + rows) * self.slot
        attended = rows * cached + rows * (rows + 1) / 2
        return read, 2.0 * self.trunk_weights * rows + 4.0 * self.channels * attended

    def needs(self, kind: str, rows: int, prompt: int) -> tuple[float, float]:
        """Return the bytes that a phase of a decode reads, and its number of arithmetic operations.

        Both are 0 if the phase is not a forward of the target or the drafter.
        """
        if kind in ("prefill", "verify"):
            return self.forward(rows, prompt if kind == "verify" else 0)
        # number of passes over the drafter's weights, and of rows in all passes
        fed = rows + (self.drafter_padding if rows >= prompt else 0)
        passes = {"feed": (1, fed), "draft": (rows - 1, rows - 1), "tree": (rows - 1, _TREE_WIDTH * (rows - 1))}
        times, tokens = passes.get(kind, (0, 0))
        return times * self.drafter * self.weight, 2.0 * tokens * self.drafter


@dataclass(frozen=True)
class Shape:
    """The shape of a VLA, of its drafters and of a datastore."""

    name: str
    sizes: Sizes  # sizes of trunk, head and EAGLE's drafter
    layers: int
    prompt: int  # P, number of prompt tokens
    # needs of each phase that runs at most once per decode. The keys are kinds of phase: `encode` (vision towers and
    # projector), `early`, `retrieval`.
    parts: Mapping[str, Needs]

    def needs(self, kind: str, rows: int) -> Needs:
        if kind in self.parts:
            return self.parts[kind]
        bounds = self.sizes.needs(kind, rows, self.prompt)
        if kind in ("prefill", "verify"):
            return Needs(*bounds, layers=self.layers, kernels=_TRUNK, asks=True)
        passes = 1 if kind == "feed" else rows - 1
        return Needs(*bounds, layers=passes, kernels=passes * (_LEVEL if kind == "tree" else _CHAIN))


def priced(shape: Shape, device: Device, engine: Engine) -> Profile:
    """Return a latency profile with the computed seconds of each phase, for chunks of up to `CHUNK` tokens."""
    from kerv_cli.episodes.cost import EXTRA_ROUND, Profile

    rows = {
        "encode": (1,),
        "prefill": (shape.prompt, *(shape.prompt + n for n in _ROWS)),
        "verify": _ROWS,
        "feed": (*_ROWS, shape.prompt),
        "draft": _ROWS[1:],
        "tree": _ROWS[1:4],
        **dict.fromkeys(shape.parts, (1,)),
    }
    phases = {}
    for kind, counts in rows.items():
        more = engine.draft * (kind in ("draft", "tree"))
        phases[kind] = counts, tuple(engine.seconds(shape.needs(kind, n), device) + more for n in counts)
    about = {"target": shape.name, "device_name": device.title, EXTRA_ROUND: engine.extra_round}
    return Profile(shape.prompt, phases, CHUNK, about)


def encoder_of(towers: Sequence[Tower], width: int) -> Needs:
    """Return what one run of OpenVLA's vision encoder needs. `width` is the language model's.

    Each tower runs all its blocks but the last. A projector of three layers follows.
    """
    weights, flops, blocks, channels = 0.0, 0.0, 0, 0
    for tower in towers:
        tokens, depth = tower.patches + tower.prefix, tower.depth - 1
        block = 4 * tower.width**2 + 2 * tower.width * tower.feed_forward  # weights in its matrices
        read = depth * block + 3 * tower.patch**2 * tower.width
        weights += read
        flops += 2.0 * tokens * read + 4.0 * depth * tower.width * tokens**2
        blocks += depth
        channels += tower.width
    projector = channels * 4 * channels + 4 * channels * width + width**2
    flops += 2.0 * projector * towers[0].patches
    return Needs(_HALF * (weights + projector), flops, blocks=blocks, kernels=_ENCODER, asks=True)


def encoder_of_weights(weights: float, tokens: int) -> Needs:
    blocks = 0 if not weights else 27 if weights > 200e6 else 12  # SigLIP So400m's and ViT-B's
    return Needs(_HALF * weights, 2.0 * weights * tokens, blocks=blocks, kernels=_ENCODER * bool(weights), asks=True)


def vla_shape(name: str, language: Language, prompt: int, encoder: Needs, **sizes: int) -> Shape:
    """Return the shape of a VLA in bfloat16, with the shipped drafters and a datastore of 1,000 demonstrations.

    `sizes`: `drafted` and `keys` of `Sizes.of`.
    """
    width, trunk = language.hidden_size, Sizes.of(language, _HALF, **sizes)
    # The early drafter reads two pooled vectors, has two blocks of 384 units and spreads 32 features over 7 tokens. Its
    # kernels are counted in the shipped drafter. A datastore of 1,000 demonstrations has 45,221 keys of 32 numbers.
    early = 2 * width * 384 + 6 * 384**2 + 384 * 7 * 32 + 32 * 256
    parts = {
        "encode": encoder,
        "early": Needs(_HALF * early, 2.0 * early, kernels=57),
        "retrieval": Needs(_HALF * 45_221 * 32, 2.0 * 45_221 * 32, kernels=10),
    }
    return Shape(name, trunk, language.num_hidden_layers, prompt, parts)


def openvla(name: str, language: Language, towers: Sequence[Tower]) -> Shape:
    encoder = encoder_of(towers, language.hidden_size)
    return vla_shape(name, language, towers[0].patches + INSTRUCTION, encoder)


INSTRUCTION = 25  # assumed number of prompt tokens of an instruction
GEMMA = Language(257_152, 2048, 16_384, 18, 8)  # PaliGemma's language model, Gemma 2B; its heads share a key of 256
# Only the 2,048 tokens of the published FAST tokenizer are drafted. The target still ranks all 257,152.
PI0_FAST = {"drafted": 2048, "keys": 256}
# Shapes by name. The prompt of OpenVLA-7B is 256 patches and an instruction of 25 tokens.
SHAPES = {
    "openvla-7b": openvla("openvla-7b", Language(), tuple(TOWERS.values())),
    "pi0-fast": vla_shape("pi0-fast", GEMMA, 3 * 256 + INSTRUCTION, encoder_of_weights(414e6, 3 * 256), **PI0_FAST),
}
