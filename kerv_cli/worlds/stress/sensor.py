"""The kind of stress that changes what the policy sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Stress


class Sensor(Stress):
    """Images are noisy and blurred, or the one observed before. Recorded frames and the state stay clean.

    A level is (noise, blur, dropped): standard deviation per pixel and colour in grey levels of 255; standard deviation
    of the Gaussian in hundredths of the image's height; probability that the policy sees the image observed before.
    """

    kind = "sensor"
    levels = ((16, 0.5, 0.1), (22, 0.65, 0.15), (30, 0.9, 0.2), (97, 3.0, 0.55))

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fix the episode's random numbers and forget the images of the last one."""
        super().begin(task, seed, space)
        self._last: dict[str, NDArray[np.uint8]] = {}

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the blurred and noisy image, or the last one of this camera.

        The random numbers follow from the control step, so that repeated calls in a step agree.
        """
        noise, blur, dropped = self.amount
        random = self.generator(camera, step)
        if random.random() < dropped and camera in self._last:
            return self._last[camera]
        sigma = blur / 100 * image.shape[0]
        blurred = gaussian_filter(image.astype(np.float32), sigma=(sigma, sigma, 0))
        blurred += random.standard_normal(image.shape, dtype=np.float32) * noise
        self._last[camera] = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
        return self._last[camera]
