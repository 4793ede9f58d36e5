"""Autoregressive decoding (docs/methods.md §1): the absence of every part. Settings and registration."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.registry import PREFILL, NoSettings, add

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context

_NOTHING = "kerv_cli.methods.ar:nothing"


def nothing(settings: NoSettings, context: Context) -> None:
    """Choices that stand for the absence of a part."""


add("proposer", "none", _NOTHING, colour=0x6E7B8B, when=PREFILL)
add("rectifier", "reinfer", _NOTHING)  # the target decodes on
add("boundary", "always", _NOTHING)  # the method has one proposer
add("skip", "none", _NOTHING)
