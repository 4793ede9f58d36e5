"""Settings of the policy server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.methods.settings import MethodSettings


@dataclass
class ServeSettings(MethodSettings):
    """`kerv serve`: a policy and a method for clients over websockets (docs/serving.md)."""

    groups: ClassVar = {"policy": "vision", "runtime": "cpu", "method": "ar"}

    protocol: str = choice(
        "openpi", "openpi", "vla_eval", help="what clients speak: robots openpi, benchmarks vla_eval"
    )
    host: str = setting("127.0.0.1", "address to listen on; there is no password")
    port: int = number(8000, 0, 65_535, help="port to listen on; 0: a free one")
    log_every: int = number(100, 0, 10**9, help="answers between two lines of latencies; 0: at a connection's end only")
    gripper: str = choice(
        "as_is", "as_is", "signed", "signed_inverted", help="how strict DoFs (0 closed to 1 open) are sent"
    )
    task_name: str = setting("", "the task, for parts whose levels differ between tasks; empty: vla_eval's clients say")
    batch: int = number(1, 1, 1024, help="clients that are decoded together; above 1: without times")
    origins: list[str] = setting([], "web pages that may connect; programs, which name no origin, always may")
    outside: str = choice(
        "refuse", "refuse", "hold", help="a state that the policy was not trained on: an error, or the last action"
    )
    margin: float = number(1.0, 0, 1e6, help="by how many widths a state may exceed the demonstrations' range")
