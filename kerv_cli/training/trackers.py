"""Send the curves of a training to an experiment tracker: Trackio, Weights & Biases or TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from kerv_cli.base.errors import UsageError

MOST_POINTS = 1000
"""Maximum number of points per training curve, so that training does not wait for its tracker.

All validations are logged as well.
"""
_MODULES = {"trackio": "trackio", "wandb": "wandb", "tensorboard": "torch.utils.tensorboard"}


@contextmanager
def tracked(
    tracker: str, name: str, folder: Path, steps: int, config: Mapping[str, object]
) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Open a tracker for one training.

    Args:
        tracker: `trackio`, `wandb`, `tensorboard` or `none`.
        name: Name of the run in the tracker.
        folder: Folder of the training. TensorBoard's files go there.
        steps: Number of steps of the whole training.
        config: Settings to show beside the curves.

    Yields:
        A function that logs metrics by name at a step. Metrics with a key `step` are those of a validation.

    Raises:
        UsageError: The tracker is not installed.
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
