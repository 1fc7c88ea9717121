"""aarl analyze and aarl figures: from planted studies and runs, as a user calls them."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import optuna
import pytest
import scipy.stats
from optuna.trial import TrialState, create_trial
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.evolution.space import distributions, loss_to_params, random_loss
from sb3_aarl.search.execution.matrix import Cell, cell_folder
from sb3_aarl.search.execution.storage import load_study, open_storage
from sb3_aarl.search.studies.benchmark import read_curves
from sb3_aarl.search.training.provenance import write_about
from sb3_aarl.search.training.run import prepare_run
from tiny import tiny_run
from typer.testing import CliRunner

from sb3_aarl.callbacks import Evaluation, write_curve

runner = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"})

pytestmark = pytest.mark.slow


def run(*arguments: object, fails: bool = False) -> str:
    result = runner.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == (2 if fails else 0), result.stderr
    return result.stderr if fails else result.stdout


def plant(folder: Path, name: str, seed: int, n_candidates: int, url: str | None = None) -> None:
    """Candidates, better with s_t in the source, and a failed one; and two baselines."""
    rng = np.random.default_rng(seed)
    study = optuna.create_study(study_name=name, storage=open_storage(folder, url), direction="maximize")
    trials = []
    for i in range(n_candidates):
        loss = random_loss(rng, 2)
        score = float(rng.normal(100, 5) + 50 * loss.source[0])
        curve = [[1000, score - 10.0, 1.0], [2000, score + 10.0, 1.0]]
        attrs = {
            "generation": 1 + 2 * i // n_candidates,
            "operation": "random",
            "curve": curve,
            "device": "CPU: some",
            "threads": 2,
            "seconds": 9.0,
        }
        params, space = loss_to_params(loss), distributions(loss.horizon)
        trials.append(create_trial(value=score, params=params, distributions=space, user_attrs=attrs))
    study.add_trials([*trials, create_trial(state=TrialState.FAIL)])
    for variant, number, score in (("SAC", 0, 90.0), ("SAC", 1, 91.0), ("CURL $x_{", 0, 120.0)):
        cell = Cell(variant, "Pendulum-v1", number)
        path = cell_folder(folder / "baselines", cell)
        prepare_run(path, tiny_run(seed=number))
        write_about(path, cell._asdict())
        write_curve(path / "curve.csv", [Evaluation(steps, score, 0.0, 1, 1.0) for steps in (200, 400)])


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Searches of which one is in runs/, written once: SQLite takes its time."""
    folder = tmp_path_factory.mktemp("planted")
    plant(folder / "runs/one", "one", 0, 60)
    plant(folder / "two", "two", 1, 16)
    plant(folder / "three", "three", 2, 16, f"sqlite:///{folder / 'two/study.db'}")
    return folder


@pytest.fixture
def study(planted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> optuna.Study:
    """The only search in runs/."""
    shutil.copytree(planted, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return load_study(open_storage(Path("runs/one"), create=False), "one")


@pytest.fixture
def benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two variants, two seeds, two tasks; the last run has not started."""
    monkeypatch.chdir(tmp_path)
    folder = Path("runs/benchmark")
    for i, (variant, task, seed) in enumerate((v, t, s) for v in "ab" for t in ("walker-walk", "X-v0") for s in (0, 1)):
        path = folder / variant / task / f"seed-{seed}"
        path.mkdir(parents=True)
        environment = f"dm_control/{task}-v0" if task == "walker-walk" else task
        about = {"variant": variant, "environment": environment, "seed": seed, "checkpoints": [2000], "sessions": []}
        (path / "provenance.json").write_text(json.dumps(about))
        if i < 7:
            write_curve(path / "curve.csv", [Evaluation(1000 * j, 10.0 * i + j, 0.5, 5, 1.0) for j in (1, 2)])
    return folder


def texts(picture: Path) -> str:
    """All that is written in an SVG: matplotlib leaves it beside the outlines of its letters."""
    return "\n".join(re.findall(r"<!-- (.*?) -->", picture.read_text(encoding="utf-8"), flags=re.DOTALL))


def test_analyze_prints_all_tables_as_data(study: optuna.Study) -> None:
    data = json.loads(run("analyze", "--json", "--pattern", "{s_t} -> {r_t}"))["one"]
    done = [trial for trial in study.trials if trial.state == TrialState.COMPLETE]
    for name, (source, target) in {"{s_t} -> {r_t}": ("s_t", "r_t"), "State reconstruction": ("s_t", "s_t")}.items():
        classes: dict[bool, list[float]] = {True: [], False: []}
        for trial in done:
            has = trial.params[f"source/{source}"] and trial.params[f"target/{target}"]
            classes[bool(has)].append(trial.value)
        row = next(row for row in data["table5"] if row["pattern"] == name)
        assert row["difference"] == pytest.approx(np.mean(classes[True]) - np.mean(classes[False]), rel=1e-9)
        welch = scipy.stats.ttest_ind(classes[True], classes[False], equal_var=False).pvalue
        assert row["welch_p"] == pytest.approx(welch, rel=1e-9)
        assert (row["n_with"], row["n_without"]) == (len(classes[True]), len(classes[False]))
    assert {row["state"]: row["trials"] for row in data["population"]} == {
        **dict.fromkeys(("pruned", "running", "waiting", "interrupted", "unusable"), 0),
        **{"trials": 61, "analysed": 60, "fail": 1},
    }
    assert data["importances"][0]["parameter"] == "source/s_t"
    best = max(done, key=lambda trial: trial.value)
    assert [row["number"] for row in data["lineage"]] == [best.number]
    assert all(row["aulc"] == pytest.approx(1.0) for row in data["rank_agreement"])
    assert data["problems"] == {} and data["machines"][0]["device"] == "CPU: some"


def test_analyze_shows_whole_numbers_in_a_narrow_terminal(study: optuna.Study) -> None:
    data = json.loads(run("analyze", "--json"))["one"]
    shown = run("analyze", "runs/one")
    for row in data["table5"]:
        difference = re.escape(f"{row['difference']:+.2f}") + r"\*{0,2} "
        p_values = rf"\W+{row['welch_p']:.2g} "
        assert re.search(rf"{row['pattern']} \W+{difference}{p_values}", shown)
    assert "…" not in shown and re.search(r"fail +│ +1 ", shown)


def test_analyze_compares_studies(study: optuna.Study) -> None:
    shown = run("analyze", "three", "two", "--storage", "sqlite:///two/study.db").splitlines()
    layout = shown[next(i for i, line in enumerate(shown) if "as the paper's table 5" in line) :]
    assert [line.split()[1] for line in layout if re.match("│ (two|three)", line)] == ["three", "two"]
    shutil.copytree("runs/one", "elsewhere/one")
    output = run("analyze", "runs/one", "elsewhere/one")
    assert "│ runs/one " in output and "│ elsewhere/one " in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["analyze", "nowhere"], "nowhere/study.db does not exist"),
        (["analyze", "other", "--storage", "sqlite:///runs/one/study.db"], "no study 'other'. The storage has: one"),
        (["analyze", "--pattern", "{s_t}"], "{s_t}"),
        (["figures", "patterns", "--pattern", "curll"], "nearest: curl"),
        (["figures", "patterns", "runs/one", "two"], "figures patterns takes one folder"),
        (["figures", "evolution", "--out", "x.txt"], "Format 'txt' is not supported"),
        (["figures", "curves"], "runs/benchmark has no learning curves"),
        (["figures", "evolution", "runs/benchmark"], "runs/benchmark has no search"),
    ],
    ids=["folder", "study", "pattern", "name", "folders", "kind", "benchmark", "no search"],
)
def test_what_cannot_be_shown_is_one_line(study: optuna.Study, arguments: list[str], message: str) -> None:
    error = run(*arguments, fails=True)
    assert message in error and len(error.strip().splitlines()) == 1
    assert not list(Path().glob("*.txt"))


def test_a_figure_is_beside_the_search(study: optuna.Study) -> None:
    assert run("figures", "evolution") == "Figure: runs/one/evolution.png\n"
    assert Path("runs/one/evolution.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["evolution", "runs/one"], ["60 candidates (left out: 1 failed)", "SAC", "CURL $x_{"]),
        (["histogram", "runs/one", "two"], ["one: 60 candidates (left out: 1 failed)", "two: 16 candidates"]),
        (["rankings"], ["10 candidates", "by the last evaluation"]),
        (["patterns", "--pattern", "{s_t} -> {r_t}"], ["60 candidates (left out: 1 failed)", "{s_t} -> {r_t}"]),
    ],
    ids=["evolution", "histogram", "rankings", "patterns"],
)
def test_figures_of_searches(study: optuna.Study, arguments: list[str], expected: list[str]) -> None:
    run("figures", *arguments, "--out", "deep/figure.svg")
    written = texts(Path("deep/figure.svg")).replace("&gt;", ">")
    assert all(text in written for text in expected)


def test_curves_of_a_benchmark(benchmark: Path) -> None:
    frame = read_curves(benchmark)
    assert set(frame["env"]) == {"walker-walk", "X-v0"} and len(frame) == 14
    first = frame.query("variant == 'b' and env == 'walker-walk' and seed == 0 and environment_steps == 2000")
    assert first["mean"].tolist() == [42.0] and first["std"].tolist() == [0.5]
    output = run("figures", "curves", "--out", "curves.svg")
    assert "Missing at 2,000: b on X-v0, seed 1: not started" in output
    written = texts(Path("curves.svg"))
    assert "walker-walk" in written and "1 to 2 seeds (shade of one:" in written
    run("figures", "curves", benchmark)
    assert (benchmark / "curves.png").exists()
    (benchmark / "b/X-v0/seed-0/curve.csv").write_text("a,b\n1,2\n")
    assert "b/X-v0/seed-0/curve.csv" in run("figures", "curves", fails=True)
