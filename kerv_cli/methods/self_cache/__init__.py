"""The self-cache (docs/methods.md §5.3, ours): verified chunks of earlier episodes as drafts. Settings and
registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add


@dataclass
class SelfCacheSettings:
    """The chunk that the target decoded where a task's scene was most alike, of this decoder's episodes (§5.3)."""

    kind: str = "self_cache"
    least: int = number(4, 1, help="episodes of the task that it remembers before it drafts")
    most: int = number(2048, 1, help="chunks of a task that it remembers, the newest")


_BUILD = "kerv_cli.methods.self_cache.proposer:SelfCacheProposer.build"
add("proposer", "self_cache", _BUILD, SelfCacheSettings, colour=0xB07AA1, when=PREFILL, chains=True, remembers=True)
