"""The served policy from its settings: interface and decoder, warmed up."""

from __future__ import annotations

import numpy as np

from kerv_cli.base.errors import UnknownName
from kerv_cli.base.registry import find
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import ServeSettings
from kerv_cli.base.views import frame_shape
from kerv_cli.engine.decoder import Decoder
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.compose import Method
from kerv_cli.serve.session import GRIPPERS, Interface, Session

WARM_UP = 4  # decodes


def served(settings: ServeSettings) -> tuple[Interface, Decoder]:
    """The policy's interface and its decoder, after a warm-up: errors are raised before the first client connects.

    Raises:
        UsageError: numbers out of range, parts that do not belong together. CheckpointError: no such policy, or an
            artifact of another.
    """
    if settings.gripper not in GRIPPERS:
        raise UnknownName("gripper", settings.gripper, GRIPPERS)
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, settings.datastore, device, settings.runtime.dtype)
    description, method = artifacts.description, Method.of(settings)
    method.check(description)
    method.check_unwatched("kerv serve", "a client executes chunks without a look between their steps")
    artifacts.check(method.needs)
    decoder = method.decoder(artifacts.target, artifacts.load, settings.task_name)
    interface = Interface(
        name=settings.policy.target,
        method=settings.method,
        actions=description.actions,
        observation=description.observation,
        cameras=tuple(description.cameras),
        size=int(description.settings.get("image_size", 0)) if description.cameras else 0,
        privileged=not description.cameras and description.observation.state > 0,
        gripper=settings.gripper,
        task=settings.task_name,
        images_alone=bool(find("target", description.family).traits.get("images_alone")),
    )
    warm_up(interface, decoder)
    return interface, decoder


def warm_up(interface: Interface, decoder: Decoder) -> None:
    """Answers a few observations of zeros: first calls allocate memory and choose kernels."""
    session = Session(interface, decoder)
    images = {f"observation/{c}": np.zeros(frame_shape(c, interface.size), np.uint8) for c in interface.cameras}
    message = {**images, "observation/state": np.zeros(interface.observation.state), "prompt": ""}
    for _ in range(WARM_UP):
        session.answer(message)
