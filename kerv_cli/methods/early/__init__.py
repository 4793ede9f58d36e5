"""The early drafter: the whole chunk from the prompt, before the target's trunk runs (docs/methods.md §5, ours).
Registration."""

from __future__ import annotations

from kerv_cli.base.registry import PREFILL, add

_DRAFTER = "kerv_cli.methods.early.drafter:"

add("artifact", "early", _DRAFTER + "EarlyArtifact")
# chains: it drafts whole chains, so that a merged draft can take it as a source
_build = _DRAFTER + "EarlyProposer.build"
add("proposer", "early", _build, needs=("early",), colour=0xD4A6C8, when=PREFILL, chains=True)
