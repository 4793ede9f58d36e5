"""The optimisation loop that the target and the drafters share: schedule, EMA, validation, exact resume.

The batch of step s is a function of (seed, s), and one resume file holds weights, EMA, optimiser moments, best score
and history: an interrupted and resumed run writes the same bytes as an uninterrupted one (same machine and threads).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError, Interrupted, KervError
from kerv_cli.base.files import write_text
from kerv_cli.base.manifests import read
from kerv_cli.base.places import RESUME
from kerv_cli.targets.checkpoint import load_tensors, save_tensors
from kerv_cli.training.interruption import until_interrupted
from kerv_cli.training.settings import TrainSettings

Metrics = dict[str, float]


class Lesson(Protocol):
    """What a module learns: its training samples, their loss and a validation."""

    @property
    def module(self) -> nn.Module:
        """What is trained, on its device."""

    def __len__(self) -> int:
        """Number of training samples."""

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """The samples of a batch (B,) -> scalar loss, and logged numbers."""

    def validate(self, module: nn.Module) -> Metrics:
        """Metrics of the EMA weights with a `score`, higher is better."""


def draw_samples(samples: int, size: int, generator: torch.Generator, borders: Tensor | None = None) -> Tensor:
    """(size,) int64 of `samples` samples, with replacement. borders (samples,) float64: the sums of their weights up to
    each, increasing; None: all alike."""
    if borders is None:
        return torch.randint(samples, (size,), generator=generator)
    numbers = torch.rand(size, generator=generator, dtype=torch.float64) * borders[-1]
    return torch.searchsorted(borders, numbers, right=True).clamp_(max=samples - 1)


@dataclass(frozen=True)
class RunProgress:
    """The progress of a run. identity: hash of everything that determines it. step: steps done. best: greatest score so
    far, None before the first validation. history: the metrics of every validation."""

    identity: str
    step: int
    best: float | None
    history: list[Metrics]


class Loop:
    """Optimises a lesson's module. save: writes the best weights, which have these metrics. folder: holds
    `resume.safetensors` and `log.csv`. identity: hash of everything that determines the run; another run is never
    resumed. borders: of `draw_samples`. keep: told every validation so far, after each one and when the run goes on."""

    def __init__(
        self,
        lesson: Lesson,
        save: Callable[[nn.Module, Metrics], None],
        settings: TrainSettings,
        folder: Path,
        identity: str,
        borders: Tensor | None = None,
        keep: Callable[[list[Metrics]], None] = lambda history: None,
    ) -> None:
        self.keep = keep
        self.lesson, self.module, self.save, self.settings = lesson, lesson.module, save, settings
        self.folder, self.identity, self.borders = folder, identity, borders
        self.step, self.best = 0, -math.inf
        self.history: list[Metrics] = []
        decay = [p for p in self.module.parameters() if p.dim() >= 2]
        rest = [p for p in self.module.parameters() if p.dim() < 2]
        groups = [{"params": decay, "weight_decay": settings.weight_decay}, {"params": rest, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.lr, betas=(0.9, 0.95), fused=True)
        self.ema = {k: v.detach().clone() for k, v in self.module.state_dict().items()}

    def run(self, on_step: Callable[[int, Metrics], None] = lambda step, metrics: None) -> Metrics:
        """Trains to `settings.steps`, resuming what the folder holds -> metrics of the best checkpoint.

        Raises:
            CheckpointError: as `restore`, or no step is left and no validation was made. KervError: training diverged.
            StorageError: writing failed. Interrupted: Ctrl-C; the step that ran was finished and the run's state is
            stored.
        """
        self.restore()
        settings = self.settings
        with until_interrupted() as stop:
            while self.step < settings.steps:
                metrics = self.update()
                self.step += 1
                on_step(self.step, metrics)
                if self.step % settings.validate_every == 0 or self.step == settings.steps:
                    self.check(metrics)
                    on_step(self.step, self.history[-1])
                if stop.is_set() and self.step < settings.steps:
                    self.store()
                    raise Interrupted(f"interrupted: step {self.step} is saved, the same command goes on from there")
        if not self.history:
            raise CheckpointError(
                f"{self.folder} was interrupted at step {self.step}, before its first validation: set train.steps "
                "above that"
            )
        return max(self.history, key=lambda m: m["score"])

    def update(self) -> Metrics:
        """One optimiser step -> loss and logged numbers.

        Raises:
            KervError: the loss is not finite.
        """
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = settings.lr * schedule(self.step, settings)
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        indices = draw_samples(len(self.lesson), settings.batch, generator, self.borders)
        loss, metrics = self.lesson.loss(indices, self.step)
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

    def check(self, training: Metrics) -> None:
        """Validates the EMA weights, saves the best, writes the resume file. training: numbers of the last step.

        Raises:
            KervError: a metric is not finite. StorageError: writing failed.
        """
        module = self.module
        live = {k: v.detach().clone() for k, v in module.state_dict().items()}
        module.load_state_dict(self.ema)
        module.eval()
        metrics = {"step": float(self.step), "train_loss": training["loss"], **self.lesson.validate(module)}
        broken = [name for name, value in metrics.items() if not math.isfinite(value)]
        if broken:
            raise KervError(
                f"training diverged: {broken[0]} is {metrics[broken[0]]} at step {self.step}: lower train.lr"
            )
        self.history.append(metrics)
        if metrics["score"] >= self.best:
            self.best = metrics["score"]
            self.save(module, metrics)
        module.load_state_dict(live)
        module.train()
        self.store()

    def store(self) -> None:
        """Writes the resume file, then the log."""
        tensors = {f"model.{k}": v for k, v in self.module.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.ema.items()}
        for i, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{i}.{k}": v for k, v in moments.items()}
        best = self.best if self.history else None
        progress = RunProgress(self.identity, self.step, best, self.history)
        write_state(self.folder / RESUME, tensors, progress)
        self.log()

    def log(self) -> None:
        """Keep the curve, and write `log.csv`, a row per validation; no file before the first."""
        import pandas as pd

        self.keep(self.history)
        if not self.history:
            return
        write_text(self.folder / "log.csv", pd.DataFrame(self.history).to_csv(index=False, float_format="%.6g"))

    def restore(self) -> None:
        """Continues from the folder's resume file, if there is one.

        Raises:
            CheckpointError: it is of a run with other settings or data, or damaged.
        """
        path = self.folder / RESUME
        if not path.is_file():
            self.keep([])  # of a run that was here before
            return
        tensors, progress = read_state(path)
        check_same_run(self.folder, progress.identity, self.identity, "move it aside")
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
        self.best = -math.inf if progress.best is None else progress.best
        self.log()  # the run may have ended before it wrote the log


def check_same_run(folder: Path, stored: str, identity: str, remedy: str) -> None:
    """Raises CheckpointError: the run in the folder has an identity, `stored`, other than this one."""
    if stored != identity:
        raise CheckpointError(f"{folder} holds a run with other settings or data: {remedy}")


def stored_identity(folder: Path) -> str | None:
    """The identity of the run in the folder, without its tensors; None: no run, or a damaged one, as `read_state` will
    say."""
    try:
        with safe_open(folder / RESUME, "pt") as file:
            return str(json.loads(json.loads((file.metadata() or {})["state"])["progress"])["identity"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError):
        return None


def write_state(path: Path, tensors: Mapping[str, Tensor], progress: RunProgress) -> None:
    """Writes tensors and progress into one file, so that a kill cannot leave them at different steps."""
    text = json.dumps(asdict(progress), allow_nan=False)
    # one key, because safetensors writes several in random order and equal states shall be equal bytes
    save_tensors(path, tensors, {"state": json.dumps({"progress": text, "sha256": digest(tensors, text)})})


def read_state(path: Path) -> tuple[dict[str, Tensor], RunProgress]:
    """The inverse of `write_state`.

    Raises:
        CheckpointError: the file is damaged, or holds numbers that are not finite.
    """
    again = f"move {path.parent} aside to begin again"
    try:
        with safe_open(path, "pt") as file:
            state = json.loads((file.metadata() or {})["state"])
        tensors, text = load_tensors(path, "training state"), state["progress"]
        intact, value = state["sha256"] == digest(tensors, text), json.loads(text)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"training state at {path} is damaged ({error}): {again}") from error
    if not intact:
        raise CheckpointError(f"training state at {path} is damaged, its hash does not fit: {again}")
    return tensors, read(RunProgress, value, str(path))


def digest(tensors: Mapping[str, Tensor], text: str) -> str:
    """Hex SHA-256 over names, types, shapes and bytes of tensors, and a text."""
    hasher = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        hasher.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        hasher.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return hasher.hexdigest()


@contextmanager
def without_subnormals() -> Iterator[None]:
    """Numbers below 1e-38 count as zero within, where the CPU can do so: in this thread, and for good in those that it
    starts meanwhile. The soft-argmax of image points leaves many in the backward pass once its maps are sharp, and some
    CPUs take a hundred times as long for each."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def schedule(step: int, settings: TrainSettings) -> float:
    """Factor of the learning rate: linear warm-up, then cosine to 2 % of the peak; once for the first `scene_steps` and
    once for the rest."""
    begin, end = (0, settings.scene_steps) if step < settings.scene_steps else (settings.scene_steps, settings.steps)
    if step - begin < settings.warmup:
        return (step - begin + 1) / settings.warmup
    share = (step - begin - settings.warmup) / max(1, end - begin - settings.warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, share)))
