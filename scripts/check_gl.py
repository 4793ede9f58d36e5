"""Can MuJoCo draw off screen here? Prints the first OpenGL backend that works; exit status 1 when none does.

Standard library only and no MuJoCo, so that it costs milliseconds. Loading a library proves little (libEGL loads on
machines without a driver), so each backend must also create an OpenGL context.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence

EGL_LIBRARIES = ("libEGL.so.1",)
OSMESA_LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so.6")
GL_LIBRARIES = ("libOpenGL.so.0", "libGL.so.1")  # PyOpenGL, through which MuJoCo draws, wants one beside EGL

EGL_PLATFORM_DEVICE = 0x313F
EGL_OPENGL_API = 0x30A2
# What MuJoCo asks for, as EGL's (attribute, value) pairs.
EGL_CONFIG = {
    0x3024: 8,  # red, green, blue and alpha bits
    0x3023: 8,
    0x3022: 8,
    0x3021: 8,
    0x3025: 24,  # depth bits
    0x3026: 8,  # stencil bits
    0x3033: 0x0001,  # surface: off screen
    0x3040: 0x0008,  # renderable: OpenGL
}
EGL_NONE = 0x3038
OSMESA_RGBA = 0x1908
MAX_DEVICES = 10


def load(names: Sequence[str], function: str) -> ctypes.CDLL | None:
    """The first library that the loader accepts and that has the function."""
    for name in names:
        try:
            library = ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL)
        except OSError:
            continue
        if hasattr(library, function):
            return library
    return None


def _creates_context(egl: ctypes.CDLL, display: ctypes.c_void_p) -> bool:
    attributes = [*(word for pair in EGL_CONFIG.items() for word in pair), EGL_NONE]
    wanted = (ctypes.c_int * len(attributes))(*attributes)
    config, count = ctypes.c_void_p(), ctypes.c_int()
    if not egl.eglChooseConfig(display, wanted, ctypes.byref(config), 1, ctypes.byref(count)) or count.value < 1:
        return False
    egl.eglBindAPI(EGL_OPENGL_API)
    egl.eglCreateContext.restype = ctypes.c_void_p
    context = ctypes.c_void_p(egl.eglCreateContext(display, config, None, None))
    return bool(context) and bool(egl.eglMakeCurrent(display, None, None, context))


def egl_works(names: Sequence[str] = EGL_LIBRARIES) -> bool:
    """Whether one of EGL's devices (a GPU, or Mesa's software renderer) gives a context without a display server."""
    egl = load(names, "eglGetProcAddress")
    if egl is None or load(GL_LIBRARIES, "glReadPixels") is None:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not get_display:
        return False
    devices, count = (ctypes.c_void_p * MAX_DEVICES)(), ctypes.c_int()
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query)
    if not query_devices(MAX_DEVICES, devices, ctypes.byref(count)):
        return False
    platform_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(get_display)
    for device in devices[: count.value]:
        display = ctypes.c_void_p(platform_display(EGL_PLATFORM_DEVICE, device, None))
        if display and egl.eglInitialize(display, None, None):
            return _creates_context(egl, display)  # MuJoCo, too, takes the first device that starts
    return False


def osmesa_works(names: Sequence[str] = OSMESA_LIBRARIES) -> bool:
    """Whether Mesa's off-screen software renderer gives a context."""
    osmesa = load(names, "OSMesaCreateContextExt")
    if osmesa is None:
        return False
    osmesa.OSMesaCreateContextExt.restype = ctypes.c_void_p
    return bool(osmesa.OSMesaCreateContextExt(OSMESA_RGBA, 24, 0, 0, None))


def main() -> int:
    if sys.platform != "linux":  # MuJoCo draws with the system's own framework there
        return 0
    if egl_works():
        print("egl")
    elif osmesa_works():
        print("osmesa")
    else:
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
