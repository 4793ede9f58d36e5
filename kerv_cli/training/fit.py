"""The optimisation of targets and drafters: schedule, averaged weights, validation, exact resume.

A resumed run writes the same bytes as an uninterrupted run, on the same machine with the same number of threads.
"""

from __future__ import annotations

import copy
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
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError, Interrupted, KervError, UsageError
from kerv_cli.base.files import link_files, remove, unfinished, visible, write_bytes, write_folder, write_if_changed
from kerv_cli.base.paths import RESUME, check_free
from kerv_cli.base.runtime import set_up
from kerv_cli.engine.decoder import Stopwatch
from kerv_cli.episodes.identity import hash_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.settings import Stage, TrainSettings
from kerv_cli.worlds.demos.dataset import DemoDataset

T = TypeVar("T")
Metrics = dict[str, float]
# Takes the number of an optimisation step. Returns the loss (a scalar) of that step's batch, and metrics to log.
Loss = Callable[[int], tuple[Tensor, Metrics]]
# Takes the network. Returns metrics on held-out samples. The best weights are those with the highest `score`.
Validate = Callable[[Any], Metrics]
Save = Callable[[Any, Metrics], None]  # takes the network and the metrics of its validation, and writes its weights
# Takes the number of finished steps, the number of all steps, and the latest metrics as text
Progress = Callable[[int, int, str], None]

_UNREADABLE = (OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError, pickle.PickleError, zipfile.BadZipFile)
# Optimisation settings that may change when a training resumes
NOT_IDENTITY = ("steps", "validate_every", "init")

SAME_REQUEST = 2.0  # a second signal within this many seconds counts as the same request


def fit(
    network: nn.Module,
    loss: Loss,
    validate: Validate,
    save: Save,
    settings: TrainSettings,
    folder: Path,
    identity: str,
    progress: Progress = lambda done, total, text: None,
) -> Metrics:
    """Train a network for `settings.steps` steps in all, and return the metrics with the best score.

    If the folder holds a resume file, training continues from there.
    """
    network.train()
    state = State(network, settings, folder, identity)
    state.restore()
    with until_interrupted() as stop:
        while state.step < settings.steps:
            metrics = state.update(loss)
            progress(state.step, settings.steps, text_of(metrics))
            if state.step % settings.validate_every == 0 or state.step == settings.steps:
                state.validate(validate, save, metrics["loss"])
                progress(state.step, settings.steps, text_of(state.history[-1]))
            if stop.is_set() and state.step < settings.steps:
                state.store()
                raise Interrupted(f"interrupted: step {state.step} is saved. The same command resumes from there")
    if not state.history:
        raise CheckpointError(
            f"{folder} was interrupted at step {state.step}, before its first validation: set train.steps above that"
        )
    return max(state.history, key=lambda metrics: metrics["score"])


class State:
    """The state of a training: network, a copy of it with averaged weights, optimiser, step and metrics."""

    def __init__(self, network: nn.Module, settings: TrainSettings, folder: Path, identity: str) -> None:
        self.network, self.settings, self.folder, self.identity = network, settings, folder, identity
        self.step = 0
        self.history: list[Metrics] = []
        matrices = [parameter for parameter in network.parameters() if parameter.dim() >= 2]
        vectors = [parameter for parameter in network.parameters() if parameter.dim() < 2]
        groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.lr, betas=(0.9, 0.95), fused=True)
        self.average = copy.deepcopy(network).eval()

    def update(self, loss: Loss) -> Metrics:
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = settings.lr * schedule(self.step, settings)
        scalar, further = loss(self.step)
        metrics = {"loss": scalar.item(), **further}
        check_finite(metrics, self.step)
        self.optimiser.zero_grad(set_to_none=True)
        scalar.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip)
        self.optimiser.step()
        decay = min(settings.ema, (1 + self.step) / (10 + self.step))
        averaged, live = self.average.state_dict(), self.network.state_dict()
        with torch.no_grad():
            torch._foreach_lerp_(list(averaged.values()), list(live.values()), 1 - decay)
        self.step += 1
        return metrics

    def validate(self, validate: Validate, save: Save, training_loss: float) -> None:
        """Validate the averaged weights, save them if their score is the best so far, and write the resume file."""
        metrics = {"step": float(self.step), "train_loss": training_loss, **validate(self.average)}
        check_finite(metrics, self.step)
        self.history.append(metrics)
        if metrics["score"] >= max(one["score"] for one in self.history):
            save(self.average, metrics)
        self.store()

    def store(self) -> None:
        state = {
            "identity": self.identity,
            "step": self.step,
            "history": self.history,
            "model": self.network.state_dict(),
            "ema": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_bytes(self.folder / RESUME, buffer.getvalue())
        self.log()

    def log(self) -> None:
        import pandas as pd

        if self.history:
            table = pd.DataFrame(self.history).to_csv(index=False, float_format="%.6g")
            write_if_changed(self.folder / "log.csv", table.encode())

    def restore(self) -> None:
        """Continue from the folder's resume file, if there is one, and say so on stderr."""
        path = self.folder / RESUME
        if not path.is_file():
            return
        state = read_state(path)
        self.network.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.average.load_state_dict(state["ema"])
        self.step, self.history = state["step"], state["history"]
        self.log()  # the process may have ended before it wrote the log
        if self.step < self.settings.steps:
            print(f"resuming at step {self.step}", file=sys.stderr)


def text_of(metrics: Metrics) -> str:
    first = list(metrics.items())[:6]
    return " ".join(f"{name} {value:.4g}" for name, value in first if name != "step")


def check_finite(metrics: Metrics, step: int) -> None:
    for name, value in metrics.items():
        if not math.isfinite(value):
            raise KervError(f"training diverged: {name} is {value} at step {step}: lower train.lr")


def batches(count: int, settings: TrainSettings, weights: Tensor | None = None) -> Callable[[int], Tensor]:
    """Return a function that draws the samples of a step: their indices (B,) int64, fixed by `settings.seed` and step.

    Args:
        weights: (count,) float64. Sample i is drawn in proportion to `weights[i]`. If None, all are equally likely.
    """
    cumulative = None if weights is None else weights.cumsum(0)

    def draw(step: int) -> Tensor:
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + step)
        if cumulative is None:
            return torch.randint(count, (settings.batch,), generator=generator)
        numbers = torch.rand(settings.batch, generator=generator, dtype=torch.float64) * cumulative[-1]
        return torch.searchsorted(cumulative, numbers, right=True).clamp_(max=count - 1)

    return draw


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
    """Make the CPU treat subnormal numbers (below about 1e-38) as zero. Some CPUs compute 100 times slower with them.

    A thread that starts inside the context keeps this mode afterwards.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C (SIGINT) or SIGTERM into an event, so that the training can finish its step.

    A signal more than SAME_REQUEST seconds later raises KeyboardInterrupt. Ignored signals stay ignored.
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

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # a shell's background job and nohup ignore SIGINT
            before[number] = signal.signal(number, handle)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def identity_of(train: TrainSettings, dataset: DemoDataset, **own: Any) -> str:
    """Return a hash of the settings and data that determine the weights after a given number of steps."""
    counted = {key: value for key, value in asdict(train).items() if key not in NOT_IDENTITY}
    if train.stored == "float32":  # left out, so that trainings from before it counted can be resumed
        del counted["stored"]
    if not train.undisturbed:
        del counted["undisturbed"]
    counted["closed_loop"] = train.closed_loop > 0  # scores with and without success cannot be compared
    return hash_of({"train": counted, "demos": dataset.sha256, **own})


@dataclass(frozen=True)
class Destination:
    """Where a training writes: in its own folder, or in a temporary one that replaces older weights on completion."""

    folder: Path
    identity: str
    steps: int
    setting: str  # chooses another name, for error messages
    replace: bool
    begun: bool  # whether the newest command that made something in this folder did not complete

    def check(self) -> None:
        """Refuse to replace what the folder holds, unless `replace=true` was typed."""
        stored = self._stored(self.folder)
        if stored is None:
            check_free(self.folder, self.setting, self.replace or self.begun)
        elif not self.replace and stored[0] not in ("", self.identity):
            raise UsageError(
                f"{self.folder} holds a run with other settings or data: choose another {self.setting}=NAME, "
                "or type replace=true"
            )

    @contextmanager
    def opened(self) -> Iterator[Path]:
        """Yield the folder to train in. If it is temporary, it replaces `self.folder` when the `with` block ends."""
        new = unfinished(self.folder)
        in_place = not visible(self.folder) or (self.begun and self._resumes(self.folder))
        if not self.replace or (in_place and not new.exists()):
            yield self.folder
            return
        if not self._resumes(new):
            remove(new)
        new.mkdir(exist_ok=True)
        yield new
        write_folder(self.folder.resolve(), lambda temporary: link_files(new, temporary))
        remove(new)

    def _resumes(self, folder: Path) -> bool:
        stored = self._stored(folder)
        return stored is not None and stored[0] == self.identity and stored[1] <= self.steps

    @staticmethod
    def _stored(folder: Path) -> tuple[str, int] | None:
        """Return identity and step in a folder's resume file, None if there is no file, ("", 0) if it is damaged."""
        try:
            state = torch.load(folder / RESUME, "cpu", mmap=True, weights_only=True)
            return state["identity"], state["step"]
        except FileNotFoundError:
            return None
        except _UNREADABLE:
            return "", 0  # without replace=true, reading the whole state says what is damaged


FEW = 4  # episodes from which `--plan` makes the samples to measure


def timed(device: torch.device | str, action: Callable[[], T]) -> tuple[float, T]:
    """Call a function twice. Return the seconds and the result of the second call; the first loads and compiles."""
    for _ in range(2):
        clock = Stopwatch(torch.device(device))
        result = action()
        seconds = clock.stop()
    return seconds, result


def seconds_of(loss: Loss, settings: TrainSettings, device: torch.device) -> float:
    """Estimate how long all steps of a training take, from two of them. The first one counts as warm-up."""
    with without_subnormals():
        of_step, _ = timed(device, lambda: loss(settings.scene_steps)[0].backward())
    return settings.steps * of_step


def read_state(path: Path) -> dict[str, Any]:
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


# Takes a folder, a network and the provenance of its weights, and writes them
Write = Callable[[Path, Any, dict[str, Any]], object]
Made = tuple[nn.Module, Loss, Validate, Write]
# Takes demonstrations and a progress function. Makes the network, and its samples from the demonstrations.
Ready = Callable[[DemoDataset, Callable[..., None]], Made]


def train(
    settings: Any, dataset: DemoDataset, place: Destination, command: str, reading: str, ready: Ready, stage: Stage
) -> tuple[Path, Metrics]:
    """Carry out a training whose settings were checked. Return its folder and the metrics of the best weights.

    Args:
        settings: Settings of the command, with `train` and `runtime`.
        dataset: The demonstrations.
        place: Where to write.
        command: The command, for the provenance of the weights.
        reading: Title of the stage in which `ready` makes the samples.
        ready: Makes the network and the samples.
        stage: Shows the stages.
    """
    provenance = provenance_of(command, settings, set_up(settings.runtime)[0])
    with place.opened() as folder, without_subnormals():
        with stage(reading) as progress:
            network, loss, validate, write = ready(dataset, progress)

        def save(network: Any, metrics: Metrics) -> None:
            demos = {"sha256": dataset.sha256, "config": dataset.manifest.config}
            size = sum(parameter.numel() for parameter in network.parameters())
            write(folder, network, {**provenance, "demos": demos, "validation": metrics, "parameters": size})

        with stage("training") as progress:
            metrics = fit(network, loss, validate, save, settings.train, folder, place.identity, progress)
    return place.folder, metrics
