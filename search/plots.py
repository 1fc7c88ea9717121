"""Pictures of a study, as pure functions of its trials: plotly for the dashboard and the report, matplotlib for files."""

import io
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from html import escape
from statistics import fmean

import plotly.graph_objects as go
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial

from search.trials import curve_of, loss_of, operation_of, score_of, stage_of

# Lines differ by dash and marker, not by colour alone: they have to be told apart in grey.
DASHES = ("dash", "dot", "dashdot", "longdash", "longdashdot")
MARKERS = ("circle", "square", "diamond", "triangle-up", "cross")
BLUE, ORANGE, GREY = "#1f4e79", "#c55a11", "#444444"
COLOURS = (BLUE, ORANGE, "#000000", "#7f7f7f", "#6aa7d6")
AXIS = {"showline": True, "linecolor": GREY, "gridcolor": "#e5e5e5", "zeroline": False, "ticks": "outside"}


def evolution_figure(
    trials: Sequence[FrozenTrial],
    baselines: Iterable[tuple[str, float]] = (),
    direction: StudyDirection = StudyDirection.MAXIMIZE,
) -> go.Figure:
    """
    The score of every completed candidate by stage (the paper's figures 4 and 6), with mean and best of the stages.

    :param trials: Trials of a study; those without a score are passed over
    :param baselines: Names and scores of horizontal lines
    :param direction: The study's, for what is best
    """
    scores: defaultdict[int, list[float]] = defaultdict(list)
    points: dict[str, list] = {"x": [], "y": [], "customdata": []}
    for trial in trials:
        score = score_of(trial)
        if score is None:
            continue
        stage, loss = stage_of(trial), loss_of(trial)
        scores[stage].append(score)
        # Spread by the golden ratio: even, and the same in every picture of one study.
        points["x"].append(round(stage + 0.56 * (trial.number * 0.6180339887 % 1 - 0.5), 3))
        points["y"].append(score)
        notation = "<br>".join(textwrap.wrap(escape(str(loss)), 80)) if loss else "no loss"
        points["customdata"].append([trial.number, notation, escape(operation_of(trial))])
    stages = sorted(scores)
    best = max if direction == StudyDirection.MAXIMIZE else min

    # Plain lists, not arrays: plotly.py writes arrays in a form that the dashboard's older plotly.js cannot read.
    figure = go.Figure()
    figure.add_scatter(
        **points,
        name="candidate",
        mode="markers",
        marker={"size": 7, "color": "white", "line": {"color": GREY, "width": 1}},
        hovertemplate="trial %{customdata[0]}: <b>%{y:.1f}</b><br>%{customdata[1]}<br>%{customdata[2]}<extra></extra>",
    )
    for name, of_stage, dash, symbol, colour in (
        ("best of the stage", best, "solid", "triangle-up", ORANGE),
        ("mean of the stage", fmean, "solid", "square", BLUE),
    ):
        figure.add_scatter(
            x=stages,
            y=[of_stage(scores[stage]) for stage in stages],
            name=name,
            mode="lines+markers",
            line={"dash": dash, "color": colour, "width": 2},
            marker={"size": 9, "symbol": symbol},
            hovertemplate=f"{name} %{{x}}: %{{y:.1f}}<extra></extra>",
        )
    ends = [stages[0] - 0.5, stages[-1] + 0.5] if stages else [0.5, 1.5]
    for position, (name, score) in enumerate(baselines):
        figure.add_scatter(
            x=ends,
            y=[score, score],
            name=escape(name),
            mode="lines",
            line={"dash": DASHES[position % len(DASHES)], "color": COLOURS[2 + position % 3], "width": 1.5},
            hovertemplate=f"{escape(name)}: %{{y:.1f}}<extra></extra>",
        )
    _style(figure, "Evolution of auxiliary losses", "Stage", "Score (AULC, mean return)")
    figure.update_xaxes(range=ends, tickmode="array", tickvals=stages, showgrid=False)
    return figure


def learning_curves_figure(trials: Iterable[FrozenTrial]) -> go.Figure:
    """
    The learning curves of some trials, with standard deviations as bars; those without a curve are passed over.

    :param trials: Trials, in the order of the legend
    """
    figure = go.Figure()
    drawn = [(trial, curve_of(trial)) for trial in trials if curve_of(trial)]
    for position, (trial, curve) in enumerate(drawn):
        steps, means, deviations = (list(column) for column in zip(*curve, strict=True))
        colour = COLOURS[position % len(COLOURS)]
        figure.add_scatter(
            x=steps,
            y=means,
            error_y={"array": deviations, "thickness": 1, "width": 3},
            name=f"trial {trial.number}",
            mode="lines+markers",
            line={"dash": ("solid", *DASHES)[position % 5], "color": colour, "width": 2},
            marker={"size": 8, "symbol": MARKERS[position % len(MARKERS)]},
            hovertemplate=f"trial {trial.number}, step %{{x}}: %{{y:.1f}}<extra></extra>",
        )
    _style(figure, "Learning curves of the best", "Environment steps", "Return (mean ± std of the episodes)")
    return figure


def _style(figure: go.Figure, title: str, x_label: str, y_label: str) -> None:
    figure.update_layout(
        template="none",
        title={"text": title, "font": {"size": 16}, "x": 0.01, "xanchor": "left"},
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#222222"},
        paper_bgcolor="white",
        plot_bgcolor="white",
        showlegend=True,
        legend={"orientation": "h", "yanchor": "top", "y": -0.18, "x": 0},
        margin={"l": 70, "r": 20, "t": 50, "b": 60},
        hovermode="closest",
    )
    figure.update_xaxes(title={"text": x_label}, **AXIS)
    figure.update_yaxes(title={"text": y_label}, **AXIS)


def learning_curve_png(curve: Sequence[tuple[int, float, float]], title: str) -> bytes:
    """
    A learning curve as a picture.

    :param curve: Environment steps, mean return and standard deviation of every evaluation
    :param title: Title, in matplotlib's notation (``$...$`` is typeset)
    """
    steps, means, deviations = (list(column) for column in zip(*curve, strict=True))
    figure = Figure(figsize=(6.4, 3.8), dpi=100, layout="constrained")
    # Without pyplot: notes are also written from threads.
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, means, "o-", color=BLUE, label="mean of the episodes")
    low = [mean - deviation for mean, deviation in zip(means, deviations, strict=True)]
    high = [mean + deviation for mean, deviation in zip(means, deviations, strict=True)]
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0, label="± standard deviation")
    axes.set_xlabel("Environment steps")
    axes.set_ylabel("Return")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
