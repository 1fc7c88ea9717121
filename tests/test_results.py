"""The tables are those of the runs in results/, the texts are right about them, and the commands there work."""

import itertools
import re
import runpy
import shlex
import statistics
from pathlib import Path
from typing import Any

import pytest
from paper_tables import paper_scores
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.execution.matrix import stored_scores
from sb3_aarl.search.execution.storage import load_study, open_storage
from sb3_aarl.search.results.analysis import analysed, trial_table
from sb3_aarl.search.results.report import stored_baselines
from sb3_aarl.search.studies import benchmark
from sb3_aarl.search.studies.benchmark import load_benchmark
from scipy.stats import mannwhitneyu
from typer.testing import CliRunner

from sb3_aarl.callbacks import Evaluation, read_curve, write_curve
from sb3_aarl.catalog import resolve
from sb3_aarl.files import read_yaml

RESULTS = Path(__file__).parent.parent / "results"
ABOUTS = sorted(RESULTS.glob("*/*/about.md"))
README = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
make_tables: dict[str, Any] = runpy.run_path(str(RESULTS / "make_tables.py"))
TASKS = ("cheetah-run", "walker-walk")
# Means at 100,000 environment steps of SAC (in CrossQ's code) and DR.Q.
PUBLISHED = {
    task: (sac, dr_q) for task, ((_, dr_q), sac) in runpy.run_path(str(RESULTS / "make_picture.py"))["PUBLISHED"].items()
}


def returns(variant: str, task: str = "cheetah-run") -> list[float]:
    """Returns of the last evaluations of GROUP/NAME/VARIANT, one for each seed."""
    folder, _, name = variant.rpartition("/")
    return [read_curve(path)[-1].mean for path in sorted((RESULTS / folder / "runs" / name / task).glob("seed-*/curve.csv"))]


def shown(values: list[float]) -> str:
    return f"{statistics.mean(values):.0f} ± {statistics.stdev(values):.0f}"


@pytest.mark.slow
def test_every_table_is_that_of_the_runs() -> None:
    for path, text in make_tables["texts"]().items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run python results/make_tables.py"


def test_a_cell_is_mean_deviation_and_number_of_the_last_returns(tmp_path: Path) -> None:
    for seed, last in enumerate((1000.0, 2000.0, 3000.0)):
        (tmp_path / f"seed-{seed}").mkdir()
        write_curve(
            tmp_path / f"seed-{seed}" / "curve.csv", [Evaluation(step, step * last, 1.0, 1, 1.0) for step in (2, 1)][::-1]
        )
    assert make_tables["returns"](tmp_path) == "4,000 ± 2,000 (3)"


def test_mean_of_the_best_of_some_scores() -> None:
    scores = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0]
    best = [max(drawn) for drawn in itertools.combinations(scores, 3)]
    assert make_tables["mean_of_best"](scores, 3) == pytest.approx(statistics.mean(best))


@pytest.mark.parametrize("path", ABOUTS, ids=lambda path: path.parent.name)
def test_an_experiment_can_be_read_and_repeated(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(RESULTS.parent)
    text = path.read_text(encoding="utf-8")
    assert [text.count(f"\n**{part}.** ") for part in ("Question", "Answer", "Unsure")] == [1, 1, 1]
    assert all((path.parent / link).exists() for link in re.findall(r"\]\(([^)#:]+)\)", text))
    matrices = []

    def load(*arguments: Any) -> None:
        matrices.append(load_benchmark(*arguments))
        raise ValueError("nothing is trained here")

    monkeypatch.setattr(benchmark, "load_benchmark", load)
    commands = re.findall(r"^    aarl (benchmark .*)", text, re.MULTILINE)
    for command in commands:
        result = CliRunner().invoke(app, [*shlex.split(command), "--folder", str(tmp_path)])
        assert "nothing is trained here" in result.output
    trained = {(cell.variant, cell.environment) for matrix in matrices for cell in matrix.runs}
    assert len(matrices) == len(commands) and (trained or "aarl search" in text or "probe.py" in text)


def test_the_overview_is_short() -> None:
    text = (RESULTS / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150 and all(path.relative_to(RESULTS).as_posix() in text for path in ABOUTS)


def test_figures_in_the_text_of_the_first_readme() -> None:
    by_hand = re.sub(rf"<!-- {make_tables['SOURCE']}: \w+ -->.*?<!-- end -->|```.*?```|<img.*?>", "", README)
    assert {*re.findall(r"(?<![\w.])\d{2,}[\d,]*\b(?!\.)", by_hand)} == {"100,000", "2022"}, (
        "numbers of runs come from a script"
    )
    ours = {task: returns("agent/proof/sac_aux", task) for task in PUBLISHED}
    medians = [
        statistics.median(statistics.mean(ours[task]) / PUBLISHED[task][i] for task in PUBLISHED if ours[task]) for i in (0, 1)
    ]
    figures = [f"{medians[1]:.2f} of the return of DR.Q", f"{medians[0]:.1f} times that of SAC"]
    names = ("paper/small/aarl_state_small", "paper/small/sac_dense_mlp_small")
    figures += [shown(returns(name, task)) for name in names for task in TASKS]
    figures += [shown(returns("paper/full_size/aarl_state_bf16"))]
    for number, columns in ((3, ("AARL-Pixel", "CURL")), (4, ("AARL-State",))):
        scores = paper_scores(number).query("checkpoint == 100_000 and environment == 'dm_control/cheetah-run-v0'")
        figures += [f"{row.paper_mean:.0f} ± {row.paper_std:.0f}" for row in scores.itertuples() if row.column in columns]
    for name in ("AARL-Pixel", "CURL"):
        runs = RESULTS / "pixels/cheetah_run/runs" / f"{name.lower().replace('-', '_').replace('curl', 'curl_pixel')}_128_bf16"
        curve = {point.environment_steps: point.mean for point in read_curve(runs / "cheetah-run/seed-0/curve.csv")}
        figures.append(f"{name} {curve[60_000]:.0f}")
    assert [figure for figure in figures if figure not in README] == []


def test_a_search_found_what_its_texts_say() -> None:
    folder = RESULTS / "search/cheetah_run_simba"
    trials = analysed(trial_table(load_study(open_storage(folder, create=False)).get_trials(deepcopy=False)))
    evolved = trials[trials["operation"].isin(make_tables["EVOLVED"])]["score"]
    random, given = (trials[trials["operation"] == operation]["score"] for operation in ("random", "given"))
    assert mannwhitneyu(evolved, random, alternative="greater").pvalue < 1e-6
    assert evolved.mean() < given.mean() and evolved.max() < given.max()
    first, second, *later = trials.groupby("generation")["score"].mean()
    assert first < second and max(later) < second + 5
    baselines = dict(stored_baselines(folder))
    figures = [make_tables["scores_text"](scores.tolist()).partition(" (")[0] for scores in (evolved, random, given)]
    figures += [f"{len(trials)} candidates", f"{given.max():.0f}", f"AARL-State {baselines['AARL-State']:.0f}"]
    # What is confirmed is what the cross-validation ranks first, and the best evolved loss, its second.
    ranked = make_tables["mean_scores"](stored_scores(folder / "cross-validation"))["mean"]
    variants = read_yaml(RESULTS / "search/confirmation/variants.yml")["variants"]
    assert [str(resolve(variants[f"{name}_simba"]["aux_loss"])) for name in ("published", "evolved")] == list(ranked.index[:2])
    figures += [f"{score:.0f}" for score in ranked[:2]]
    assert [figure for figure in figures if figure not in README] == []
