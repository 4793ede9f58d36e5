"""The early drafter: the whole chunk from the prompt, before the target's trunk runs (docs/methods.md §5, ours).
Registration."""

from __future__ import annotations

from kerv_cli.base.registry import PREFILL, Part, reads, register

_DRAFTER = "kerv_cli.methods.early.drafter:"

register(Part("artifact", "early", _DRAFTER + "ARTIFACT"))
register(
    Part(
        *("proposer", "early", _DRAFTER + "EarlyProposer.build"),
        needs=reads("early"),
        colour=0xD4A6C8,
        traits={"when": PREFILL, "chains": True},  # drafts whole chains, so that a merged draft can take it as a source
    )
)
