"""Choose the device, number format and number of threads of this process."""

from __future__ import annotations

import re

import torch

from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import RuntimeSettings

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def device_of(settings: RuntimeSettings) -> str:
    device = settings.device if settings.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise UsageError(f"runtime.device={device}: known are cpu, cuda, cuda:N, auto")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError(f"runtime.device={device}: torch sees no CUDA device here, use runtime.device=cpu")
    devices = torch.cuda.device_count() if device.startswith("cuda:") else 0
    if devices and int(device[5:]) >= devices:
        raise UsageError(f"runtime.device={device}: torch sees {devices} here, cuda:0 to cuda:{devices - 1}")
    return device


def set_up(settings: RuntimeSettings) -> tuple[str, torch.dtype]:
    """Set the number of torch's threads. Return the device of `device_of`, and the number format of the models.

    A numbered GPU becomes torch's current device, which stopwatches and CUDA graphs use.
    """
    device = device_of(settings)
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    torch.set_num_threads(settings.threads)
    return device, DTYPES[settings.dtype]
