"""Where a policy's decode spends its time on a CPU: products and attention, other tensor operations, Python."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from kerv_cli.bench.model import Model, blank
from kerv_cli.config import compose as compose_settings
from kerv_cli.decoding.build import compose, needs
from kerv_cli.decoding.decoder import Decoder
from kerv_cli.settings import RolloutSettings
from kerv_cli.spaces import Observation
from kerv_cli.targets.compact import packed

_PROFILED = 5  # decodes under the profiler: a thousand events each
METHODS = ("ar", "spec_vla", "one_pass")
PRODUCTS = ("mm", "mv", "dot", "linear", "convolution", "scaled_dot_product", "softmax", "einsum")
"""Parts of the names of operations that are products, convolutions or attention."""


@dataclass(frozen=True)
class DecodeShare:
    """Seconds of one decode, median. products: in products, convolutions and attention. operations: in all tensor
    operations. Both are the profiler's self times, which include its own cost per call: `rest` is an upper bound of
    what is neither products nor attention only where that cost is small."""

    method: str
    seconds: float
    products: float
    operations: float

    @property
    def rest(self) -> float:
        """Share of the decode that is neither products nor attention, in [0, 1]."""
        return 1.0 - self.products / self.seconds


def is_product(name: str) -> bool:
    """Whether an operation of this name is a product, a convolution or attention."""
    operation = name.rpartition("::")[2]
    return any(part in operation for part in PRODUCTS)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Nothing reaches standard error: the profiler writes its stages there, whatever its log level."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextlib.contextmanager
def timed_row_products() -> Iterator[list[float]]:
    """Collects the seconds of the products that numpy computes (`packed.row_product`)."""
    seconds: list[float] = []
    plain = packed.row_product

    def timed(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        begin = time.perf_counter()
        product = plain(x, weight)
        seconds.append(time.perf_counter() - begin)
        return product

    packed.row_product = timed
    try:
        yield seconds
    finally:
        packed.row_product = plain


def share_of(method: str, decoder: Decoder, observation: Observation, repeats: int) -> DecodeShare:
    """Measures `repeats` decodes without the profiler, and a few with it."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(2):
        decoder.decode(observation)
    seconds = [decoder.decode(observation).seconds for _ in range(repeats)]
    with quiet(), timed_row_products() as rows, profile(activities=[ProfilerActivity.CPU]) as profiled:
        for _ in range(_PROFILED):
            decoder.decode(observation)
    events = [(event.key, event.self_cpu_time_total / 1e6 / _PROFILED) for event in profiled.key_averages()]
    by_numpy = sum(rows) / _PROFILED
    products = sum(own for name, own in events if is_product(name)) + by_numpy
    return DecodeShare(method, float(np.median(seconds)), products, sum(own for _, own in events) + by_numpy)


def measure_shares(model: Model, repeats: int, methods: Sequence[str] = METHODS) -> list[DecodeShare]:
    """Of a policy on a CPU, for every method whose artifacts are there; nothing for shapes and other devices."""
    artifacts: Any = model.artifacts
    if artifacts is None or torch.device(model.target.device).type != "cpu":
        return []
    found = []
    for name in methods:
        settings = compose_settings("rollout", [f"method={name}"], RolloutSettings)
        if not all(artifacts.place(kind).exists() for kind in needs(settings.parts())):
            continue
        decoder = compose(settings.parts(), model.target, artifacts.load)
        decoder.reset("", 0, np.zeros(3))
        for _ in range(10):
            decoder.observe(np.zeros(model.target.actions.dofs), np.zeros(3))
        found.append(share_of(name, decoder, blank(model.target), repeats))
    return found
