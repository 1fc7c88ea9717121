"""
Write all tables of results: table.md of each experiment, the index in README.md, the tables of both README.md and of docs/.

Every number of a run comes from its curve.csv and provenance.json; tables.yml says which runs a table of a page shows.
"""

import json
import math
import os
import re
import runpy
import statistics
import textwrap
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import paper_tables
import yaml
from sb3_aarl.search.execution.matrix import stored_scores, task_name
from sb3_aarl.search.execution.storage import STUDY_FILE, load_study, open_storage
from sb3_aarl.search.results import analysis, table
from sb3_aarl.search.studies.benchmark import read_abouts
from sb3_aarl.search.studies.search import SETTINGS_KEY
from sb3_aarl.search.training.provenance import read_about
from scipy.stats import mannwhitneyu

from sb3_aarl.callbacks import read_curve

RESULTS = Path(__file__).resolve().parent
ROOT = RESULTS.parent
SOURCE = "results/make_tables.py"
# Pages that have some of the tables.
GUIDES = ("expect.md", "from_sac.md", "losses.md", "paper.md", "results.md")
PAGES = [
    ROOT / "README.md",
    RESULTS / "README.md",
    RESULTS / "agent/peers/about.md",
    RESULTS / "agent/proof/about.md",
    *(ROOT / "docs" / "guides" / name for name in GUIDES),
]
# The columns of the main table, and their variants in agent/proof/runs.
PROVED = {"SACAux": "sac_aux", "no loss": "no_loss", "SAC": "sac", "CrossQ": "crossq"}
# What a search does to losses; the others are drawn at random, from priors, or given.
EVOLVED = ("crossover", "replacement", "horizon_change")
DRAWN, BEST = 20, 10
# Environment steps between the evaluations of a run.
EVERY = 10_000
# The tables of an analysis, and their titles.
ANALYSES = {
    "table5": "Patterns: mean score with - without (table 5; Welch's t-test: * p < 0.05, ** p < 0.01)",
    "horizon": "Scores by horizon; difference to all others",
    "operator": "Scores by operator; difference to all others",
    "operation": "Scores by operation; difference to all others",
    "lineage": "Lineage of the best; gain over the better parent",
    "machines": "Machines and time",
}


def texts() -> dict[Path, str]:
    """All files that this script writes, and their text."""
    read = yaml.safe_load((RESULTS / "tables.yml").read_text("utf-8"))
    tasks = [row for row in read["headline"].values() if isinstance(row[-1], int)]
    tables = {name: sentence(part, tasks) if isinstance(part, str) else readme_table(part) for name, part in read.items()}
    tables["shares"] = shares_table(tasks)
    peers = RESULTS / "agent/peers"
    tables["peers"] = peers_table(peers)
    tables["step_times"] = markdown(
        list(zip(*((name, f"{ratio:.2f}") for name, ratio in step_ratios(peers).items()), strict=True))
    )
    abouts = sorted(RESULTS.glob("*/*/about.md"))
    tables["index"] = markdown([("experiment", "question", "answer"), *map(summary, abouts)])
    files = {path: filled(path.read_text(encoding="utf-8"), tables) for path in PAGES}
    for folder in (about.parent for about in abouts):
        if (folder / STUDY_FILE).exists():
            files[folder / "table.md"] = page(folder, search_tables(folder))
        elif (folder / "runs").exists():
            files[folder / "table.md"] = page(folder, benchmark_tables(folder))
    return files


def filled(text: str, tables: dict[str, str]) -> str:
    """A text whose tables are replaced, each between a comment that names it and one that ends it."""
    for name in re.findall(rf"<!-- {SOURCE}: (\w+) -->", text):
        start, end = f"<!-- {SOURCE}: {name} -->\n", "<!-- end -->"
        before, _, rest = text.partition(start)
        text = before + start + tables[name] + "\n" + end + rest.partition(end)[2]
    return text


def readme_table(rows: list[list[str]] | dict[str, list[str]]) -> str:
    """A table of tables.yml."""
    if isinstance(rows, dict):
        rows = [["", *PROVED, "best published"], *(proof_row(*row) for row in rows.items())]
    return markdown(
        [[returns(RESULTS / cell) if any((RESULTS / cell).glob("seed-*")) else cell for cell in row] for row in rows]
    )


def proof_row(name: str, values: list[str]) -> list[str]:
    """A row of the main table: our runs where there are some, else a published mean, else a dash."""
    if isinstance(values[-1], str):
        return [name, *values]
    task, sac, crossq, best, *_ = values
    published = {"sac": sac, "crossq": crossq}
    folders = {variant: f"agent/proof/runs/{variant}/{task}" for variant in PROVED.values()}
    cells = [folder if (RESULTS / folder).exists() else published.get(variant, "-") for variant, folder in folders.items()]
    return [name, *cells, best]


def sentence(text: str, rows: Iterable[list[Any]]) -> str:
    """
    A text of tables.yml. Of the tasks of the main table that have runs, ``{tasks}`` is the number, ``{share}`` and ``{times}``
    the medians of the mean return over DR.Q's and over SAC's.
    """
    found = []
    for task, sac, _, _, drq, _ in rows:
        if last := last_returns(RESULTS / "agent/proof/runs/sac_aux" / task):
            mean = statistics.mean(last)
            found.append((mean / drq, mean / float(sac.strip("_").partition(" ")[0].replace(",", ""))))
    share, times = map(statistics.median, zip(*found, strict=True))
    text = text.format(tasks=len(found), share=f"{share:.2f}", times=f"{times:.1f}")
    return textwrap.fill(text, 126, break_on_hyphens=False)


def shares_table(rows: Iterable[list[Any]]) -> str:
    """The defaults beside DR.Q and MR.Q, and of each run the mean of the last two evaluations over the best before."""
    table = [["task", "mean returns at each 10,000 environment steps", "last", "of DR.Q", "of MR.Q", "kept"]]
    shares, kept = [], []
    for task, *_, drq, mrq in rows:
        folder = RESULTS / "agent/proof/runs/sac_aux" / task
        curves = [[point.mean for point in read_curve(path)] for path in sorted(folder.glob("seed-*/curve.csv"))]
        means = [statistics.mean(values) for values in zip(*curves, strict=True)]
        ratios = [statistics.mean(curve[-2:]) / max(curve[:-2]) for curve in curves]
        shares.append([means[-1] / drq, means[-1] / mrq])
        kept += ratios
        numbers = [", ".join(f"{mean:,.0f}" for mean in means), returns(folder), *(f"{share:.2f}" for share in shares[-1])]
        table.append([task, *numbers, ", ".join(f"{ratio:.2f}" for ratio in ratios)])
    lines = [
        f"{name} {of([drq for drq, _ in shares]):.2f} of DR.Q and {of([mrq for _, mrq in shares]):.2f} of MR.Q"
        for name, of in (("Mean share", statistics.mean), ("median", statistics.median))
    ]
    text = f"{'; '.join(lines)}. At least 0.8 is kept in {sum(ratio >= 0.8 for ratio in kept)} of {len(kept)} runs."
    return f"{markdown(table)}\n\n{text}"


def peers_table(folder: Path) -> str:
    """
    Algorithms at 50,000 and 100,000 steps, and at their last evaluation within the time that SACAux takes for these, if they
    were trained so long.
    """
    points = pd.concat(
        pd.DataFrame(read_curve(path)).assign(task=path.parts[-3], algorithm=path.parts[-4], seed=path.parts[-2])
        for path in sorted(folder.glob("runs/*/*/seed-*/curve.csv"))
    )
    points = points[points["seed"].isin(["seed-50", "seed-51", "seed-52"])]
    slower = points["algorithm"].map(step_ratios(folder))
    groups = ["task", "algorithm"]
    columns = {}
    for steps in (50_000, 100_000):
        reached = points[points["environment_steps"] == steps]
        columns[f"{steps:,} steps"] = reached.groupby(groups)["mean"].agg(returns_text)
        at = (steps / slower / EVERY).astype(int) * EVERY
        columns[f"in SACAux's time for {steps:,}"] = (
            points[points["environment_steps"] == at].groupby(groups)["mean"].agg(returns_text)
        )
    return from_frame(pd.DataFrame(columns).fillna("-").reset_index())


def step_ratios(folder: Path) -> dict[str, float]:
    """What a step of each algorithm takes, SACAux's being 1."""
    return json.loads((folder / "steps.json").read_text("utf-8"))["ratio"]


def last_returns(folder: Path) -> list[float]:
    """The last returns of the runs in a folder, one for each seed."""
    return [read_curve(path)[-1].mean for path in folder.glob("seed-*/curve.csv")]


def returns(folder: Path) -> str:
    """The last returns of the runs in a folder."""
    return returns_text(last_returns(folder))


def returns_text(values: Collection[float]) -> str:
    """Mean, deviation and number of returns."""
    deviation = f" ± {statistics.stdev(values):,.0f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):,.0f}{deviation} ({len(values)})"


def summary(about: Path) -> tuple[str, str, str]:
    """A row of the index: an experiment, its question, and the first sentence of its answer."""
    text = " ".join(about.read_text(encoding="utf-8").split())
    parts = dict(re.findall(r"\*\*(Question|Answer)\.\*\* (.*?[.?])(?: |$)", text))
    name = about.parent.relative_to(RESULTS).as_posix()
    group = name.partition("/")[0]
    return f"[{name}]({name}/about.md)", parts["Question"], parts["Answer"].replace("](../", f"]({group}/")


def page(folder: Path, parts: Iterable[str]) -> str:
    """A table.md."""
    name = folder.relative_to(RESULTS).as_posix()
    return (
        "\n\n".join([f"# Tables of {name}", f"Written by `python {SOURCE}`. What they mean: [about.md](about.md).", *parts])
        + "\n"
    )


def benchmark_tables(folder: Path) -> Iterator[str]:
    """What ``aarl table`` shows of a benchmark, and its runs."""
    found = table.read_tables(folder)
    for title, shown in table.text_tables(found).items():
        yield f"## {title}\n\n{from_frame(shown)}"
    yield from table.missing(found.runs) + table.mixed(found.runs)
    if (number := paper_tables.closest_table(found.runs["variant"])) is not None:
        mark = "▲ ▼: the difference is more than two standard errors, 2 sqrt(s²/n + S²/N)."
        beside = paper_tables.readable(paper_tables.beside(found.runs, number))
        yield f"## Beside table {number} of the paper\n\n{from_frame(beside)}\n\n{mark}"
    heads = ("run", "return", "mean of the evaluations", "minutes", "threads", "processor", "commit", "date")
    yield "## Runs\n\n" + markdown([heads, *(run_row(path, folder, about) for path, about in read_abouts(folder).items())])


def run_row(path: Path, folder: Path, about: dict[str, Any]) -> list[str]:
    """A run: its curve, what it found, where and how long it was trained."""
    curve, sessions = read_curve(path / "curve.csv"), about["sessions"]
    name = f"{about['variant']}/{task_name(about['environment'])}/seed-{about['seed']}"
    processor = "cpu" if sessions[-1]["gpu"] == "none" else "gpu"
    return [
        f"[{name}]({os.path.relpath(path, folder)}/curve.csv)",
        f"{curve[-1].mean:.1f} at {curve[-1].environment_steps:,}{'' if 'seconds' in about else ', unfinished'}",
        f"{statistics.mean(point.mean for point in curve):.1f}",
        f"{curve[-1].seconds / 60:.0f}",
        *(", ".join(dict.fromkeys(str(session[key]) for session in sessions)) for key in ("threads", processor, "commit")),
        sessions[-1]["date"][:10],
    ]


def search_tables(folder: Path) -> Iterator[str]:
    """
    What the generations of a search found, its best losses, what ``aarl report`` shows, and the rankings of its matrices; of
    a search with several seeds how well short runs rank losses.
    """
    study = load_study(open_storage(folder, create=False))
    parts = ["candidates", "baselines", "cross-validation"]
    if len(study.user_attrs[SETTINGS_KEY]["seeds"]) > 1:
        report = runpy.run_path(str(ROOT / "benchmarks" / "fidelity.py"))["report"]
        lines = "\n".join(line.rstrip() for line in report(folder).strip("\n").splitlines())
        yield f"`python benchmarks/fidelity.py {folder.relative_to(ROOT).as_posix()}`:\n\n```text\n{lines}\n```"
        yield core_hours(folder, parts[:1])
        return
    trials = analysis.analysed(analysis.trial_table(study.get_trials(deepcopy=False)))
    yield from generation_tables(trials)
    best = trials.nlargest(BEST, "score").to_dict("records")
    rows = [(row["number"], row["generation"], row["operation"], score_text(row["score"]), f"`{row['loss']}`") for row in best]
    yield "## Best losses\n\n" + markdown([("trial", "generation", "operation", "score", "loss"), *rows])
    found = analysis.summary(study.get_trials(deepcopy=False))
    for name, title in ANALYSES.items():
        if name in found:
            yield f"## {title}\n\n{from_frame(analysis.readable(found[name]))}"
    for part in parts[1:]:
        if not (runs := stored_scores(folder / part)).empty:
            ranked = mean_scores(runs)
            shown = ranked.map("{:.1f}".format).assign(runs=ranked["runs"]).reset_index()
            yield f"## {part.capitalize()}, AULC\n\n{from_frame(shown)}"
    yield core_hours(folder, parts)


def generation_tables(trials: pd.DataFrame) -> Iterator[str]:
    """Scores of the generations, and how likely luck explains that evolved losses are better."""
    evolved, random = trials[trials["operation"].isin(EVOLVED)], trials[trials["operation"] == "random"]
    rows = []
    for generation in [*sorted(trials["generation"].unique()), "all"]:
        parts = [part if generation == "all" else part[part["generation"] == generation] for part in (trials, evolved, random)]
        rows.append([generation, *(scores_text(part["score"].tolist()) for part in parts)])
    yield "## Scores: mean ± its standard error (number, best)\n\n" + markdown(
        [("generation", "all", "evolved", "random"), *rows]
    )
    scores, others = evolved["score"].tolist(), random["score"].tolist()
    if min(len(scores), len(others)) < DRAWN:
        return
    best = [score_text(mean_of_best(values, DRAWN)) for values in (scores, others)]
    yield (
        f"The best of {DRAWN} evolved losses is {best[0]} on average, the best of {DRAWN} random ones {best[1]}; "
        f"Mann-Whitney's p of all is {mannwhitneyu(scores, others).pvalue:.1g}."
    )


def score_text(score: float, largest: float | None = None) -> str:
    """A score, with decimals where the largest is a share of a return."""
    return f"{score:.{0 if (largest or score) > 10 else 3}f}"


def scores_text(scores: list[float]) -> str:
    """Mean, standard error, number and best of scores."""
    if len(scores) < 2:
        return ", ".join(map(score_text, scores))
    error = statistics.stdev(scores) / math.sqrt(len(scores))
    mean, error_text, best = (score_text(score, max(scores)) for score in (statistics.mean(scores), error, max(scores)))
    return f"{mean} ± {error_text} ({len(scores)}, {best})"


def mean_of_best(scores: list[float], n: int) -> float:
    """The expectation of the best of n scores that are drawn without replacement."""
    ways = (math.comb(rank, n - 1) for rank in range(len(scores)))
    return sum(score * way for score, way in zip(sorted(scores), ways, strict=True)) / math.comb(len(scores), n)


def mean_scores(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean scores of variants on each environment and over all, the deviation over seeds, the number of runs; best first."""
    by_environment = runs.pivot_table(index="variant", columns="environment", values="score")
    by_seed = runs.groupby(["variant", "seed"])["score"].mean().groupby("variant").agg(["mean", "std"])
    result = by_environment.join(by_seed).assign(runs=runs.groupby("variant").size())
    return result.sort_values("mean", ascending=False)


def core_hours(folder: Path, parts: Iterable[str]) -> str:
    """The finished runs of a search, and the hours of one core that they took."""
    rows = []
    for part in parts:
        abouts = [read_about(path.parent) for path in (folder / part).rglob("curve.csv")]
        hours = [about["seconds"] * about["sessions"][-1]["threads"] / 3600 for about in abouts if "seconds" in about]
        rows.append((part, len(hours), f"{math.fsum(hours):.1f}"))
    return "## Cost\n\n" + markdown([("part", "runs", "core hours"), *rows])


def from_frame(frame: pd.DataFrame) -> str:
    """A table of texts as Markdown; losses stand in backticks."""
    rows = [[f"`{cell}`" if "->" in str(cell) else cell for cell in row] for row in frame.itertuples(index=False)]
    return markdown([list(frame.columns), *rows])


def markdown(rows: Iterable[Iterable[Any]]) -> str:
    """A table whose first row is its head."""
    head, *others = (f"| {' | '.join(map(str, row))} |" for row in rows)
    return "\n".join([head, re.sub(r"[^|]+", "---", head), *others])


if __name__ == "__main__":
    for path, text in texts().items():
        path.write_text(text, encoding="utf-8")
