"""Send the curves of a training to Weights & Biases."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from kerv_cli.base.errors import UsageError

MOST_POINTS = 1000
"""Maximum number of points per training curve, so that training does not wait. All validations are sent as well."""


@contextmanager
def logged(name: str, steps: int, config: Mapping[str, object]) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Open a run of Weights & Biases for one training.

    Args:
        name: Name of the run.
        steps: Number of steps of the whole training.
        config: Settings to show beside the curves.

    Yields:
        A function that logs metrics by name at a step. Metrics with a key `step` are those of a validation.

    Raises:
        UsageError: The package is not installed.
    """
    try:
        import wandb
    except ImportError as error:
        raise UsageError("log=wandb: pip install 'kerv[wandb]'") from error
    run = wandb.init(project="kerv", name=name, config=dict(config))

    def log(step: int, numbers: Mapping[str, float]) -> None:
        validation = "step" in numbers
        if validation or step % max(1, steps // MOST_POINTS) == 0:
            kind = "validation" if validation else "training"
            run.log({f"{kind}/{key}": value for key, value in numbers.items() if key != "step"}, step=step)

    try:
        yield log
    finally:
        run.finish()
