"""Device, dtype and threads of a process."""

from __future__ import annotations

import torch

from kerv_cli.errors import UsageError
from kerv_cli.settings import RuntimeSettings

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def set_up(settings: RuntimeSettings) -> tuple[str, torch.dtype]:
    """Applies `settings` to this process -> (device, dtype).

    Raises:
        UsageError: no such device here, unknown dtype, thread count below one.
    """
    if settings.threads < 1:
        raise UsageError(f"runtime.threads={settings.threads}: must be at least 1")
    if settings.dtype not in DTYPES:
        raise UsageError(f"runtime.dtype={settings.dtype}: known are {', '.join(DTYPES)}")
    device = settings.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.split(":")[0] not in ("cpu", "cuda"):
        raise UsageError(f"runtime.device={device}: known are cpu, cuda, auto")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError(f"runtime.device={device}: torch sees no CUDA device here, use runtime.device=cpu")
    torch.set_num_threads(settings.threads)
    return device, DTYPES[settings.dtype]
