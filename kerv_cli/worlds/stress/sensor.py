"""The kind of stress that changes what the policy sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Stress


class Sensor(Stress):
    """Images are noisy and blurred, or repeated. Recorded images and the state are not changed.

    Each level is (noise, blur, dropped):

    - noise: standard deviation for each pixel and colour, in grey levels from 0 to 255
    - blur: standard deviation of the Gaussian, in hundredths of the image's height
    - dropped: probability that the policy sees the previous image again
    """

    kind = "sensor"
    levels = ((16, 0.5, 0.1), (22, 0.65, 0.15), (30, 0.9, 0.2), (97, 3.0, 0.55))

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare an episode: forget the images of the previous one."""
        super().begin(task, seed, space)
        self._last: dict[str, NDArray[np.uint8]] = {}

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the blurred and noisy image, or this camera's previous image.

        Repeated calls in the same control step use the same random numbers.
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
