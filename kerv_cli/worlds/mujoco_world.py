"""Base class of worlds that MuJoCo simulates, and off-screen drawing of their images.

`mujoco.Renderer` draws the images. Gymnasium's viewer draws wrong images, without an error, if several environments
exist in one process. The module also finds an OpenGL backend that works on this machine.
"""

from __future__ import annotations

import atexit
import copy
import functools
import os
import subprocess
import sys
from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.errors import RenderingUnavailable
from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World
from kerv_cli.worlds.stress import Model, ModelChanges

if TYPE_CHECKING:
    import mujoco


class MujocoWorld(World):
    """A world with a MuJoCo model.

    A stress may change the model. The next reset undoes the changes. A subclass implements `_drawable` instead of
    `_draw`.
    """

    stressable = World.stressable | {"model"}

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        super().__init__(spec, task, camera, horizon)
        self._cameras: dict[CameraSettings, Camera] = {}  # opened when first used
        self._changes = ModelChanges()

    @abstractmethod
    def _drawable(self) -> tuple[Model, Any]:
        """Return the model (MjModel), and its data (MjData). Before the first step its poses need not be up to date."""

    def reset(self, seed: int) -> Observation:
        self._changes.close()
        observation = super().reset(seed)
        self.stress.change(self._drawable()[0], self._changes)
        return observation

    def _draw(self, camera: CameraSettings) -> NDArray[np.uint8]:
        model, data = self._drawable()
        if self.steps == 0:
            # Until the first step poses can be stale (window-close: the window is off by 0.2 m), and turned lamps are.
            # They are computed in a copy: physics must not depend on whether a frame is drawn.
            import mujoco

            data = copy.copy(data)
            mujoco.mj_forward(model, data)
        if camera not in self._cameras:
            self._cameras[camera] = Camera(model, camera, camera.name in self.spec.upside_down)
        return self._cameras[camera].render(data)

    def close(self) -> None:
        self._changes.close()
        for camera in self._cameras.values():
            camera.close()
        self._cameras.clear()
        super().close()


_HEADLESS = ("egl", "osmesa")
_PROBE = """
import ctypes, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG: end with the parent process
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
context.free()
"""
_PROBE_SECONDS = 60.0
# two software backends, EGL and OSMesa, on Debian and Ubuntu
_INSTALL = f"{'' if os.geteuid() == 0 else 'sudo '}apt-get install -y libegl1 libosmesa6 libgl1-mesa-dri libgl1"


def choose_backend() -> str:
    """Return an OpenGL backend that works here. Call it before mujoco is imported. Workers inherit the choice."""
    backend, error = find_backend()
    if error:
        raise RenderingUnavailable(error)
    return backend


@functools.cache
def find_backend() -> tuple[str, str]:
    """Return the name of a working OpenGL backend and "", or "" and an error message."""
    # Software rendering with a thread pool per context is slower for small frames and crowds out other workers.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if backend in ("disable", "disabled", "off", "false", "0"):
        return "", f"MUJOCO_GL={backend} switches drawing off: unset it, or set it to egl"
    if not backend:
        if "mujoco.gl_context" in sys.modules:
            return "", "mujoco was imported before a GL backend was chosen: set MUJOCO_GL=egl"
        try:
            backend = next(filter(_draws, _HEADLESS), "")
        except subprocess.TimeoutExpired:
            return "", f"OpenGL drew nothing within {_PROBE_SECONDS:.0f} s, the machine may be busy: set MUJOCO_GL=egl"
        if not backend:
            return "", f"no OpenGL backend can draw here: {_INSTALL}"
        os.environ["MUJOCO_GL"] = backend
    if backend in _HEADLESS:
        os.environ["PYOPENGL_PLATFORM"] = backend
    return backend, ""


def _draws(backend: str) -> bool:
    # in its own process, so that a broken driver cannot crash kerv
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    command = [sys.executable, "-c", _PROBE]
    done = subprocess.run(command, env=environment, capture_output=True, timeout=_PROBE_SECONDS, check=False)
    return done.returncode == 0


def load_mujoco() -> None:
    """Import mujoco, with an OpenGL backend if one works here. Without one, only opening a `Camera` fails."""
    if find_backend()[1]:
        os.environ.setdefault("MUJOCO_GL", "disable")  # otherwise mujoco tries glfw, which needs a display
    import mujoco  # noqa: F401


class Camera:
    """Draw one view of a MuJoCo model. Drawing never changes the physics."""

    def __init__(self, model: mujoco.MjModel, config: CameraSettings, upside_down: bool) -> None:
        backend = choose_backend()
        import mujoco

        self.config, self._upside_down = config, upside_down
        self._model = model
        self._camera = int(model.camera(config.name).id)
        pixels = config.size * config.supersample
        # The context reads these values when it opens. Multisampling and shadow maps cost most of the drawing time.
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth = max(int(model.vis.global_.offwidth), pixels)
        model.vis.global_.offheight = max(int(model.vis.global_.offheight), pixels)

        class Renderer(mujoco.Renderer):
            _gl_context = _mjr_context = None  # the destructor reads them, even if the constructor failed

        try:
            self._renderer = Renderer(model, height=pixels, width=pixels)
        except Exception as error:  # each backend raises its own types
            raise RenderingUnavailable(f"OpenGL backend '{backend}' cannot draw here ({error}): {_INSTALL}") from error
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._pixels = np.empty((pixels, pixels, 3), dtype=np.uint8)
        # An open context at interpreter exit prints an EGLError. This handler is registered after the import of
        # mujoco.egl, so it runs before mujoco's own handler, which ends the display.
        atexit.register(self.close)

    def render(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Return the image (size, size, 3) as uint8 RGB, upright."""
        fovy = self._model.cam_fovy[self._camera]
        self._model.cam_fovy[self._camera] = self.config.fovy  # set anew, because views of one model may differ
        self._renderer.update_scene(data, camera=self._camera)
        self._model.cam_fovy[self._camera] = fovy
        self._renderer.render(out=self._pixels)
        frame = box_average(self._pixels, self.config.supersample)
        return np.ascontiguousarray(frame[::-1, ::-1] if self._upside_down else frame)

    def close(self) -> None:
        atexit.unregister(self.close)
        self._renderer.close()


def box_average(pixels: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Return the mean of every block of factor x factor pixels (uint8), rounded. `factor` is at most 16."""
    if factor == 1:
        return pixels.copy()
    total = np.full((pixels.shape[0] // factor, pixels.shape[1] // factor, pixels.shape[2]), factor**2 // 2, np.uint16)
    for row in range(factor):
        for column in range(factor):
            total += pixels[row::factor, column::factor]
    total //= factor**2
    return total.astype(np.uint8)
