"""Both README.md agree with the runs in results/, and each run can be repeated with the command printed there."""

import inspect
import itertools
import math
import re
import runpy
import shlex
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.execution.matrix import stored_scores
from sb3_aarl.search.execution.storage import load_study, open_storage
from sb3_aarl.search.results.analysis import analysed, trial_table
from sb3_aarl.search.results.report import stored_baselines
from sb3_aarl.search.results.statistics import interquartile_means
from sb3_aarl.search.results.table import paper_scores, read_runs
from sb3_aarl.search.studies import benchmark
from sb3_aarl.search.studies.benchmark import load_benchmark, read_experiment
from sb3_aarl.search.studies.cross_validation import ranking
from scipy.stats import mannwhitneyu
from typer.testing import CliRunner

from sb3_aarl import SACAux
from sb3_aarl.callbacks import read_curve
from sb3_aarl.catalog import resolve

RESULTS = Path(__file__).parent.parent / "results"
make_readme: dict[str, Any] = runpy.run_path(str(RESULTS / "make_readme.py"))
SESSION = {"commit": "c0ffee", "cpu": "a processor", "gpu": "none", "date": "2026-11-21T12:00:00", "threads": 2}
TASKS = ("cheetah-run", "walker-walk")
SCORE = "{mean:.0f} ± {std:.0f}"


@pytest.fixture(autouse=True)
def in_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands name files of the repository."""
    monkeypatch.chdir(RESULTS.parent)


def abouts_of(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, Any]]:
    """The ``provenance.json`` of the runs that a printed command would train."""
    matrices = []

    def load(*arguments: Any) -> None:
        matrices.append(load_benchmark(*arguments))
        raise ValueError("nothing is trained here")

    monkeypatch.setattr(benchmark, "load_benchmark", load)
    program, *words = shlex.split(command)
    result = CliRunner().invoke(app, [*words, "--folder", str(folder)])
    assert program == "aarl" and "nothing is trained here" in result.output
    (matrix,) = matrices
    return list(matrix.abouts.values())


def commands(text: str) -> list[str]:
    return [line for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]


def test_the_papers_scores_stand_beside_variants_of_other_names() -> None:
    matrix = load_benchmark([Path("zoo_configs/paper/aarl_state.yml")], ["cheetah-run"], [0], [100_000])
    (about,) = matrix.abouts.values()
    line, reference = make_readme["paper"]([{**about, "variant": "other"}])
    assert "cheetah-run at 100,000, 10 runs: AARL-State 472 ± 30" in line
    assert "not ours" in reference and "AARL-State 436" in reference
    assert list(make_readme["paper"]([about])) == [reference]  # the paper's are in the table


@pytest.mark.parametrize(
    ("checkpoints", "every"),
    [([100_000], 20_000), ([100_000], 30_000), ([20_000, 100_000], 20_000), ([40_000, 100_000], None)],
)
def test_commands_have_the_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checkpoints: list[int], every: int | None
) -> None:
    matrix = load_benchmark([Path("zoo_configs/paper/aarl_state.yml")], ["cheetah-run"], [0, 2], checkpoints, every)
    abouts = list(matrix.abouts.values())
    (command,) = make_readme["commands"]([{**about, "sessions": [SESSION]} for about in abouts])
    assert "--seeds 0,2" in command and ("--every" in command) is (every is not None)
    assert abouts_of(command, tmp_path, monkeypatch) == abouts


def test_mean_of_the_best_of_some_scores() -> None:
    scores = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0]
    best = [max(drawn) for drawn in itertools.combinations(scores, 3)]
    assert make_readme["mean_of_best"](scores, 3) == pytest.approx(statistics.mean(best))


def test_a_search_found_what_its_text_says() -> None:
    """results/search/cheetah_run_simba/about.md is right about its study."""
    study_folder = RESULTS / "search" / "cheetah_run_simba"
    trials = analysed(trial_table(load_study(open_storage(study_folder, create=False)).get_trials(deepcopy=False)))
    evolved = trials[trials["operation"].isin(make_readme["EVOLVED"])]["score"]
    random, given = (trials[trials["operation"] == operation]["score"] for operation in ("random", "given"))
    assert mannwhitneyu(evolved, random, alternative="greater").pvalue < 1e-6
    assert evolved.mean() < given.mean() and evolved.max() < given.max()
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
    shown = [make_readme["summary"](scores.tolist()).partition(" (")[0] for scores in (evolved, random, given)]
    assert f"{len(trials)} candidates" in readme and f"The best, {given.max():.0f}, is one of the given." in readme
    text = "Means with their standard errors: evolved losses score {}, random ones {}, the given ones, {}, {};"
    assert text.format(*shown[:2], "which people or the paper's search chose", shown[2]) in readme
    baselines = dict(stored_baselines(study_folder))
    assert f"AARL-State {baselines['AARL-State']:.0f}, no loss {baselines['No auxiliary loss']:.0f}." in readme
    first, second, *later = trials.groupby("generation")["score"].mean()
    assert first < second and max(later) < second + 5
    # What is confirmed is what the cross-validation ranks first, and the best evolved loss, its second.
    ranked = ranking(stored_scores(study_folder / "cross-validation"))["mean"]
    variants = read_experiment(RESULTS / "search/confirmation/variants.yml").variants
    assert [str(resolve(variants[f"{name}_simba"]["aux_loss"])) for name in ("published", "evolved")] == list(ranked.index[:2])
    text = "`{}`, is first with {:.0f}, the best evolved one second with {:.0f}, means of both tasks"
    assert text.format(ranked.index[0], *ranked[:2]) in readme
    losses = ("published", "evolved", "aarl", "forward", "sac")
    rows = {"Cheetah-Run": [last_returns(f"{name}_simba", folder="search/confirmation") for name in losses]}
    rows["Cheetah-Run, float32"] = [last_returns(f"{name}_simba_fp32", folder="search/confirmation_fp32") for name in losses]
    float32 = {"walker-walk": ("published", "sac"), "reacher-hard": ("published", "aarl", "sac")}
    for task, names in float32.items():
        folders = [f"{name}_simba{'_fp32' * (name in names)}" for name in losses]
        rows[task.title()] = [last_returns(name, task, "search/confirmation_fp32") for name in folders]
    rows["Cheetah-Run, the paper's encoder"] = [
        last_returns(f"{name}_dense_mlp_fp32", folder="search/confirmation_dense_mlp") for name in losses
    ]
    whole_size = [last_returns(name, folder="paper/full_size") for name in ("published_state", "aarl_state_bf16")]
    assert min(map(min, whole_size)) > papers("AARL-State")["mean"]
    rows["Cheetah-Run, the paper's encoder and size"] = [whole_size[0], [], whole_size[1], [], []]
    for name, row in rows.items():
        assert f"| {name} | {' | '.join(map(with_seeds, row))} |" in readme
    confirmed, again, *others = rows.values()
    published, best_evolved, _, forward, none = (mannwhitneyu(confirmed[2], found).pvalue for found in confirmed)
    assert min(published, best_evolved) > 0.05 > max(forward, none)
    assert all(are_close(*pair) for pair in zip(confirmed, again, strict=True) if pair[1])
    assert min(mannwhitneyu(again[2], row).pvalue for row in again[:2]) > 0.05
    assert max(mannwhitneyu(again[4], row).pvalue for row in again[:3]) < 0.05
    for row in others:
        assert all(are_close(*pair) for pair in itertools.combinations(filter(None, (*row[:3], row[4])), 2))
    assert statistics.mean(rows["Walker-Walk"][3]) > statistics.mean(rows["Walker-Walk"][0])
    assert not are_close(rows["Walker-Walk"][3], rows["Walker-Walk"][0])


def last_returns(variant: str, task: str = "cheetah-run", folder: str = "paper/small") -> list[float]:
    """Returns of the last evaluations, one for each seed."""
    curves = sorted((RESULTS / folder / "runs" / variant / task).glob("seed-*/curve.csv"))
    for other in ("agent/tasks", "agent/parts"):  # where runs are that several experiments show
        curves = curves or sorted((RESULTS / other / "runs" / variant / task).glob("seed-*/curve.csv"))
    return [read_curve(curve)[-1].mean for curve in curves]


def shown(returns: list[float]) -> str:
    return f"{statistics.mean(returns):.0f} ± {statistics.stdev(returns):.0f}"


def with_seeds(returns: list[float]) -> str:
    """A cell of the first README's table: mean, deviation and number of seeds."""
    if not returns:
        return "-"
    deviation = f" ± {statistics.stdev(returns):,.0f}" if len(returns) > 1 else ""
    return f"{statistics.mean(returns):,.0f}{deviation} ({len(returns)})"


def are_close(one: list[float], other: list[float]) -> bool:
    """Whether two means are less than two standard errors of their difference apart."""
    error = math.sqrt(sum(statistics.variance(runs) / len(runs) for runs in (one, other)))
    return abs(statistics.mean(one) - statistics.mean(other)) < 2 * error


def papers(column: str, task: str = "cheetah-run", table: int = 4) -> dict[str, float]:
    """A score of the paper at 100,000 steps."""
    scores = paper_scores(table).query(f"checkpoint == 100_000 and environment == 'dm_control/{task}-v0'")
    return scores.set_index("column").loc[column].to_dict()


@pytest.mark.parametrize("task", TASKS)
def test_decisions_by_runs_of_aarl_state(task: str) -> None:
    """results/choices_small/about.md is right about the runs beside it."""
    choices = ("", "_separate", "_joint", "_predictor", "_bf16")
    runs = [last_returns(f"aarl_state_small{choice}", task) for choice in choices]
    default, separate, joint, predictor, bf16 = runs
    assert min(map(len, runs)) >= 3
    assert max(joint) < min(default + separate + predictor)
    assert are_close(default, bf16) and statistics.stdev(bf16) > statistics.stdev(default)
    for other in (separate, predictor):
        assert statistics.mean(other) < statistics.mean(default) and statistics.stdev(other) > statistics.stdev(default)
    curl, sac, identity = (last_returns(f"{name}_small", task) for name in ("curl_state", "sac_dense_mlp", "sac_identity"))
    assert max(curl + sac + identity) < min(default)
    assert are_close(curl, sac) is (task == "walker-walk")
    if task == "walker-walk":
        assert max(separate) < min(default) and min(bf16) < 0.75 * min(default)
    else:
        assert max(curl + sac + identity) < min(map(min, runs)) and statistics.mean(curl) < statistics.mean(sac)


def test_the_distance_from_the_paper_on_walker_walk_is_that_of_the_action_repeat() -> None:
    def returns(*changes: str, of: tuple[str, ...] = ("sac_identity", "sac_dense_mlp")) -> list[float]:
        return [value for name in of for change in changes for value in last_returns(f"{name}_small{change}", "walker-walk")]

    repeat_2 = ("_repeat_2", "_orthogonal_squashed_repeat_2")
    assert max(returns("")) < min(returns("_repeat_2"))
    identity, started = (returns(change, of=("sac_identity",)) for change in repeat_2)
    assert statistics.mean(started) <= statistics.mean(identity)
    assert sum(value < max(returns("_orthogonal", "_orthogonal_squashed")) for value in returns(repeat_2[1])) == 1
    assert are_close(returns(*repeat_2), returns(*repeat_2, of=("aarl_state",)))
    assert are_close(returns(*repeat_2, of=("aarl_state",)), returns("", "_orthogonal", of=("aarl_state",)))


def test_the_distance_from_the_paper_on_cheetah_run_is_that_of_orthogonal_layers_and_squashed_deviation() -> None:
    paper = papers("SAC-Identity")

    def distance(choice: str) -> float:
        """In standard errors of the difference."""
        runs = last_returns(f"sac_identity_small{choice}")
        assert len(runs) == 5
        error = math.sqrt(statistics.variance(runs) / len(runs) + paper["std"] ** 2 / paper["runs"])
        return (paper["mean"] - statistics.mean(runs)) / error

    assert distance("") > distance("_orthogonal") > 2 > distance("_orthogonal_squashed")


def test_decisions_by_runs_with_orthogonal_layers() -> None:
    identity, orthogonal, squashed = (
        [last_returns(f"sac_identity_small{choice}", task) for task in TASKS]
        for choice in ("", "_orthogonal", "_orthogonal_squashed")
    )
    assert max(statistics.stdev(runs[0]) for runs in (orthogonal, squashed)) < statistics.stdev(identity[0])
    aarl, aarl_orthogonal = (
        [last_returns(f"aarl_state_small{choice}", task) for task in TASKS] for choice in ("", "_orthogonal")
    )
    assert max(identity[1]) < min(orthogonal[1]) and max(orthogonal[1]) < min(aarl[1])
    assert sum(run > max(identity[1]) for run in squashed[1]) == 1
    assert max(aarl[1]) < min(aarl_orthogonal[1]) and max(aarl_orthogonal[0]) <= max(aarl[0])
    dense, dense_orthogonal = (last_returns(f"sac_dense_mlp_small{choice}", "walker-walk") for choice in ("", "_orthogonal"))
    assert statistics.mean(dense_orthogonal) < statistics.mean(dense)


def test_defaults_are_what_was_decided() -> None:
    arguments = inspect.signature(SACAux).parameters
    policy = inspect.signature(SACAux.policy_aliases["MlpPolicy"]).parameters
    assert arguments["precision"].default == "fp32"
    assert arguments["joint_optimizer"].default is False and policy["share_features_extractor"].default is True
    assert (arguments["predictor_width"].default, arguments["predictor_batch_norm"].default) == (256, False)


def test_figures_of_the_first_readme() -> None:
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())

    def by_task(variant: str, folder: str = "agent/tasks") -> dict[str, list[float]]:
        return {
            path.name: last_returns(variant, path.name, folder) for path in (RESULTS / folder / "runs" / variant).iterdir()
        }

    sac = by_task("sac_states") | by_task("sac_starts_5000")
    forward = by_task("forward_simba")
    means = [statistics.mean(returns["cheetah-run"]) for returns in (forward, sac)]
    assert "its return is {:.0f} where SAC's is {:.0f}.".format(*means) in readme
    for task, returns in forward.items():
        name = task if task.endswith("-v5") else task.title()
        assert f"| {name} | {with_seeds(sac.get(task, []))} | {with_seeds(returns)} |" in readme
    for row, names in (
        ("the paper's encoder", ("dense_mlp_alone", "aarl_dense_mlp", "forward_dense_mlp")),
        ("`simba`", ("sac_simba", "aarl_simba", "forward_simba")),
    ):
        means = [f"{statistics.mean(last_returns(name, folder='agent/parts')):.0f}" for name in names]
        assert " | ".join([row, *means]) in readme
    iqm = (
        interquartile_means(read_runs(RESULTS / "agent/tasks/runs").query("environment == 'dm_control/cheetah-run-v0'"))
        .set_index("variant")
        .loc["forward_simba"]
    )
    assert f"interquartile mean is {iqm['iqm']:.0f}, 95 % interval {iqm['low']:.0f} to {iqm['high']:.0f}" in readme
    for text, task in (
        ("AARL-State gets {} on Cheetah-Run, SAC with the same encoder {}", "cheetah-run"),
        ("on Walker-Walk {} and {}", "walker-walk"),
    ):
        aarl, sac_dense = (shown(last_returns(f"{variant}_small", task)) for variant in ("aarl_state", "sac_dense_mlp"))
        assert text.format(aarl, sac_dense) in readme
    aarl, paper = shown(last_returns("aarl_state_bf16", folder="paper/full_size")), SCORE.format(**papers("AARL-State"))
    assert f"AARL-State gets {aarl} on Cheetah-Run, where the paper has {paper}." in readme
    for row, choice in (
        ("as SB3 starts, action repeat 4", ""),
        ("layers start orthogonal", "_orthogonal"),
        ("and the deviation is squashed", "_orthogonal_squashed"),
        ("action repeat 2 alone", "_repeat_2"),
        ("all three", "_orthogonal_squashed_repeat_2"),
    ):
        sizes = ((f"sac_identity_small{choice}", "paper/small"), (f"sac_identity{choice}_bf16", "paper/full_size"))
        cells = [with_seeds(last_returns(variant, task, folder)) for task in TASKS for variant, folder in sizes]
        assert " | ".join([f"| {row}", *cells]) + " |" in readme
    cheetah, walker = (f"{SCORE.format(**papers('SAC-Identity', task))} | " * 2 for task in TASKS)
    assert f"| the paper (10) | {cheetah}{walker}".strip() in readme
    fp32, both, none = (
        last_returns(f"sac_identity{x}", folder="paper/full_size") for x in ("", "_orthogonal_squashed_bf16", "_bf16")
    )
    assert min(fp32) > max(both) and min(both) > max(none)
    assert f"| and in float32 | - | {with_seeds(fp32)} | - | - |" in readme


def test_from_pixels() -> None:
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())

    def curve(variant: str) -> dict[int, float]:
        points = read_curve(
            RESULTS / "pixels/cheetah_run/runs" / f"{variant}_pixel_128_bf16" / "cheetah-run" / "seed-0" / "curve.csv"
        )
        return {point.environment_steps: point.mean for point in points}

    aarl, curl, sac = (curve(variant) for variant in ("aarl", "curl", "sac"))
    returns = (returns[60_000] for returns in (aarl, curl, sac))
    assert "AARL-Pixel {:.0f}, CURL {:.0f}, SAC with random crops {:.0f};".format(*returns) in readme
    assert all(aarl[steps] > curl[steps] for steps in aarl if steps >= 40_000)
    assert max(aarl[20_000], curl[20_000]) < 14 < sac[20_000]
    paper = (SCORE.format(**papers(column, table=3)) for column in ("AARL-Pixel", "CURL"))
    assert "the paper has {} and {} for the first two after 100,000".format(*paper) in readme
