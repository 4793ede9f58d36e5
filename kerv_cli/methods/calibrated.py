"""Register the kind of artifact `calibration`, a file of measured numbers that KERV and HeiSD read."""

from __future__ import annotations

from kerv_cli.base.registry import ArtifactPart


# it has a section for a drafter and one for a datastore
@ArtifactPart("calibration", needs=("drafter", "datastore"), by_task=True, needs_task=True)
def artifact() -> type:
    from kerv_cli.methods.calibration import CalibrationArtifact

    return CalibrationArtifact
