"""Example: a drafter of your own with weights: one registration here, one class in `own_proposer_table.py`.

This file imports nothing heavy, so that `--cfg`, completion and wrong overrides are answered before torch is imported.
`KERV_PLUGINS=examples.own_proposer` registers it. Then `kerv train drafter drafter=follow` trains it, and
`kerv rollout proposer=follow`, `prefill_draft=follow` and `prefill_draft=merged prefill_draft.sources=[follow]` draft
with it. `policy.artifacts.follow=NAME` names its weights if they are not beside the target.
"""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, DrafterPart


@dataclass
class FollowSettings:
    """What most often followed an action, one control step later."""

    kind: str = "follow"
    depth: int = number(0, 0, 1024)  # tokens drafted at once, with its range; 0: all that are left


@dataclass
class FollowDrafterSettings:
    """The table's training: `kerv train drafter drafter=follow drafter.share=0.5`."""

    kind: str = "follow"
    share: float = number(1.0, above=0, most=1)  # of every episode, from its beginning, is learned from


@DrafterPart("follow", FollowSettings, trained=FollowDrafterSettings, colour=0x7A9E2F, when=PREFILL, chains=True)
def follow() -> type:
    from examples.own_proposer_table import FollowDrafter

    return FollowDrafter
