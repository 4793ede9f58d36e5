"""Methods: a file or a folder per family (docs/methods.md).

    ar                          autoregressive decoding: no part at all
    spec_vla                    Spec-VLA: strict acceptance, and acceptance within one radius
    eagle                       EAGLE-2: the drafter on the target's hidden states, our own and public ones
    kerv                        KERV: kinematic predictions, and thresholds that follow the motion
    heisd                       HeiSD: retrieved drafts, a boundary between two drafters, skipped verification
    jacobi, parallel            the decoding of PD-VLA and OpenVLA-OFT
    early, merged               ours: a draft before the prefill (`one_pass`)
    scout                       ours: a drafter with its own vision encoder
    streak, unverified          ours: drafts that are executed without verification
    certified                   ours: the same, on the tasks of a certificate of success
    sp_vla                      SP-VLA: a regression where the motion is fast

A file, and the `__init__.py` of a folder, holds settings and registrations and imports neither torch nor numpy.

`compose.py` makes a decoder of a method's parts. `context.py` is what parts are made from. `artifacts.py` finds, checks
and loads files. `drafters.py` is the base of drafters with weights. `calibration.py` is the file that KERV and HeiSD
share.
"""
