"""Methods, a folder or a file per family (docs/methods.md). A folder's `__init__.py` has settings and registration and
imports nothing heavy; the code lies beside it.

    ar                          autoregressive decoding: the absence of every part
    spec_vla                    Spec-VLA: acceptance token by token within one radius; strict acceptance
    eagle                       EAGLE-2: the drafter on the target's hidden states, own and public ones
    kinematics                  KERV: predictions as drafts and behind a rejection, thresholds that follow the motion
    retrieval, heisd            HeiSD: the datastore and its drafts; two sides of a boundary, verify-skip
    jacobi, parallel            PD-VLA's and OpenVLA-OFT's decoding
    early, merged               ours: a draft before the prefill (`one_pass`)
    streak, unverified          ours: what is executed without a verification

`compose.py` makes a decoder of a method's parts, `context.py` is what they are made from, `artifacts.py` finds, checks
and loads their files. `calibration.py` is the file that KERV and HeiSD share.
"""
