"""Success task by task as a map: where a setting falls behind the baseline, and where it is ahead."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.report.drawing import INK, STYLE, entitle, new_figure
from kerv_cli.report.stressed import is_stressed

MOST_SETTINGS = 20  # columns that can still be read
UNKNOWN = "#f4f6f8"  # the baseline itself, and fields without a pair
FAR = 50.0  # points of difference at which the colours end


def has_task_map(per_task: pd.DataFrame) -> bool:
    """Whether a study's table by task makes a map: two tasks or more, and few settings, under one stress."""
    return (
        per_task["task"].nunique() > 1
        and 1 < per_task["label"].nunique() <= MOST_SETTINGS
        and not is_stressed(per_task)
    )


def task_map(per_task: pd.DataFrame, title: str, about: str) -> Figure:
    """Tasks down, settings across: successes of episodes in each field, coloured by the difference to the baseline in
    points over the same worlds. per_task: `per_task_table`."""
    tasks, labels = (list(dict.fromkeys(per_task[name])) for name in ("task", "label"))
    fields = per_task.set_index(["task", "label"])
    points = np.array([[100.0 * float(fields["difference"].get((t, x), np.nan)) for x in labels] for t in tasks])
    with mpl.rc_context(STYLE):
        figure = new_figure(3.4 + 0.95 * len(labels), 2.2 + 0.27 * len(tasks))
        panel = figure.subplots()
        image = panel.imshow(
            points, cmap=mpl.colormaps["RdBu"].with_extremes(bad=UNKNOWN), vmin=-FAR, vmax=FAR, aspect="auto"
        )
        for row, task in enumerate(tasks):
            for column, label in enumerate(labels):
                if (task, label) not in fields.index:
                    continue
                one = fields.loc[(task, label)]
                dark = abs(points[row, column]) > 0.7 * FAR
                text = f"{int(one['successes'])}/{int(one['episodes'])}"
                panel.text(column, row, text, ha="center", va="center", fontsize=8, color="white" if dark else INK)
        panel.set_yticks(range(len(tasks)), tasks, color=INK)
        panel.set_xticks(range(len(labels)), labels, rotation=35, ha="right", color=INK)
        panel.tick_params(length=0)
        panel.grid(visible=False)
        panel.spines[:].set_visible(False)
        bar = figure.colorbar(image, ax=panel, shrink=0.8, pad=0.02, label="points, against the baseline")
        bar.outline.set_visible(False)
        entitle(figure, title, about)
    return figure
