"""Choose the device, number format and number of threads of this process. torch is imported only if it is needed."""

from __future__ import annotations

import re
from importlib.metadata import version
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import RuntimeSettings

if TYPE_CHECKING:
    import torch


def dtype_of(name: str) -> torch.dtype:
    import torch

    return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[name]


def device_of(settings: RuntimeSettings) -> str:
    device = settings.device
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", device):
        raise UsageError(f"runtime.device={device}: known are cpu, cuda, cuda:N, auto")
    if device == "cpu" or (device == "auto" and version("torch").endswith("+cpu")):
        return "cpu"
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if not torch.cuda.is_available():
        raise UsageError(f"runtime.device={device}: torch sees no CUDA device here, use runtime.device=cpu")
    devices = torch.cuda.device_count() if device.startswith("cuda:") else 0
    if devices and int(device[5:]) >= devices:
        raise UsageError(f"runtime.device={device}: torch sees {devices} here, cuda:0 to cuda:{devices - 1}")
    return device


def set_up(settings: RuntimeSettings) -> tuple[str, torch.dtype]:
    """Set the number of torch's threads. Return the device of `device_of`, and the number format of the models.

    A numbered GPU becomes torch's current device, which stopwatches and CUDA graphs use.
    """
    import torch

    device = device_of(settings)
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    torch.set_num_threads(settings.threads)
    return device, dtype_of(settings.dtype)
