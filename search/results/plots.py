"""Figures of studies, as pure functions of their tables."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from optuna.study import StudyDirection
from sb3_aarl.search.results import analysis

BLUE, ORANGE = "#1f4e79", "#c55a11"
COLOURS = (BLUE, ORANGE, "#000000", "#7f7f7f", "#6aa7d6")
# Lines differ by dash and symbol, not by colour alone: they have to be told apart in grey.
LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
SCORE = "Score (AULC, mean return)"


def evolution_plot(
    tables: Mapping[str, pd.DataFrame],
    baselines: Mapping[str, Iterable[tuple[str, float]]] | None = None,
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> Figure:
    """The score of every candidate by generation, beside baselines: the paper's figures 4 and 6, one panel a study."""
    baselines = {title: list(lines) for title, lines in (baselines or {}).items()}
    names = list(dict.fromkeys(name for lines in baselines.values() for name, _ in lines))
    figure, panels = make_panels(list(tables), SCORE, columns=3, width=4.4, height=3.6)
    for axes, (title, table) in zip(panels, tables.items(), strict=True):
        trials = analysis.analysed(table)
        # Spread over the width of its generation by the golden ratio.
        spread = trials["generation"] + 0.56 * (trials["number"] * 0.6180339887 % 1 - 0.5)
        axes.plot(spread, trials["score"], "o", mfc="white", mec="#888888", ms=4, mew=0.7, label="candidate")
        groups = trials.groupby("generation")["score"]
        best = groups.max() if direction == StudyDirection.MAXIMIZE else groups.min()
        for label, scores, colour, symbol in (("best", best, ORANGE, "^"), ("mean", groups.mean(), BLUE, "s")):
            axes.plot(scores.index, scores, marker=symbol, color=colour, label=f"{label} of the generation")
        for name, score in baselines.get(title, ()):
            position = names.index(name)
            axes.axhline(score, label=name, ls=LINES[1:][position % 4], color=COLOURS[2:][position % 3], lw=1.6)
        generations = trials["generation"] if len(trials) else pd.Series([1])
        axes.set_xlim(generations.min() - 0.5, generations.max() + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("Generation")
        axes.set_title(f"{title}\n{count_candidates(table)}", fontsize=9)
    add_legend(figure, panels)
    return figure


def make_panels(titles: Sequence[str], label: str, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title, their vertical axis labelled once a row; width and height of a panel in inches."""
    columns = max(1, min(columns, len(titles)))
    rows = max(1, -(-len(titles) // columns))
    # Without pyplot, whose figures are global.
    figure = Figure(figsize=(width * columns, height * rows + 0.6), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for axes in grid[len(titles) :]:
        axes.remove()
    panels = grid[: len(titles)]
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=9)
        axes.grid(color="#e5e5e5", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    for axes in panels[::columns]:
        axes.set_ylabel(label, fontsize=9)
    return figure, panels


def add_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend for all panels, each label once; what comes last."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    # As many beside each other as fit the width, in inches.
    columns = max(1, int(figure.get_figwidth() / (0.7 + 0.08 * max(map(len, entries), default=0))))
    figure.set_figheight(figure.get_figheight() + 0.22 * (math.ceil(len(entries) / columns) - 1))
    handles = list(entries.values())
    figure.legend(handles, list(entries), loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    # A $ in the name of a study or a file is no formula.
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def count_candidates(table: pd.DataFrame) -> str:
    """How many candidates a figure shows, and how many trials it leaves out."""
    n = len(analysis.analysed(table))
    left_out = f", {len(table) - n} trials without a comparable score left out" if n < len(table) else ""
    return f"{n} candidates{left_out}"
