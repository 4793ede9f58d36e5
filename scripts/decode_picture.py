"""Draws docs/decode.png: `scripts/decode_picture.py RUN_FOLDER LABEL OUT.png`, the first decode of that setting of
a run that has two verifications and drafts off the target's token: a row per forward of the target, a cell per token of
the chunk."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from kerv_cli.engine.record import Round
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.drawing import INK, MUTED, STYLE, figure_bytes, new_figure
from kerv_cli.report.viewing.token_outcomes import OUTCOMES, TokenOutcome, round_outcomes

DOFS = ("dx", "dy", "dz", "grip")  # Meta-World's


def rounds_of(decodes: Path, number: int) -> tuple[Round, ...]:
    """The rounds of the `number`-th row of a cell's decodes.parquet."""
    row = pq.read_table(decodes, columns=["rounds"])["rounds"][number].as_py()
    stored: list[dict[str, Any]] = [
        {name: tuple(v) if isinstance(v, list) else v for name, v in played.items()} for played in row
    ]
    return tuple(Round(**values) for values in stored)


def decode_figure(rounds: Sequence[Round], names: Sequence[str], size: int, title: str) -> Figure:
    """The rounds from top to bottom. names: of the D DoFs. size: N."""
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure = new_figure(11.0, 1.5 + 0.52 * len(rounds))
        panel = figure.subplots()
        for row, played in enumerate(rounds):
            for place, outcome in round_outcomes(played, row):
                _draw_cell(panel, place, row, outcome)
        panel.set_xlim(-0.1, size + 0.1)
        panel.set_ylim(len(rounds) - 0.02, -0.35)
        panel.set_xticks([i + 0.5 for i in range(size)], [names[i % len(names)] for i in range(size)], fontsize=8)
        panel.xaxis.tick_top()
        panel.set_yticks([i + 0.5 for i in range(len(rounds))], [_row_name(r, i) for i, r in enumerate(rounds)])
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)
        for step in range(len(names), size, len(names)):
            panel.axvline(step, color=MUTED, linewidth=0.8, linestyle=":")
        panel.set_title(title, pad=18)
    return figure


def _row_name(played: Round, number: int) -> str:
    if not played.drafted:
        return f"forward {number + 1}: {'prefill' if played.mode == 'prefill' else 'one token'}"
    return f"forward {number + 1}: {len(played.drafted)} compared, {played.accepted} kept"


def _draw_cell(panel: Axes, place: int, row: int, outcome: TokenOutcome) -> None:
    colour = np.array([(OUTCOMES[outcome.kind].color >> shift & 0xFF) / 255 for shift in (24, 16, 8)])
    box = FancyBboxPatch(
        (place + 0.07, row + 0.12), 0.86, 0.76, boxstyle="round,pad=0,rounding_size=0.12", color=colour, linewidth=0
    )
    panel.add_patch(box)
    dark = float(colour @ [0.3, 0.59, 0.11]) < 0.55
    text = outcome.short.replace(" → ", "→")
    panel.text(
        place + 0.5,
        row + 0.5,
        text,
        ha="center",
        va="center",
        fontsize=6.2 if "→" in text else 7.5,
        color="white" if dark else INK,
    )


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
                    Path(out).write_bytes(figure_bytes(figure))
                    return
    sys.exit(f"no such decode of {label} in {folder}")


if __name__ == "__main__":
    main(*sys.argv[1:])
