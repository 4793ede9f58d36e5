"""Methods, a file or a folder per family (docs/methods.md). A file, and a folder's `__init__.py` with settings and
registration, imports neither torch nor numpy; code that does lies beside it.

    ar                          autoregressive decoding: the absence of every part
    spec_vla                    Spec-VLA: acceptance token by token within one radius; strict acceptance
    eagle                       EAGLE-2: the drafter on the target's hidden states, own and public ones
    kerv                        KERV: predictions as drafts and behind a rejection, thresholds that follow the motion
    heisd                       HeiSD: the datastore and its drafts; two sides of a boundary, verify-skip
    jacobi, parallel            PD-VLA's and OpenVLA-OFT's decoding
    early, merged               ours: a draft before the prefill (`one_pass`)
    scout                       ours: whole chunks from the images, without the target
    streak, unverified          ours: drafts that are executed without a verification
    certified                   ours: … on the tasks of a certificate of success
    sp_vla                      SP-VLA: a regression where motion is fast

`compose.py` makes a decoder of a method's parts, `context.py` is what they are made from, `artifacts.py` finds, checks
and loads their files. `calibration.py` is the file that KERV and HeiSD share.
"""
