"""Fast offscreen frames of a MuJoCo model, and the choice of an OpenGL backend that works on this machine.

`mujoco.Renderer` is used directly: gymnasium's viewer draws garbage, without an error, as soon as several
environments live in one process.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import subprocess
import sys
import weakref
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.errors import RenderingUnavailable
from kerv_cli.worlds.settings import CameraSettings

if TYPE_CHECKING:
    import mujoco

_PACKAGES = "libegl1 libosmesa6 libgl1-mesa-dri libgl1"
_HEADLESS = ("egl", "osmesa")
_SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
_PROBE = """
import ctypes, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG: it ends with its parent
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
context.free()
"""
_PROBE_SECONDS = 60.0

_chosen: str | RenderingUnavailable | None = None
_open_cameras: weakref.WeakSet[Camera] = weakref.WeakSet()


def install_command() -> str:
    """The shell command that installs both software OpenGL backends on Debian and Ubuntu."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"{sudo}apt-get install -y {_PACKAGES}"


def choose_backend() -> str:
    """Chooses the OpenGL backend that draws the frames; call it before mujoco is imported.

    `MUJOCO_GL` is respected where set; otherwise EGL, then OSMesa are tried, each in a process of its own, so that a
    broken driver cannot harm this one. The choice is cached and written to `MUJOCO_GL` and `PYOPENGL_PLATFORM`, which
    worker processes inherit.

    Returns:
        The backend's name: `egl`, `osmesa`, or what `MUJOCO_GL` says.

    Raises:
        RenderingUnavailable: nothing can draw here, `MUJOCO_GL` switches drawing off, or mujoco was already imported
            without a headless backend.
    """
    global _chosen
    if _chosen is None:
        try:
            _chosen = _find_backend()
        except RenderingUnavailable as error:
            _chosen = error
    if isinstance(_chosen, RenderingUnavailable):
        raise RenderingUnavailable(str(_chosen))
    return _chosen


def _find_backend() -> str:
    # Software rendering with a thread pool per context is slower for small frames and crowds out other workers.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if backend in _SWITCHED_OFF:
        raise RenderingUnavailable(f"MUJOCO_GL={backend} switches drawing off: unset it, or set it to egl")
    if not backend:
        backend = _probe_backends()
        os.environ["MUJOCO_GL"] = backend
    if backend in _HEADLESS:
        os.environ["PYOPENGL_PLATFORM"] = backend
    return backend


def _probe_backends() -> str:
    if "mujoco.gl_context" in sys.modules:
        raise RenderingUnavailable("mujoco was imported before a GL backend was chosen: set MUJOCO_GL=egl")
    for backend in _HEADLESS:
        environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        try:
            command = [sys.executable, "-c", _PROBE]
            subprocess.run(command, env=environment, capture_output=True, timeout=_PROBE_SECONDS, check=True)
        except subprocess.SubprocessError:  # it failed or hung
            continue
        return backend
    raise RenderingUnavailable(f"no OpenGL backend can draw here: {install_command()}")


def load_mujoco() -> None:
    """Imports mujoco, with a GL backend where there is one. Without one physics works, and opening a Camera raises
    RenderingUnavailable."""
    try:
        choose_backend()
    except RenderingUnavailable:
        # Without this mujoco asks for glfw, which fails without a display.
        os.environ.setdefault("MUJOCO_GL", "disable")
    import mujoco  # noqa: F401


class Camera:
    """Draws one view of one model. Drawing reads the physics and never changes it."""

    def __init__(self, model: mujoco.MjModel, config: CameraSettings, upside_down: bool) -> None:
        """Opens an offscreen context for `model`. upside_down: the view's raw images are rotated by 180 degrees.

        Raises:
            RenderingUnavailable: the GL backend cannot open a context.
        """
        backend = choose_backend()
        import mujoco

        self.config, self._upside_down = config, upside_down
        self._model = model
        self._camera = int(model.camera(config.name).id)
        pixels = config.size * config.supersample
        # The context reads them when it opens. Multisampling and shadow maps are most of a software frame's cost.
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth = max(int(model.vis.global_.offwidth), pixels)
        model.vis.global_.offheight = max(int(model.vis.global_.offheight), pixels)
        try:
            self._renderer: mujoco.Renderer | None = _open_renderer(model, pixels)
        except Exception as error:  # each backend raises types of its own
            raise RenderingUnavailable(
                f"OpenGL backend '{backend}' cannot draw here ({error}): {install_command()}"
            ) from error
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._pixels = np.empty((pixels, pixels, 3), dtype=np.uint8)
        # Registered after mujoco.egl was imported, so it runs before mujoco's own handler ends the display.
        if not _open_cameras:
            atexit.unregister(_close_all)
            atexit.register(_close_all)
        _open_cameras.add(self)

    def render(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """A frame of the state in `data`.

        Returns:
            (size, size, 3) uint8 RGB, upright: images of views that are upside down are turned by 180 degrees (flipping
            one axis would mirror them).
        """
        assert self._renderer is not None
        fovy = self._model.cam_fovy[self._camera]
        self._model.cam_fovy[self._camera] = self.config.fovy  # views of one model may differ in fovy: set per frame
        try:
            self._renderer.update_scene(data, camera=self._camera)
        finally:
            self._model.cam_fovy[self._camera] = fovy
        self._renderer.render(out=self._pixels)
        frame = box_average(self._pixels, self.config.supersample)
        return np.ascontiguousarray(frame[::-1, ::-1] if self._upside_down else frame)

    def close(self) -> None:
        """Frees the context; safe to call twice. An open context at interpreter exit prints an EGLError."""
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()


def _open_renderer(model: mujoco.MjModel, pixels: int) -> mujoco.Renderer:
    import mujoco

    class Renderer(mujoco.Renderer):
        def __del__(self) -> None:
            # a renderer that failed to open fails again when it is collected, and would print a second traceback
            with contextlib.suppress(AttributeError):
                super().__del__()

    return Renderer(model, height=pixels, width=pixels)


def box_average(pixels: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Means of factor x factor blocks, rounded to nearest.

    Args:
        pixels: (factor * n, factor * m, channels) uint8.
        factor: 1 to 16, so that a block's sum fits 16 bits.

    Returns:
        (n, m, channels) uint8; a copy.
    """
    if factor == 1:
        return pixels.copy()
    total = np.full((pixels.shape[0] // factor, pixels.shape[1] // factor, pixels.shape[2]), factor**2 // 2, np.uint16)
    for row in range(factor):
        for column in range(factor):
            total += pixels[row::factor, column::factor]
    total //= factor**2
    return total.astype(np.uint8)


def _close_all() -> None:
    for camera in list(_open_cameras):
        camera.close()
