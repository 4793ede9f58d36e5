"""The optimisation loop that the target and the drafters share: schedule, EMA, validation, exact resume.

The batch of step s is a function of (seed, s), and one file holds weights, EMA, moments, best score and history. So a
resumed run writes the same bytes as an uninterrupted one, on the same machine with the same number of threads.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Protocol

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError, Interrupted, KervError
from kerv_cli.base.files import write_text
from kerv_cli.base.manifests import read
from kerv_cli.targets.checkpoint import load_tensors, save_tensors
from kerv_cli.targets.folders import RESUME
from kerv_cli.training.settings import TrainSettings

Metrics = dict[str, float]
_UNREADABLE = (SafetensorError, OSError, KeyError, TypeError, ValueError)
SAME_REQUEST = 2.0
"""Seconds in which a second signal is the same request: schedulers pass on what the process has received already."""


class Objective(Protocol):
    """A module, its training samples and its loss.

    An attribute `weights` (n,), float64, makes sample i be drawn in proportion to `weights[i]`; without it all samples
    are drawn alike.
    """

    @property
    def module(self) -> nn.Module:
        """What is trained, on its device."""

    def __len__(self) -> int:
        """Return the number of training samples."""

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the scalar loss of the samples `indices` (B,), and numbers to log."""

    def validate(self, module: nn.Module) -> Metrics:
        """Return metrics of the averaged weights, among them a `score`: higher is better."""


class Loop:
    """Optimises a module.

    Args:
        objective: The module, its samples and its loss.
        save: Called with the module and its metrics when a validation is the best so far.
        settings: Optimisation settings.
        folder: Gets `resume.safetensors` and `log.csv`.
        identity: Hash of everything that determines the run, for the resume file.
        keep: Called with the metrics of all validations after each one, and when a run goes on.
    """

    def __init__(
        self,
        objective: Objective,
        save: Callable[[nn.Module, Metrics], None],
        settings: TrainSettings,
        folder: Path,
        identity: str,
        keep: Callable[[list[Metrics]], None] = lambda history: None,
    ) -> None:
        self.objective, self.module, self.save, self.settings = objective, objective.module, save, settings
        self.folder, self.identity, self.keep = folder, identity, keep
        self.step = 0
        self.history: list[Metrics] = []
        matrices = [p for p in self.module.parameters() if p.dim() >= 2]
        vectors = [p for p in self.module.parameters() if p.dim() < 2]
        groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.lr, betas=(0.9, 0.95), fused=True)
        self.ema = {k: v.detach().clone() for k, v in self.module.state_dict().items()}
        weights: Tensor | None = getattr(objective, "weights", None)
        self.cumulative = None if weights is None else weights.cumsum(0)

    def run(self, on_step: Callable[[int, Metrics], None] = lambda step, metrics: None) -> Metrics:
        """Train to `settings.steps`, from the resume file if there is one; return the metrics of the best checkpoint.

        Raises:
            CheckpointError: The folder holds a damaged run, or no step is left and no validation was made.
            KervError: The training diverged.
            StorageError: The disk refused.
            Interrupted: Ctrl-C. The step that ran was finished and the run's state is stored.
        """
        self.restore()
        settings = self.settings
        with until_interrupted() as stop:
            while self.step < settings.steps:
                metrics = self.update()
                self.step += 1
                on_step(self.step, metrics)
                if self.step % settings.validate_every == 0 or self.step == settings.steps:
                    self.validate(metrics["loss"])
                    on_step(self.step, self.history[-1])
                if stop.is_set() and self.step < settings.steps:
                    self.store()
                    raise Interrupted(f"interrupted: step {self.step} is saved, the same command goes on from there")
        if not self.history:
            raise CheckpointError(
                f"{self.folder} was interrupted at step {self.step}, before its first validation: set train.steps "
                "above that"
            )
        return max(self.history, key=lambda metrics: metrics["score"])

    def update(self) -> Metrics:
        """Make one optimiser step and return its loss and logged numbers.

        Raises:
            KervError: The loss is not finite.
        """
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = settings.lr * schedule(self.step, settings)
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        indices = draw_samples(len(self.objective), settings.batch, generator, self.cumulative)
        loss, metrics = self.objective.loss(indices, self.step)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        value = loss.item()
        if not math.isfinite(value):
            raise KervError(f"training diverged at step {self.step} (loss {value}): lower train.lr")
        nn.utils.clip_grad_norm_(self.module.parameters(), settings.clip)
        self.optimiser.step()
        decay = min(settings.ema, (1 + self.step) / (10 + self.step))
        live = self.module.state_dict()
        with torch.no_grad():
            torch._foreach_lerp_([self.ema[k] for k in live], list(live.values()), 1 - decay)
        return {"loss": value, **metrics}

    def validate(self, training_loss: float) -> None:
        """Validate the averaged weights, save them if they are the best, and write the resume file.

        Raises:
            KervError: A metric is not finite.
            StorageError: The disk refused.
        """
        module = self.module
        live = {k: v.detach().clone() for k, v in module.state_dict().items()}
        module.load_state_dict(self.ema)
        module.eval()
        metrics = {"step": float(self.step), "train_loss": training_loss, **self.objective.validate(module)}
        for name, value in metrics.items():
            if not math.isfinite(value):
                raise KervError(f"training diverged: {name} is {value} at step {self.step}: lower train.lr")
        self.history.append(metrics)
        if metrics["score"] >= max(one["score"] for one in self.history):
            self.save(module, metrics)
        module.load_state_dict(live)
        module.train()
        self.store()

    def store(self) -> None:
        """Write the resume file, then the log."""
        tensors = {f"model.{k}": v for k, v in self.module.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.ema.items()}
        for i, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{i}.{k}": v for k, v in moments.items()}
        write_state(self.folder / RESUME, tensors, Progress(self.identity, self.step, self.history))
        self.log()

    def log(self) -> None:
        """Keep the curve and write `log.csv`, a row per validation; no file before the first."""
        import pandas as pd

        self.keep(self.history)
        if self.history:
            write_text(self.folder / "log.csv", pd.DataFrame(self.history).to_csv(index=False, float_format="%.6g"))

    def restore(self) -> None:
        """Go on from the folder's resume file, if there is one.

        Raises:
            CheckpointError: It is damaged.
        """
        path = self.folder / RESUME
        if not path.is_file():
            self.keep([])  # forget the curve of a run that was here before
            return
        tensors, progress = read_state(path)
        self.module.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("model.")})
        self.ema = {k[4:]: v.to(self.ema[k[4:]].device) for k, v in tensors.items() if k.startswith("ema.")}
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith("optimiser."):
                _, index, key = name.split(".")
                state.setdefault(int(index), {})[key] = tensor
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": state, "param_groups": groups})
        self.step, self.history = progress.step, progress.history
        self.log()  # the run may have ended before it wrote the log


def draw_samples(count: int, size: int, generator: torch.Generator, cumulative: Tensor | None = None) -> Tensor:
    """Draw `size` of `count` sample indices, int64, with replacement.

    Args:
        count: Number of samples.
        size: Number of draws.
        generator: Source of randomness.
        cumulative: (count,) float64, cumulative sum of the samples' weights; None: all samples alike.
    """
    if cumulative is None:
        return torch.randint(count, (size,), generator=generator)
    numbers = torch.rand(size, generator=generator, dtype=torch.float64) * cumulative[-1]
    return torch.searchsorted(cumulative, numbers, right=True).clamp_(max=count - 1)


def schedule(step: int, settings: TrainSettings) -> float:
    """Return the factor of the learning rate: linear warm-up, then cosine to 2 % of the peak.

    It runs once over the first `scene_steps` and once over the rest.
    """
    begin, end = (0, settings.scene_steps) if step < settings.scene_steps else (settings.scene_steps, settings.steps)
    if step - begin < settings.warmup:
        return (step - begin + 1) / settings.warmup
    share = (step - begin - settings.warmup) / max(1, end - begin - settings.warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, share)))


@contextmanager
def without_subnormals() -> Iterator[None]:
    """Treat numbers below 1e-38 as zero, if the CPU can.

    The soft-argmax of image points leaves many of them in the backward pass, and some CPUs are a hundred times slower
    with them. Threads that start inside keep the mode.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a later one of the same kind raises KeyboardInterrupt.

    Outside the main thread nothing sets it. A signal that is ignored stays ignored.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    first_times: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - first_times.setdefault(number, now) > SAME_REQUEST:
            raise KeyboardInterrupt
        if not stop.is_set():
            again = "Ctrl-C again" if number == signal.SIGINT else "a second one"
            print(f"stopping after this step; {again} stops at once and keeps the last saved state", file=sys.stderr)
        stop.set()

    # a shell's background job and nohup ignore SIGINT
    signals = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in signals}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        identity: Hash of everything that determines the run.
        step: Steps done.
        history: Metrics of every validation.
    """

    identity: str
    step: int
    history: list[Metrics]


def stored_identity(folder: Path) -> str | None:
    """Return the identity of the run in the folder without reading its tensors; None if there is none to read."""
    try:
        return str(json.loads(_state(folder / RESUME)["progress"])["identity"])
    except _UNREADABLE:
        return None


def write_state(path: Path, tensors: Mapping[str, Tensor], progress: Progress) -> None:
    """Write tensors and progress into one file."""
    text = json.dumps(asdict(progress), allow_nan=False)
    # one key: safetensors orders several at random, and equal states must be equal bytes
    save_tensors(path, tensors, {"state": json.dumps({"progress": text, "sha256": digest(tensors, text)})})


def read_state(path: Path) -> tuple[dict[str, Tensor], Progress]:
    """Read what `write_state` wrote.

    Raises:
        CheckpointError: The file is damaged, or holds numbers that are not finite.
    """
    try:
        state = _state(path)
        tensors, text = load_tensors(path, "training state"), state["progress"]
        if state["sha256"] != digest(tensors, text):
            raise ValueError("its hash does not fit")
        return tensors, read(Progress, json.loads(text), str(path), tolerant=True)
    except _UNREADABLE as error:
        remedy = f"move {path.parent} aside to begin again"
        raise CheckpointError(f"training state at {path} is damaged ({error}): {remedy}") from error


def _state(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        state: dict[str, str] = json.loads((file.metadata() or {})["state"])
    return state


def digest(tensors: Mapping[str, Tensor], text: str) -> str:
    """Return the SHA-256 over names, types, shapes and bytes of tensors, and a text."""
    hasher = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        hasher.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        hasher.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return hasher.hexdigest()
