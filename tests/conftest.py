"""Small real policies for the tests: untrained weights on disk, made by the code that makes trained ones."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from dataclasses import asdict
from functools import partialmethod
from pathlib import Path
from typing import Any

import examples.insertion  # noqa: F401 - registers the environment with seven degrees of freedom
import pytest

from kerv_cli.base import registry
from kerv_cli.base.config import Composer, conf_dir
from kerv_cli.base.registry import SETTINGS_GROUPS

os.environ.setdefault("OMP_NUM_THREADS", "1")

ENVIRONMENTS = dict(registry.parts("environment"))
"""kerv's own and the example `insertion`, taken before test modules are imported."""


LONGEST = (
    *("test_documented_commands", "test_studies_executors", "test_training", "test_cli", "test_dagger"),
    *("test_golden", "test_older_results", "test_extending", "test_coverage", "test_views", "test_early"),
)
"""Files that take longest, begun first: no process is left with one of them at the end while the others idle."""


def pytest_configure(config: pytest.Config) -> None:
    """Files are begun in the order of collection: pytest-xdist would begin with those of the most tests."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, the others as they were."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


def pytest_collection_finish() -> None:
    """Leaves libraries and collected tests out of garbage collection: they stay, and a look at all of them takes 0.3 s
    each time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def registered_environments() -> Iterator[None]:
    """A module begins with these environments, and what it registers is gone when it ends.

    Opening a dataset of a recording, or importing an example, registers an environment for the process, and which
    modules share a process is decided anew in every parallel run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._PARTS, "environment", dict(ENVIRONMENTS))
        yield


@pytest.fixture(scope="session", autouse=True)
def compositions() -> Iterator[None]:
    """Composers of one command keep what they composed for the next one while the registered parts are the same:
    a composition takes 0.1 s, and the tests ask a thousand times for a few dozen."""
    kept: dict[Any, Any] = {}
    create = Composer.__init__

    def created(self: Composer[Any], command: str, schema: type) -> None:
        create(self, command, schema)
        parts = tuple(
            (name, part.settings) for group in SETTINGS_GROUPS for name, part in registry.parts(group).items()
        )
        self._composed = kept.setdefault((command, schema, conf_dir(), parts), {})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Composer, "__init__", created)
        yield


def write_policy(results: Path, name: str, observation: str, seed: int = 0) -> None:
    """A nano target and its drafter below `results`, as `kerv train` leaves them."""
    import torch

    from kerv_cli.base.config import compose
    from kerv_cli.base.settings import TrainTargetSettings
    from kerv_cli.methods.artifacts import MadeFor
    from kerv_cli.methods.eagle import DrafterSettings
    from kerv_cli.methods.eagle.drafter import Drafter, DrafterArtifact
    from kerv_cli.targets.compact.folder import save_target
    from kerv_cli.targets.compact.target import CompactTarget
    from kerv_cli.training.imitation import vocabulary
    from kerv_cli.worlds.metaworld.spec import SPEC

    torch.manual_seed(seed)
    settings = compose("train_target", ["target=nano", f"target.observation={observation}"], TrainTargetSettings)
    camera = settings.world.camera.name
    target = CompactTarget(settings.target, SPEC.actions, SPEC.observation, vocabulary(SPEC.name), camera)
    provenance = {"parameters": sum(p.numel() for p in target.parameters())}
    digest = save_target(results / "artifacts" / "target" / name, target, "metaworld", provenance)
    drafter = Drafter.beside(DrafterSettings(), target)
    folder, made_for = results / "artifacts" / "drafter" / name, MadeFor(digest, target.actions)
    DrafterArtifact().save(folder, drafter, made_for, provenance, settings=asdict(drafter.settings))


@pytest.fixture(scope="session")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with the policies `nano-state` and `nano-vision`. Read only: copy it to change it."""
    results = tmp_path_factory.mktemp("policies")
    write_policy(results, "nano-state", "state")
    write_policy(results, "nano-vision", "vision", seed=1)
    return results


@pytest.fixture
def few_validations(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drafter in training is validated on 4 observations, not on 60 of which each is decoded twice."""
    from kerv_cli.training.distillation import Distillation

    monkeypatch.setattr(Distillation, "validate", partialmethod(Distillation.validate, observations=4))
