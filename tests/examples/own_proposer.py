"""Example: a proposer of your own, with weights of its own and their training, in two files.

This one is light: it says what there is, so that `--cfg`, completion and wrong overrides are answered before torch is
imported. `KERV_PLUGINS=examples.own_proposer` registers it; then `kerv train drafter drafter=follow` trains it, and
`kerv rollout proposer=follow`, `prefill_draft=follow` and `prefill_draft=merged prefill_draft.sources=[follow]` draft
with it; `policy.artifacts.follow=NAME` names its weights where they do not lie beside the target.
"""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, Part, register


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


register(Part("artifact", "follow", "examples.own_proposer_table:FollowArtifact"))
register(Part("drafter", "follow", "examples.own_proposer_table:FollowTraining", FollowDrafterSettings))
register(
    Part(
        "proposer",
        "follow",
        "examples.own_proposer_table:build",
        FollowSettings,
        lambda settings: ("follow",),
        colour=0x7A9E2F,
        traits={"when": PREFILL, "chains": True},
    )
)
