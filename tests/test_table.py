"""Tables of a benchmark: means, deviations, intervals, what is missing; and the paper's numbers beside them."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import paper_tables
import pytest
from sb3_aarl.search.execution.matrix import Cell, cell_folder
from sb3_aarl.search.results import table
from sb3_aarl.search.studies.benchmark import read_variants
from sb3_aarl.search.training.provenance import ABOUT
from scipy import stats

from sb3_aarl.callbacks import Evaluation, write_curve
from sb3_aarl.envs import env_ids

# Of each table of the paper and number of steps: scores, the sum of their means and of their deviations, and runs of each.
PAPER = [
    (2, 500_000, 10, 8.189, 2.857, 15),
    (3, 100_000, 40, 15_495, 3_118, 10),
    (3, 500_000, 40, 26_194, 3_589, 10),
    (4, 100_000, 48, 28_670, 3_724, 10),
    (4, 1_000_000, 24, 5_526, 2_408, 10),
    (6, 100_000, 4, 3.276, 0.924, 30),
]
CHEETAH, WALKER, FISH = (f"dm_control/{task}-v0" for task in ("cheetah-run", "walker-walk", "fish-upright"))


@pytest.mark.parametrize(("number", "checkpoint", "n_scores", "means", "deviations", "runs"), PAPER)
def test_the_papers_scores(number: int, checkpoint: int, n_scores: int, means: float, deviations: float, runs: int) -> None:
    scores = paper_tables.paper_scores(number).query("checkpoint == @checkpoint")
    sums = scores["paper_mean"].sum(), scores["paper_std"].sum()
    assert (len(scores), *sums) == pytest.approx((n_scores, means, deviations))
    assert set(scores["paper_runs"]) == {runs} and set(scores["environment"]) <= {*env_ids(), "normalized"}
    files = (Path(__file__).parent.parent / "zoo_configs/paper").glob("*.yml")
    assert set(scores["variant"].dropna()) <= {variant.name for file in files for variant in read_variants(file)}


def plant(folder: Path, cell: Cell, curve: Mapping[int, float], checkpoints: Sequence[int] = (100_000,), **about: Any) -> Path:
    """A run as a benchmark leaves it."""
    path = cell_folder(folder, cell)
    path.mkdir(parents=True)
    if curve:
        write_curve(path / "curve.csv", [Evaluation(steps, mean, 1.0, 10, 2.0) for steps, mean in curve.items()])
    session = {"commit": "c0ffee"}
    values = {**cell._asdict(), "checkpoints": list(checkpoints), "sessions": [session], **about}
    (path / ABOUT).write_text(json.dumps(values))
    return path


def printed(folder: Path) -> str:
    """All that is shown of a benchmark, in one line with single spaces."""
    found = table.read_tables(folder)
    rows = [row for shown in table.text_tables(found).values() for row in shown.itertuples(index=False, name=None)]
    lines = table.missing(found.runs) + table.mixed(found.runs)
    return " ".join([*(f"│ {' │ '.join(row)} │".replace("│  │", "│ │") for row in rows), *lines])


def plant_scores(folder: Path, scores: Mapping[tuple[str, str], np.ndarray]) -> None:
    """Runs with these returns at 100k, one for each seed, by variant and environment."""
    for (variant, environment), of_seeds in scores.items():
        for seed, score in enumerate(of_seeds):
            plant(folder, Cell(variant, environment, seed), {100_000: float(score)})


def test_what_is_two_standard_errors_from_the_paper_is_marked(tmp_path: Path) -> None:
    # Ten runs each, around the paper's mean plus so many standard errors, by Welch's statistic as scipy has it.
    spread = np.array([-9.0, -7.0, -4.0, -3.0, -1.0, 0.0, 2.0, 5.0, 7.0, 10.0]) * 6
    paper = paper_tables.paper_scores(4).set_index(["checkpoint", "environment", "variant"]).loc[100_000]
    cells = {("aarl_state", CHEETAH): -2.01, ("sac_identity", CHEETAH): -1.99, ("sac_identity", WALKER): 2.01}
    scores = {}
    for (variant, environment), gap in cells.items():
        mean, std = paper.loc[(environment, variant), ["paper_mean", "paper_std"]]
        scores[f"{variant}_bf16", environment] = mean + gap * math.sqrt(spread.var(ddof=1) / 10 + std**2 / 10) + spread
    plant_scores(tmp_path, {**scores, ("mine", CHEETAH): spread})
    runs = table.read_runs(tmp_path)
    assert paper_tables.closest_table(runs["variant"]) == 4 and paper_tables.closest_table(["mine"]) is None
    result = paper_tables.beside(runs, 4).set_index(["variant", "environment"])
    assert set(result.index) == set(scores)
    for key, of_seeds in scores.items():
        row = result.loc[key]
        of_paper = row["paper_mean"], row["paper_std"], row["paper_runs"]
        welch = stats.ttest_ind_from_stats(of_seeds.mean(), of_seeds.std(ddof=1), 10, *of_paper, equal_var=False)
        assert row["difference"] / row["standard_error"] == pytest.approx(welch.statistic)
        assert row["mark"] == ("▲" if welch.statistic > 2 else "▼" if welch.statistic < -2 else "")


TASKS = [
    f"dm_control/{task}-v0" for task in ("acrobot-swingup", "fish-swim", "cheetah-run", "dog-run", "hopper-hop", "walker-run")
]


def planted_matrices() -> dict[str, np.ndarray]:
    """Scores (runs, tasks) of two variants, which rliable was given too."""
    runs, tasks = np.arange(10)[:, None], np.arange(6)[None]
    a = 100.0 * tasks + (37 * runs + 11 * tasks * runs) % 101
    b = 95.0 * tasks + (53 * runs + 7 * tasks * runs) % 89
    return {"a": a, "b": b[:8]}


@pytest.fixture
def planted(tmp_path: Path) -> pd.DataFrame:
    matrices = planted_matrices()
    plant_scores(tmp_path, {(name, task): matrices[name][:, i] for name in matrices for i, task in enumerate(TASKS)})
    return table.read_runs(tmp_path)


def test_interquartile_means_and_their_intervals_are_those_of_rliable(planted: pd.DataFrame) -> None:
    # rliable 1.2.0 with arch 7.2.0 and pandas 2.3.3: get_interval_estimates, aggregate_iqm, 20000 resamples. Two of its
    # seeds differ by up to 0.2.
    of_rliable = {"a": (294.76666667, 284.9, 304.33333333), "b": (279.04166667, 268.5, 288.91770833)}
    result = table.interquartile_means(planted).set_index("variant")
    for variant, (iqm, low, high) in of_rliable.items():
        row = result.loc[variant]
        assert row["iqm"] == pytest.approx(iqm) == pytest.approx(stats.trim_mean(planted_matrices()[variant].ravel(), 0.25))
        assert (row["low"], row["high"]) == pytest.approx((low, high), abs=0.5)
        n_runs = planted_matrices()[variant].size
        assert (row["tasks"], row["n_tasks"], row["planned"], row["runs"]) == ("DeepMind Control", 6, n_runs, n_runs)


def test_probabilities_of_improvement_are_those_of_rliable(planted: pd.DataFrame) -> None:
    # As above: probability_of_improvement, 5000 resamples; its seeds differ by 0.004.
    a, b = planted_matrices().values()
    u = [stats.mannwhitneyu(a[:, i], b[:, i], alternative="greater").statistic / 80 for i in range(6)]
    result = table.improvements(planted).set_index(["variant", "over"])
    assert result.loc[("a", "b"), "probability"] == pytest.approx(0.60625) == pytest.approx(np.mean(u))
    assert tuple(result.loc[("a", "b"), ["low", "high"]]) == pytest.approx((0.49583333, 0.715625), abs=0.01)
    assert tuple(result.loc[("b", "a"), ["probability", "n_tasks"]]) == pytest.approx((1 - 0.60625, 6))
    assert len(result) == 2


def test_statistics_are_over_tasks_of_one_scale_that_all_variants_have(tmp_path: Path) -> None:
    scores = {
        ("a", CHEETAH): np.array([1.0, 2.0]),
        ("b", CHEETAH): np.array([5.0, 9.0]),
        ("a", WALKER): np.array([999.0, 999.0]),  # the other one has none
        ("a", "Pendulum-v1"): np.array([-100.0, -200.0]),
        ("b", "Pendulum-v1"): np.array([-900.0, -100.0]),
    }
    plant_scores(tmp_path, scores)
    runs = table.read_runs(tmp_path)
    iqm = table.interquartile_means(runs).set_index(["tasks", "variant"])["iqm"]
    assert iqm.to_dict() == {
        ("cheetah-run", "a"): 1.5,
        ("cheetah-run", "b"): 7.0,
        ("Pendulum-v1", "a"): -150.0,
        ("Pendulum-v1", "b"): -500.0,
    }
    better = table.improvements(runs).set_index(["variant", "over"])
    assert better.loc[("a", "b"), "probability"] == pytest.approx(np.mean([0.0, (0.5 + 1 + 0 + 1) / 4]))
    assert better.loc[("a", "b"), "n_tasks"] == 2


def test_each_probability_is_over_the_tasks_of_its_two_variants(tmp_path: Path) -> None:
    scores = {
        ("a", CHEETAH): np.array([1.0, 2.0]),
        ("b", CHEETAH): np.array([0.0, 9.0]),
        ("a", WALKER): np.array([5.0, 6.0]),
        ("b", WALKER): np.array([7.0, 8.0]),
        ("c", WALKER): np.array([5.5, 5.5]),
        ("d", "Pendulum-v1"): np.array([-5.0]),  # with no task in common
    }
    plant_scores(tmp_path, scores)
    better = table.improvements(table.read_runs(tmp_path)).set_index(["variant", "over"])
    assert better["probability"].to_dict() == {
        ("a", "b"): pytest.approx(0.25),
        ("b", "a"): pytest.approx(0.75),
        ("a", "c"): pytest.approx(0.5),
        ("c", "a"): pytest.approx(0.5),
        ("b", "c"): 1.0,
        ("c", "b"): 0.0,
    }
    assert better["n_tasks"].to_dict() == {pair: 2 if "c" not in pair else 1 for pair in better.index}


def test_what_differs_between_runs_is_counted(tmp_path: Path) -> None:
    sessions = [{"commit": "c0ffee", "versions": "torch 2.12"}, {"commit": "c0ffee", "versions": "torch 2.13"}]
    for seed in range(3):
        plant(tmp_path, Cell("a", CHEETAH, seed), {100_000: 1.0}, sessions=sessions[:1], evaluation_episodes=10)
    plant(tmp_path, Cell("b", CHEETAH, 0), {}, sessions=[], evaluation_episodes=10)
    assert table.mixed(table.read_runs(tmp_path)) == []
    plant(tmp_path, Cell("c", CHEETAH, 0), {100_000: 1.0}, sessions=sessions, evaluation_episodes=3, program="mine.py")
    assert table.mixed(table.read_runs(tmp_path)) == [
        "Runs with different versions: torch 2.12 (3); torch 2.12, torch 2.13 (1)",
        "Runs with different programs: aarl benchmark (4); mine.py (1)",
        "Runs with different numbers of episodes: 10 (4); 3 (1)",
    ]


def test_every_task_weighs_the_same_in_an_interquartile_mean(tmp_path: Path) -> None:
    """Seeds that a variant has not on all tasks are left out, as rliable's matrix of runs and tasks has no gaps."""
    rng = np.random.default_rng(0)
    high, low = rng.normal(870.0, 5.0, 10), rng.normal(25.0, 5.0, 10)
    scores = {("all", CHEETAH): high, ("all", WALKER): low, ("some", CHEETAH): high, ("some", WALKER): low[:3]}
    plant_scores(tmp_path, {**scores, ("none", CHEETAH): high[:2]})
    plant(tmp_path, Cell("none", WALKER, 5), {100_000: 1.0})  # of another seed
    rows = table.interquartile_means(table.read_runs(tmp_path)).set_index("variant")
    matrices = {"all": [high, low], "some": [high[:3], low[:3]]}
    for variant, matrix in matrices.items():
        assert rows.loc[variant, "iqm"] == pytest.approx(stats.trim_mean(np.concatenate(matrix), 0.25))
        assert rows.loc[variant, "low"] < rows.loc[variant, "iqm"] < rows.loc[variant, "high"]
    assert rows["runs"].to_dict() == {"all": 20, "some": 6, "none": 0}
    assert rows["planned"].to_dict() == {"all": 20, "some": 13, "none": 3}
    assert rows.loc["none", ["iqm", "low", "high"]].isna().all()
    assert "│ none │ - │ - │ 0/3 │" in printed(tmp_path)


def test_many_variants_go_down_the_rows(tmp_path: Path) -> None:
    scores = {(f"variant {i}", task): np.array([i, i + 1.0]) for i in range(table.MANY + 1) for task in (CHEETAH, WALKER)}
    plant_scores(tmp_path, scores)
    shown = printed(tmp_path)
    assert all(f"│ variant {i} │ {i} ± 1 │ {i} ± 1 │" in shown for i in range(0, table.MANY + 1, 2))
    best = table.MANY  # of all pairs those with it
    assert all(f"│ variant {i} │ {0.12 if i == best - 1 else 0:.2f} [" in shown for i in range(best))
    assert f"│ variant {best} │ 0." not in shown


def test_on_one_task_pairs_have_the_p_of_mann_and_whitney(tmp_path: Path) -> None:
    plant_scores(tmp_path, {("mine", CHEETAH): np.array([3.0, 5.0, 9.0]), ("other", CHEETAH): np.array([1.0, 2.0, 4.0])})
    # Of the 20 ways to share six ranks among three and three, 4 give eight pairs of nine or more to one side.
    assert list(table.improvements(table.read_runs(tmp_path))["p"]) == pytest.approx([4 / 20] * 2)
    assert "│ mine │ │ 0.89 [0.56, 1.00] p 0.2 │" in printed(tmp_path)


def test_one_run_has_neither_deviation_nor_interval_nor_mark(tmp_path: Path) -> None:
    plant_scores(tmp_path, {("aarl_state", CHEETAH): np.array([1.0]), ("sac_identity", CHEETAH): np.array([999.0])})
    runs = table.read_runs(tmp_path)
    assert list(paper_tables.beside(runs, 4)["mark"]) == ["", ""]
    assert table.interquartile_means(runs)[["low", "high"]].isna().all(axis=None)
    assert "│ cheetah-run │ 1 │ 999 │" in printed(tmp_path)


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        # Mean of both -600, -200: each divided by that, its sign kept. Sample deviations of two numbers.
        ({"a": [-300.0, -100.0], "b": [-900.0, -300.0]}, {"a": (-0.5, 0.0), "b": (-1.5, 0.0)}),
        # 200 and -600: a is 0.5 and -0.5, b 1.5 and -1.5.
        ({"a": [100.0, -300.0], "b": [300.0, -900.0]}, {"a": (0.0, 0.5 * 2**0.5), "b": (0.0, 1.5 * 2**0.5)}),
        ({"a": [100.0, 30.0], "b": [300.0, 90.0]}, {"b": (1.0, 0.0), "a": (1 / 3, 0.0)}),
        ({"a": [0.0, 0.0], "b": [0.0, 0.0]}, {"a": (0.0, 0.0), "b": (0.0, 0.0)}),
    ],
    ids=["negative", "both signs", "positive", "zero"],
)
def test_normalized_returns(returns: dict[str, list[float]], expected: dict[str, tuple[float, float]]) -> None:
    rows = [(variant, task, last) for variant, values in returns.items() for task, last in zip("xy", values, strict=True)]
    result = paper_tables.normalized(pd.DataFrame(rows, columns=["variant", "environment", "mean"]))
    for variant, numbers in expected.items():
        assert tuple(result.loc[variant]) == pytest.approx(numbers)


def test_table_6_is_normalized_by_the_papers_variants(tmp_path: Path) -> None:
    returns = {
        "aarl_state": {CHEETAH: [400.0, 480.0], WALKER: [900.0, 910.0]},
        "aarl_mlp_1": {CHEETAH: [390.0, 410.0], WALKER: [700.0, 850.0]},
        "aarl_dense_mlp_4": {CHEETAH: [390.0, 400.0], WALKER: [650.0, 800.0]},
        "aarl_mlp_4": {CHEETAH: [100.0, 150.0], WALKER: [300.0]},  # a run is missing
    }
    plant_scores(tmp_path, {(v, e): np.array(scores) for v, of in returns.items() for e, scores in of.items()})
    missing = plant(tmp_path, Cell("aarl_mlp_4", WALKER, 1), {})
    assert paper_tables.beside(table.read_runs(tmp_path), 6).empty
    write_curve(missing / "curve.csv", [Evaluation(100_000, 310.0, 1.0, 10, 2.0)])
    result = paper_tables.beside(table.read_runs(tmp_path), 6).set_index("variant")
    assert list(result["paper_runs"]) == [30] * 4 and result.loc["aarl_state", "mean"] == 1.0 == result["mean"].max()
    plant(tmp_path, Cell("mine", CHEETAH, 0), {100_000: 900.0}, sessions=[])
    assert len(paper_tables.beside(table.read_runs(tmp_path), 6)) == 4  # not complete: it normalizes nothing
    for cell in (Cell("mine", CHEETAH, 1), Cell("mine", WALKER, 0), Cell("mine", WALKER, 1)):
        plant(tmp_path, cell, {100_000: 900.0})
    assert paper_tables.beside(table.read_runs(tmp_path), 6).empty


def test_what_is_missing_is_counted_and_named(tmp_path: Path) -> None:
    steps = (100_000, 500_000)
    for seed in range(3):
        plant(tmp_path, Cell("aarl_state", CHEETAH, seed), {100_000: 470.0 + seed, 500_000: 800.0 + seed}, steps)
        plant(tmp_path, Cell("sac_identity", CHEETAH, seed), {100_000: 200.0 + seed, 500_000: 300.0 + seed}, steps)
    failed = plant(tmp_path, Cell("aarl_state", CHEETAH, 3), {}, steps)
    (failed / "failed.json").write_text('{"reason": "ExplodedError: it burst", "retry": false}')
    plant(tmp_path, Cell("aarl_state", CHEETAH, 4), {100_000: 480.0}, steps)
    for seed in (5, 6):
        plant(tmp_path, Cell("aarl_state", CHEETAH, seed), {}, steps, sessions=[])
    plant(tmp_path, Cell("mine", CHEETAH, 0), {}, steps, sessions=[{"commit": "c0ffee"}, {"commit": "beef"}])
    found = table.read_tables(tmp_path)
    runs, comparison, iqm, _ = found
    row = comparison.set_index(["checkpoint", "variant"]).loc[(100_000, "aarl_state")]
    assert (row["planned"], row["runs"], row["mean"]) == (7, 4, np.mean([470, 471, 472, 480]))
    lines = table.missing(runs)
    assert lines == [
        "Missing at 100,000: aarl_state on cheetah-run, seed 3: ExplodedError: it burst",
        "Missing at 100,000: aarl_state on cheetah-run, seeds 5, 6: not started",
        "Missing at 100,000: mine on cheetah-run, seed 0: unfinished, evaluated up to 0",
        "Missing at 500,000: aarl_state on cheetah-run, seed 3: ExplodedError: it burst",
        "Missing at 500,000: aarl_state on cheetah-run, seed 4: unfinished, evaluated up to 100,000",
        "Missing at 500,000: aarl_state on cheetah-run, seeds 5, 6: not started",
        "Missing at 500,000: mine on cheetah-run, seed 0: unfinished, evaluated up to 0",
    ]
    early = iqm.set_index(["checkpoint", "variant"]).loc[100_000]
    assert list(early.index) == ["aarl_state", "sac_identity"]  # a variant without any run hides no others
    assert tuple(early.loc["aarl_state", ["planned", "runs"]]) == (7, 4)
    shown = printed(tmp_path)
    assert "473 ± 5 (4/7)" in shown and "│ 4/7 │" in shown
    assert "Runs with different commits: c0ffee (8); c0ffee, beef (1)" in shown


def test_a_folder_without_runs_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no runs of a benchmark"):
        table.read_tables(tmp_path)
