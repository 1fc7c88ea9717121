"""
Write README.md from the runs that lie beside it: every number of a run of ours comes from a curve.csv and its provenance.json.

A folder here is that of an ``aarl benchmark`` or an ``aarl search``, without the checkpoints of unfinished runs. Its text is
its about.md, the first line being its title; numbers do not belong there.
"""

import math
import runpy
import shlex
import statistics
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sb3_aarl.search.cli.main import app
from sb3_aarl.search.execution.matrix import stored_scores
from sb3_aarl.search.execution.storage import STUDY_FILE, load_study, open_storage
from sb3_aarl.search.results.analysis import analysed, trial_table
from sb3_aarl.search.results.table import closest_table, paper_scores
from sb3_aarl.search.studies.benchmark import read_abouts, task_name
from sb3_aarl.search.studies.cross_validation import ranking
from sb3_aarl.search.studies.search import SETTINGS_KEY
from sb3_aarl.search.training.provenance import read_about
from scipy.stats import mannwhitneyu
from typer.testing import CliRunner

from sb3_aarl.callbacks import read_curve

RESULTS = Path(__file__).parent
ABOUT = "about.md"
# The paper's search from states: seven generations on Cheetah-Run (table 12) of a population of 100, the first with 25 more of
# the priors (A.3); the environment steps of a candidate there, and the GPU hours after which the paper stopped its searches.
CANDIDATES, STEPS, PAPER_HOURS = 725, 500_000, 1_500
# Returns of the public code with this software, in float32 with one seed: measured when this project was planned; there are no
# curves of it here.
REFERENCE = {("dm_control/cheetah-run-v0", 100_000): "AARL-State 436, SAC with DenseMLP 274 (seed 1, float32)"}
# The paper's scores from pixels and from states.
TABLES = {"CnnPolicy": 3, "MlpPolicy": 4}
# What a search does to losses; the others are drawn at random, from priors, or given.
EVOLVED = ("crossover", "replacement", "horizon_change")
DRAWN, BEST = 20, 10

INTRODUCTION = f"""# Results

Written by `python results/{Path(__file__).name}`: no number of a run of ours is typed by hand. Each run's learning curve is
`FOLDER/VARIANT/TASK/seed-N/curve.csv` (returns of deterministic episodes at environment steps), all that is needed to
make it again is in the `provenance.json` beside it. Benchmarks of speed and of the search are in
[benchmarks](../benchmarks/README.md).
"""


def readme(results: Path) -> str:
    """
    The whole text.

    :param results: Folder with benchmarks' folders in it
    """
    sections = [line for folder in folders(results) for line in section(folder, results)]
    return "\n".join([INTRODUCTION, *(sections or ["No run is finished yet."])]).strip() + "\n"


def folders(results: Path) -> list[Path]:
    """
    Folders of benchmarks and searches, in alphabetical order.

    :param results: Folder they are in
    """
    return sorted(path.parent for path in results.rglob(ABOUT))


def section(folder: Path, results: Path) -> Iterator[str]:
    """
    The section of a benchmark or a search: its text, and what it found.

    :param folder: Folder of the benchmark or the search
    :param results: Folder it is in
    """
    title, _, text = (folder / ABOUT).read_text(encoding="utf-8").partition("\n")
    yield f"## {title}\n"
    yield text.strip() + "\n"
    yield from (search_section if (folder / STUDY_FILE).exists() else benchmark_section)(folder, results)


def benchmark_section(folder: Path, results: Path) -> Iterator[str]:
    """
    The tables of a benchmark, its runs and their cost.

    :param folder: Folder of the benchmark
    :param results: Folder it is in
    """
    name = folder.relative_to(results.parent).as_posix()
    yield from printed(f"aarl table {name}", results)
    abouts = read_abouts(folder)
    yield from paper(abouts.values())
    trained = [(path, about) for path, about in abouts.items() if (path / "curve.csv").exists()]
    yield "| run | return | mean of the evaluations | minutes | threads | processor | commit | date |"
    yield "|---|---|---|---|---|---|---|---|"
    for path, about in trained:
        curve, sessions = read_curve(path / "curve.csv"), about["sessions"]
        cells = [
            f"[{path.relative_to(folder).as_posix()}]({path.relative_to(results).as_posix()}/curve.csv)",
            f"{curve[-1].mean:.1f} at {curve[-1].environment_steps:,}{'' if 'seconds' in about else ', unfinished'}",
            f"{statistics.mean(point.mean for point in curve):.1f}",
            f"{curve[-1].seconds / 60:.0f}",
            *(
                ", ".join(dict.fromkeys(str(session[key]) for session in sessions))
                for key in ("threads", "cpu" if sessions[-1]["gpu"] == "none" else "gpu", "commit")
            ),
            sessions[-1]["date"][:10],
        ]
        yield f"| {' | '.join(cells)} |"
    yield "\nMade again by (`--folder` another folder, `--workers` for several at once):\n"
    yield "```bash"
    yield from commands(about for _, about in trained)
    yield "```\n"
    finished = [about for _, about in trained if "seconds" in about and "program" not in about]
    yield from cost([about for about in finished if about["sessions"][-1].get("device") != "cuda"])


def search_section(folder: Path, results: Path) -> Iterator[str]:
    """
    What the generations of a search found, its best losses, all that ``aarl analyze`` says, and of its matrices the variants
    that can be compared.

    :param folder: Folder of the search
    :param results: Folder it is in
    """
    name = folder.relative_to(results.parent).as_posix()
    study = load_study(open_storage(folder, create=False))
    if len(study.user_attrs[SETTINGS_KEY]["seeds"]) > 1:
        report = runpy.run_path(str(results.parent / "benchmarks" / "fidelity.py"))["report"]
        yield f"`python benchmarks/fidelity.py {name}`:\n"
        yield from block(report(folder))
        yield from core_hours(folder, ["candidates"])
        return
    trials = analysed(trial_table(study.get_trials(deepcopy=False)))
    evolved, random = trials[trials["operation"].isin(EVOLVED)], trials[trials["operation"] == "random"]
    yield "Scores: mean ± its standard error (number, best).\n"
    yield "| generation | all | evolved | random |"
    yield "|---|---|---|---|"
    for generation in [*sorted(trials["generation"].unique()), "all"]:
        parts = [part if generation == "all" else part[part["generation"] == generation] for part in (trials, evolved, random)]
        yield f"| {generation} | {' | '.join(summary(part['score'].tolist()) for part in parts)} |"
    scores, others = evolved["score"].tolist(), random["score"].tolist()
    if min(len(scores), len(others)) >= DRAWN:
        best = [f"{mean_of_best(values, DRAWN):.0f}" for values in (scores, others)]
        p = mannwhitneyu(scores, others).pvalue
        yield f"\nOf {DRAWN} drawn from the evolved the best is {best[0]} on average, of {DRAWN} random ones {best[1]};"
        yield f"Mann-Whitney's p of all is {p:.1g}.\n"
    yield "| trial | generation | operation | score | loss |"
    yield "|---|---|---|---|---|"
    for row in trials.nlargest(BEST, "score").to_dict("records"):
        yield f"| {row['number']} | {row['generation']} | {row['operation']} | {row['score']:.0f} | `{row['loss']}` |"
    yield ""
    yield from printed(f"aarl analyze {name}", results)
    for part in ("baselines", "cross-validation"):
        runs = stored_scores(folder / part)
        if not runs.empty:
            yield f"{part.capitalize()}, AULC:\n"
            yield from block(ranking(runs).round(1).to_string())
    yield from core_hours(folder, ["candidates", "baselines", "cross-validation"])


def core_hours(folder: Path, parts: Iterable[str]) -> Iterator[str]:
    """
    The runs of a search and the hours of one core that they took.

    :param folder: Folder of the search
    :param parts: Names of the folders in it that have runs
    """
    yield "| part | runs | core hours |"
    yield "|---|---|---|"
    for part in parts:
        abouts = [read_about(path.parent) for path in (folder / part).rglob("curve.csv")]
        hours = [hours_of_a_core(about) for about in abouts if "seconds" in about]
        yield f"| {part} | {len(hours)} | {math.fsum(hours):.1f} |"
    yield f"\nThe paper stopped each of its searches from states after {PAPER_HOURS:,} GPU hours.\n"


def hours_of_a_core(about: dict[str, Any]) -> float:
    """
    What a run took, in hours of one core.

    :param about: The ``provenance.json`` of a finished run
    """
    return about["seconds"] * about["sessions"][-1]["threads"] / 3600


def summary(scores: list[float]) -> str:
    """
    Mean, standard error, number and best of scores.

    :param scores: Scores, any number of them
    """
    if len(scores) < 2:
        return ", ".join(f"{score:.0f}" for score in scores)
    error = statistics.stdev(scores) / math.sqrt(len(scores))
    return f"{statistics.mean(scores):.0f} ± {error:.0f} ({len(scores)}, {max(scores):.0f})"


def mean_of_best(scores: list[float], n: int) -> float:
    """
    The expectation of the best of n scores that are drawn without replacement.

    :param scores: At least n scores
    :param n: How many are drawn
    """
    ways = (math.comb(rank, n - 1) for rank in range(len(scores)))
    return sum(score * way for score, way in zip(sorted(scores), ways, strict=True)) / math.comb(len(scores), n)


def printed(command: str, results: Path) -> Iterator[str]:
    """
    A command of ``aarl`` and what it prints.

    :param command: Its words, the last one a folder beside results/
    :param results: This folder
    """
    *words, folder = command.split()
    runner = CliRunner(env={"COLUMNS": "120", "NO_COLOR": "1"})
    result = runner.invoke(app, [*words[1:], str(results.parent / folder)], catch_exceptions=False)
    yield f"`{command}`:\n"
    yield from block(result.stdout)


def block(text: str) -> Iterator[str]:
    """
    Text as it is.

    :param text: Lines
    """
    yield "```text"
    yield "\n".join(line.rstrip() for line in text.strip("\n").splitlines())
    yield "```\n"


def paper(abouts: Iterable[dict[str, Any]]) -> Iterator[str]:
    """
    The paper's scores on the same tasks at the same steps, unless a variant is one of its own: then they are in the table. And
    the returns of the public code there.

    :param abouts: The ``provenance.json`` of the runs
    """
    abouts = list(abouts)
    in_table = closest_table(about["variant"] for about in abouts) is not None
    compared = [
        (TABLES[about["hyperparameters"]["policy"]], step, about["environment"])
        for about in abouts
        for step in about["checkpoints"]
        if about["hyperparameters"]["policy"] in TABLES
    ]
    for number, step, environment in dict.fromkeys(compared):
        scores = paper_scores(number).query("checkpoint == @step and environment == @environment")
        cells = [f"{row.column} {row.mean:.0f} ± {row.std:.0f}" for row in scores.itertuples()]
        if cells and not in_table:
            runs = scores["runs"].iloc[0]
            yield f"The paper's table {number}, {task_name(environment)} at {step:,}, {runs} runs: {', '.join(cells)}.\n"
        if number == 4 and (environment, step) in REFERENCE:
            yield f"The public code there, one run (not ours, its curves are not here): {REFERENCE[environment, step]}.\n"


def commands(abouts: Iterable[dict[str, Any]]) -> Iterator[str]:
    """
    The commands that repeat runs, one for all seeds of a variant on a task.

    :param abouts: The ``provenance.json`` of the runs; those of another program than ``aarl`` are skipped
    """
    seeds: dict[tuple[str, str], list[int]] = {}
    for about in abouts:
        if "program" in about:
            continue
        steps, checkpoints = about["evaluations"], about["checkpoints"]
        # The interval between evaluations: the one that leads to these.
        every = [step for step in steps if sorted({*checkpoints, *range(step, steps[-1], step)}) == steps]
        # Where the file was moved, its name finds it.
        file = about["file"] if Path(about["file"]).exists() else Path(about["file"]).stem
        before = ["aarl", "benchmark", file, "--envs", task_name(about["environment"])]
        after = ["--checkpoints", ",".join(map(str, checkpoints))]
        after += ["--every", str(every[0])] if steps != checkpoints else []
        after += ["--episodes", str(about["evaluation_episodes"]), "--threads", str(about["sessions"][-1]["threads"])]
        seeds.setdefault((shlex.join(before), shlex.join(after)), []).append(about["seed"])
    for (variant, settings), numbers in seeds.items():
        yield f"{variant} --seeds {','.join(map(str, sorted(numbers)))} {settings}"


def cost(abouts: list[dict[str, Any]]) -> Iterator[str]:
    """
    The cost of runs, and of a whole search from states at that rate.

    :param abouts: The ``provenance.json`` of finished runs on processors
    """
    if not abouts:
        return
    yield f"| variant | runs | seconds a run (median, from, to) | core hours a run | core hours of {CANDIDATES} candidates |"
    yield "|---|---|---|---|---|"
    for variant in dict.fromkeys(about["variant"] for about in abouts):
        runs = [about for about in abouts if about["variant"] == variant]
        seconds = [about["seconds"] for about in runs]
        shown = f"{statistics.median(seconds):,.0f} ({min(seconds):,.0f} to {max(seconds):,.0f})"
        hours = [hours_of_a_core(about) for about in runs]
        per_step = statistics.median(h / about["evaluations"][-1] for h, about in zip(hours, runs, strict=True))
        # A candidate has a loss.
        whole = "" if runs[0]["hyperparameters"]["aux_loss"] is None else f"{CANDIDATES * STEPS * per_step:,.0f}"
        yield f"| {variant} | {len(runs)} | {shown} | {statistics.median(hours):.2f} | {whole} |"
    yield (
        f"\nEvaluations included, at the rate of these runs. The candidates have {STEPS:,} environment steps each, as on "
        f"Cheetah-Run from states; the paper stopped each of its searches from states, one for each environment, after "
        f"{PAPER_HOURS:,} GPU hours. Ours are hours of one core; runs on a GPU are left out.\n"
    )


def main() -> None:
    """Write README.md; tests/test_results.py compares it."""
    (RESULTS / "README.md").write_text(readme(RESULTS), encoding="utf-8")


if __name__ == "__main__":
    main()
