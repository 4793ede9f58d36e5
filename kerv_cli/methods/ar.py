"""Register the parts of autoregressive decoding, in which the target decodes every token (docs/methods.md §1)."""

from __future__ import annotations

from kerv_cli.base.registry import PREFILL, BoundaryPart, ProposerPart, RectifierPart, SkipPart

ProposerPart("none", colour=0x6E7B8B, when=PREFILL).add()
RectifierPart("reinfer").add()  # the target decodes on
BoundaryPart("always").add()  # the method has one proposer
SkipPart("none").add()
