"""Register the parts of autoregressive decoding, which has no drafts and skips no decode (docs/methods.md §1)."""

from __future__ import annotations

from kerv_cli.base.registry import PREFILL, add

add("proposer", "none", colour=0x6E7B8B, when=PREFILL)
add("rectifier", "reinfer")  # the target decodes on
add("boundary", "always")  # the method has one proposer
add("skip", "none", batchable=True)
