"""Settings of `kerv serve`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.methods.settings import MethodSettings


@dataclass
class ServeSettings(MethodSettings):
    """Serve a policy and a method to clients over websockets (docs/serving.md)."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu", "method": "ar"}

    protocol: str = choice("openpi", "openpi", "vla_eval", help="openpi for robots, vla_eval for benchmarks")
    host: str = setting("127.0.0.1", "address to listen on; there is no password")
    port: int = number(8000, 0, 65_535, help="port to listen on; 0: a free one")
    gripper: str = choice(
        "as_is", "as_is", "signed", "signed_inverted", help="how the gripper is sent: signed is -1 closed, 1 open"
    )
    task_name: str = setting("", "name of the task, if its calibration is read; vla_eval's clients send it")
    origins: list[str] = setting([], "addresses of web pages that may connect; programs always may")
    margin: float = number(1.0, 0, 1e6, help="how far a state may be out of range, in widths of the range")
