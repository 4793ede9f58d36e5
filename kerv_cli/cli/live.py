"""Curves of a training as it runs, in a tracker (`log=`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from kerv_cli.base.errors import UsageError

LogStep = Callable[[int, Mapping[str, float]], None]
MOST_POINTS = 1000
"""Of a curve, so that a long run does not wait for its tracker; validations are all logged."""
_MODULES = {"trackio": "trackio", "wandb": "wandb", "tensorboard": "torch.utils.tensorboard"}


@contextmanager
def live(tracker: str, name: str, folder: Path, steps: int, config: Mapping[str, object]) -> Iterator[LogStep]:
    """Yields what takes the numbers of a step: of an update, or of a validation, which has a `step` among them.

    Args:
        tracker: trackio, wandb, tensorboard; none: nothing is logged.
        folder: of the training; TensorBoard's files go there.
        steps: of the whole run.

    Raises:
        UsageError: the tracker is not installed.
    """
    if tracker == "none":
        yield lambda step, numbers: None
        return
    try:
        module = import_module(_MODULES[tracker])
    except ImportError as error:
        raise UsageError(f"log={tracker}: pip install 'kerv[{tracker}]'") from error
    if tracker == "tensorboard":
        run = module.SummaryWriter(str(folder / "tensorboard"))
    else:
        run = module.init(project="kerv", name=name, config=dict(config))

    def log(step: int, numbers: Mapping[str, float]) -> None:
        validation = "step" in numbers
        if not validation and step % max(1, steps // MOST_POINTS):
            return
        kind = "validation" if validation else "training"
        named = {f"{kind}/{key}": value for key, value in numbers.items() if key != "step"}
        if tracker == "tensorboard":
            for key, value in named.items():
                run.add_scalar(key, value, step)
        else:
            run.log(named, step=step)

    try:
        yield log
    finally:
        (run.close if tracker == "tensorboard" else run.finish)()
