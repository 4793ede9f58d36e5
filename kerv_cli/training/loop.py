"""The optimisation loop of targets and drafters: schedule, averaged weights, validation, exact resume.

A resumed run writes the same bytes as an uninterrupted run, on the same machine with the same number of threads. For
this, the batch of step s depends only on the seed and s. The resume file holds the weights, their average, the
optimiser's state and the metrics of all validations.
"""

from __future__ import annotations

import io
import math
import pickle
import signal
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError, Interrupted, KervError
from kerv_cli.base.files import write_bytes, write_if_changed
from kerv_cli.targets.folders import RESUME
from kerv_cli.training.settings import TrainSettings

Metrics = dict[str, float]
_UNREADABLE = (OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError, pickle.PickleError, zipfile.BadZipFile)
SAME_REQUEST = 2.0
"""A second signal within this many seconds counts as the same request.

A scheduler may pass on a Ctrl-C that the process has received already.
"""


class Objective(Protocol):
    """What a training optimises: a network, its training samples and its loss.

    An optional attribute `weights` (n,) float64 makes sample i as likely to be drawn as `weights[i]`. Without it all
    samples are equally likely.
    """

    @property
    def module(self) -> nn.Module:
        """The network to train, on its device."""

    def __len__(self) -> int:
        """Return the number of training samples."""

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the loss (a scalar) of the samples `indices` (B,) at optimisation step `step`, and metrics to log."""

    def validate(self, module: nn.Module) -> Metrics:
        """Return metrics of a network on held-out samples. The best weights are those with the highest `score`."""


class Loop:
    """Trains a network: draws batches, updates the weights, validates, and saves the best weights.

    Args:
        objective: The network, its training samples and its loss.
        save: Called with the module and its metrics after each validation whose score is the best so far.
        settings: Optimisation settings.
        folder: Folder for the resume file and `log.csv`.
        identity: Hash of everything that determines the training. It goes into the resume file.
    """

    def __init__(
        self,
        objective: Objective,
        save: Callable[[nn.Module, Metrics], None],
        settings: TrainSettings,
        folder: Path,
        identity: str,
    ) -> None:
        self.objective, self.module, self.save, self.settings = objective, objective.module, save, settings
        self.folder, self.identity = folder, identity
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
        """Train to `settings.steps`, from the resume file if there is one, and return the metrics of the best weights.

        Args:
            on_step: Called after each step and after each validation, with the number of steps done and the metrics.

        Raises:
            CheckpointError: The resume file is damaged. Or it has reached `settings.steps` without a validation.
            KervError: The training diverged.
            StorageError: The disk cannot be written.
            Interrupted: The process got Ctrl-C or SIGTERM. The current step was finished and the state is saved.
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
                    raise Interrupted(f"interrupted: step {self.step} is saved. The same command resumes from there")
        if not self.history:
            raise CheckpointError(
                f"{self.folder} was interrupted at step {self.step}, before its first validation: set train.steps "
                "above that"
            )
        return max(self.history, key=lambda metrics: metrics["score"])

    def update(self) -> Metrics:
        """Do one optimiser step on one batch, and return its loss and the other metrics to log.

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
        """Validate the averaged weights, save them if their score is the best so far, and write the resume file.

        Args:
            training_loss: Loss of the last step, to log beside the metrics.

        Raises:
            KervError: A metric is not finite.
            StorageError: The disk cannot be written.
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
        """Write the resume file with the present state, then `log.csv`."""
        state = {
            "identity": self.identity,
            "step": self.step,
            "history": self.history,
            "model": self.module.state_dict(),
            "ema": self.ema,
            "optimiser": self.optimiser.state_dict(),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_bytes(self.folder / RESUME, buffer.getvalue())
        self.log()

    def log(self) -> None:
        """Write the metrics of all validations to `log.csv`. Before the first validation no file is written."""
        import pandas as pd

        if self.history:
            table = pd.DataFrame(self.history).to_csv(index=False, float_format="%.6g")
            write_if_changed(self.folder / "log.csv", table.encode())

    def restore(self) -> None:
        """Load weights, optimiser and progress from the folder's resume file. Without a file, change nothing.

        Raises:
            CheckpointError: The resume file is damaged.
        """
        path = self.folder / RESUME
        if not path.is_file():
            return
        state = read_state(path)
        self.module.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        for name, average in self.ema.items():
            average.copy_(state["ema"][name])
        self.step, self.history = state["step"], state["history"]
        self.log()  # the process may have ended before it wrote the log


def draw_samples(count: int, size: int, generator: torch.Generator, cumulative: Tensor | None = None) -> Tensor:
    """Draw the sample indices of a batch, with replacement.

    Args:
        count: Number of samples.
        size: Number of indices to draw.
        generator: Source of randomness.
        cumulative: (count,) float64, cumulative sum of the samples' weights. None: all samples are equally likely.

    Returns:
        (size,) int64.
    """
    if cumulative is None:
        return torch.randint(count, (size,), generator=generator)
    numbers = torch.rand(size, generator=generator, dtype=torch.float64) * cumulative[-1]
    return torch.searchsorted(cumulative, numbers, right=True).clamp_(max=count - 1)


def schedule(step: int, settings: TrainSettings) -> float:
    """Return the learning rate of a step as a share of `settings.lr`: linear warm-up, then a cosine down to 2 %.

    The schedule runs once over the first `scene_steps` steps and starts again for the remaining steps.
    """
    begin, end = (0, settings.scene_steps) if step < settings.scene_steps else (settings.scene_steps, settings.steps)
    if step - begin < settings.warmup:
        return (step - begin + 1) / settings.warmup
    share = (step - begin - settings.warmup) / max(1, end - begin - settings.warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, share)))


@contextmanager
def without_subnormals() -> Iterator[None]:
    """Make the CPU treat subnormal numbers (below about 1e-38) as zero, if it can.

    The backward pass of the vision encoder's spatial softmax makes many subnormal numbers, and some CPUs compute a
    hundred times slower with them. A thread that starts inside the context keeps this mode afterwards.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C (SIGINT) or SIGTERM into an event, so that the training can finish its step.

    A later signal raises KeyboardInterrupt. A signal that the process ignores stays ignored.

    Yields:
        The event. The first signal sets it.
    """
    stop = threading.Event()
    first = math.inf

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal first
        first = min(first, time.monotonic())
        if time.monotonic() - first > SAME_REQUEST:
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


def stored_identity(folder: Path) -> str | None:
    """Return the identity hash in the folder's resume file; None if there is no file that can be read."""
    try:
        return str(torch.load(folder / RESUME, "cpu", mmap=True, weights_only=True)["identity"])
    except _UNREADABLE:
        return None


def read_state(path: Path) -> dict[str, Any]:
    """Return the state in a resume file: identity, step, history of metrics, weights, their average and optimiser.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is not None:  # torch itself does not compare the checksums
                raise ValueError("a checksum is wrong")
        state: dict[str, Any] = torch.load(path, "cpu", weights_only=True)
    except _UNREADABLE as error:
        remedy = f"move {path.parent} aside to begin again"
        reason = " ".join(str(error).split())
        raise CheckpointError(f"training state at {path} is damaged ({reason}): {remedy}") from error
    return state
