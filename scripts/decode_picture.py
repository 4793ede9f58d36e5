"""Draws docs/decode.png: `scripts/decode_picture.py RUN_FOLDER LABEL OUT.png`, the first decode of that setting of
a run that has two verifications and drafts off the target's token."""

from __future__ import annotations

import sys
from pathlib import Path

from kerv_cli.reporting.drawing import figure_bytes
from kerv_cli.studies.store import StudyStore
from kerv_cli.viewing.decode_picture import decode_figure, rounds_of
from kerv_cli.viewing.token_outcomes import round_outcomes

DOFS = ("dx", "dy", "dz", "grip")  # Meta-World's


def main(folder: str, label: str, out: str) -> None:
    root = Path(folder)
    store = StudyStore(root.parent.parent, root.name, root.parent.name)
    for cell in (cell for cell in store.read_plan().cells if cell.label == label):
        path = store.cells / cell.id / "decodes.parquet"
        for number in range(len(store.read_cell(cell.id).episodes)):
            for index in range(4, 12):
                rounds = rounds_of(path, number * 12 + index)
                kinds = [outcome.kind for r in rounds for _, outcome in round_outcomes(r, 0)]
                if sum(bool(r.drafted) for r in rounds) >= 2 and kinds.count("relaxed") >= 2 and "rejected" in kinds:
                    title = f"{label} on {cell.task}, seed {cell.seeds[0]}, decode {number * 12 + index}"
                    figure = decode_figure(rounds, DOFS, 16, title)
                    Path(out).write_bytes(figure_bytes(figure, "png"))
                    return
    sys.exit(f"no such decode of {label} in {folder}")


if __name__ == "__main__":
    main(*sys.argv[1:])
