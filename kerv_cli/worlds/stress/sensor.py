"""Sensor: the camera's image is noisy and blurred, or is the one observed before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Stress, level_of


@dataclass(frozen=True)
class Level:
    """noise: standard deviation per pixel and colour, grey levels of 255. blur: standard deviation of the Gaussian, in
    hundredths of the picture's height. dropped: probability that a picture is the one observed before."""

    noise: float
    blur: float
    dropped: float


LEVELS = (Level(16, 0.5, 0.1), Level(22, 0.65, 0.15), Level(30, 0.9, 0.2), Level(97, 3.0, 0.55))


class Sensor(Stress):
    """It changes what the policy observes. Recorded frames stay clean, and so does the state."""

    kind = "sensor"

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fixes the episode's random numbers and forgets the images of the last one."""
        super().begin(task, seed, space)
        self._last: dict[str, NDArray[np.uint8]] = {}

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """The blurred and noisy image, or the last one of this camera. The random numbers follow from the control step,
        so that repeated calls of a step agree."""
        level = level_of(LEVELS, self.level)
        random = self.draws.random(camera, step)
        dropped = random.random() < level.dropped
        if dropped and camera in self._last:
            return self._last[camera]
        blur = level.blur / 100 * image.shape[0]
        blurred = gaussian_filter(image.astype(np.float32), sigma=(blur, blur, 0))
        blurred += random.standard_normal(image.shape, dtype=np.float32) * level.noise
        self._last[camera] = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
        return self._last[camera]
