"""Decoding methods, with one file or folder per family (docs/methods.md). *Ours* marks what comes from no paper.

    ar                          autoregressive decoding (AR): no drafts
    spec_vla                    Spec-VLA: accept a draft token that equals the target's token, or is at most r bins off
    eagle                       EAGLE-2: our own and published drafters, which read the target's hidden states
    early                       ours: the early drafter drafts a chunk before the prefill
    kerv                        KERV: predictions from the motion, and thresholds that follow the motion
    unverified                  tokens without verification: OpenVLA-OFT's parallel pass, drafts, streaks
    heisd                       HeiSD: retrieved drafts, a boundary between two drafters, skipped verification
    reuse                       Jacobi decoding as in PD-VLA, prompt lookup, and the last action as a draft
    near                        ours: the tokens around the last action and a line through the last two, as a tree
    merged                      ours: several drafts in one tree, before the prefill (`method=one_pass`)
    motion                      ours: accept FAST tokens, and stop decoding, by the motion that the tokens stand for

Importing these files, and the `__init__.py` of these folders, imports neither torch nor numpy. Code that needs them is
in other files, which are imported when the part is built. `compose.py` builds a decoder from a method's parts.
"""

from __future__ import annotations

# importing a family registers its parts; this is their order in error messages and help texts
# isort: off
from kerv_cli.methods import ar, spec_vla, eagle, early, calibrated, kerv, unverified, heisd, reuse  # noqa: F401
from kerv_cli.methods import merged, motion, near  # noqa: F401
