"""results/README.md says what the runs beside it say, and each of them can be made again with the command that it names."""

import inspect
import json
import math
import re
import runpy
import shlex
import statistics
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import search.cli.main
import search.studies.benchmark
from sb3_aarl import SACAux
from sb3_aarl.callbacks import Evaluation, read_curve, write_curve
from search.results.table import paper_scores, read_tables
from search.studies.benchmark import Benchmark, load_benchmark, read_abouts, run_folder
from search.training.provenance import ABOUT

RESULTS = Path(__file__).parent.parent / "results"
make_readme: dict[str, Any] = runpy.run_path(str(RESULTS / "make_readme.py"))
SESSION = {"commit": "c0ffee", "cpu": "a processor", "gpu": "none", "date": "2026-11-21T12:00:00", "threads": 2}


def asked_for(folder: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What a printed command would train."""
    trained: list[Benchmark] = []
    monkeypatch.setattr(search.cli.main, "_train_grid", lambda grid, *_: (trained.append(grid), {}))
    with monkeypatch.context() as patch:
        patch.chdir(RESULTS.parent)
        program, *words = shlex.split(command)
        if program == "python":
            emulated = runpy.run_path(words[0])
            patch.setattr(search.studies.benchmark, "load_benchmark", emulated["load_benchmark"])
            words[0] = "benchmark"
        else:
            assert program == "aarl"
        CliRunner().invoke(search.cli.main.app, [*words, "--out", str(folder / "again")])
    (grid,) = trained
    return [grid.about(cell) for cell in grid.cells]


def commands(text: str) -> list[str]:
    return [line for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]


def test_readme_of_planted_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [Path("zoo_configs") / f"{name}.yml" for name in ("aarl_state", "sac_dense_mlp")]
    monkeypatch.chdir(RESULTS.parent)
    grid = load_benchmark(files, ["cheetah-run"], [0, 2], [100_000], 50_000, 3)
    folder = tmp_path / "results" / "planted"
    runs = {}
    for place, cell in enumerate(grid.cells):
        path = run_folder(folder, cell)
        path.mkdir(parents=True)
        seconds = 3600.0 * (place + 1)
        curve = [Evaluation(50_000, 10.0 * place, 1.0, 3, seconds / 2), Evaluation(100_000, 30.0 * place, 1.0, 3, seconds)]
        write_curve(path / "curve.csv", curve)
        runs[path] = {**grid.about(cell), "sessions": [SESSION], "seconds": seconds}
        (path / ABOUT).write_text(json.dumps(runs[path]))
    (folder / "about.md").write_text("Planted\nWhat is said.\n")
    about = grid.about(grid.cells[0])
    line, reference = make_readme["paper"]([{**about, "variant": "of_nobody"}])
    assert "cheetah-run at 100,000, 10 runs: AARL-State 472 ± 30" in line
    assert "not ours" in reference and "AARL-State 436" in reference
    assert list(make_readme["paper"]([about])) == [reference]  # it is in the table

    text = make_readme["readme"](tmp_path / "results")
    assert "## Planted\n\nWhat is said.\n" in text
    assert "100K steps scores" in text and "472 ± 30" in text  # the paper's
    for place, path in enumerate(runs):
        row = f"| [{path.relative_to(folder)}]({path.relative_to(folder.parent)}/curve.csv) | {30 * place:.1f} at 100,000 "
        assert row + f"| {20 * place:.1f} | {60 * (place + 1)} | 2 | a processor | c0ffee | 2026-11-21 |" in text
    for variant in grid.files:
        seconds = [about["seconds"] for about in runs.values() if about["variant"] == variant]
        hours = sum(seconds) / 2 / 3600
        # Two threads each; 725 candidates of five times as many steps in a search, which have a loss.
        whole = f"{725 * 5 * 2 * hours:,.0f}" if variant == "aarl_state" else ""
        shown = f"{3600 * hours:,.0f} ({min(seconds):,.0f} to {max(seconds):,.0f})"
        assert f"| {variant} | 2 | {shown} | {2 * hours:.2f} | {whole} |" in text
    asked = [about for command in commands(text) for about in asked_for(tmp_path, command, monkeypatch)]
    assert sorted(asked, key=str) == sorted((grid.about(cell) for cell in grid.cells), key=str)


@pytest.mark.parametrize(
    ("checkpoints", "every"),
    [([100_000], 20_000), ([100_000], 30_000), ([20_000, 100_000], 20_000), ([40_000, 100_000], None)],
)
def test_commands_have_the_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checkpoints: list[int], every: int | None
) -> None:
    monkeypatch.chdir(RESULTS.parent)
    grid = load_benchmark([Path("zoo_configs/aarl_state.yml")], ["cheetah-run"], [0, 2], checkpoints, every)
    abouts = [{**grid.about(cell), "sessions": [SESSION]} for cell in grid.cells]
    (command,) = make_readme["commands"](abouts)
    assert "--seeds 0,2" in command and ("--every" in command) is (every is not None)
    assert asked_for(tmp_path, command, monkeypatch) == [grid.about(cell) for cell in grid.cells]


def test_what_was_emulated_is_made_again_so_and_costs_nothing_that_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(RESULTS.parent)
    load = runpy.run_path("results/emulated_bf16.py")["load_benchmark"]
    grid = load([Path("zoo_configs/choices/sac_identity_small_bf16.yml")], ["cheetah-run"], [1], [100_000])
    (cell,) = grid.cells
    path = run_folder(tmp_path / "results" / "planted", cell)
    path.mkdir(parents=True)
    write_curve(path / "curve.csv", [Evaluation(100_000, 30.0, 1.0, 10, 7200.0)])
    (path / ABOUT).write_text(json.dumps({**grid.about(cell), "sessions": [SESSION], "seconds": 7200.0}))
    (path.parents[2] / "about.md").write_text("Planted\nWhat is said.\n")
    text = make_readme["readme"](tmp_path / "results")
    (command,) = commands(text)
    assert command.startswith("python results/emulated_bf16.py zoo_configs/")
    assert asked_for(tmp_path, command, monkeypatch) == [grid.about(cell)]
    assert "Trained by python results/emulated_bf16.py: sac_identity_small_bf16" in text
    assert "core hours" not in text


def test_readme_of_the_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = make_readme["readme"](RESULTS)
    assert (RESULTS / "README.md").read_text(encoding="utf-8") == text, "python results/make_readme.py"
    asked = [about for command in commands(text) for about in asked_for(tmp_path, command, monkeypatch)]
    again = json.loads(json.dumps(asked))  # tuples are lists there
    for folder in make_readme["folders"](RESULTS):
        abouts, unreadable = read_abouts(folder)
        assert not unreadable
        for path, about in abouts.items():
            # The hyper-parameters are those that the file still has, and no number is without its curve.
            kept = {key: value for key, value in {**about, "sessions": []}.items() if key != "seconds"}
            assert kept in again
            assert [point.environment_steps for point in read_curve(path / "curve.csv")] == about["evaluations"]


def last_returns(folder: str, variant: str, task: str = "cheetah-run") -> list[float]:
    """Returns of the last evaluations, one for each seed."""
    curves = sorted((RESULTS / folder / variant / task).glob("seed-*/curve.csv"))
    return [read_curve(curve)[-1].mean for curve in curves]


def test_what_was_decided() -> None:
    """What results/choices_small/about.md says of the runs beside it, and that it is what SACAux does."""
    choices = ("", "_separate", "_joint", "_predictor")

    def are_close(one: list[float], other: list[float]) -> bool:
        error = math.sqrt(sum(statistics.variance(runs) / len(runs) for runs in (one, other)))
        return min(len(one), len(other)) >= 3 and abs(statistics.mean(one) - statistics.mean(other)) < 2 * error

    for task in ("cheetah-run", "walker-walk"):
        runs = [last_returns("choices_small", f"aarl_state_small{choice}", task) for choice in choices]
        default, separate, joint, predictor = runs
        assert min(map(len, runs)) >= 3
        assert max(joint) < min(default + separate + predictor)
        bf16 = last_returns("choices_small", "aarl_state_small_bf16", task)
        assert are_close(default, bf16)
        baselines = ("curl_state_small", "sac_dense_mlp_small", "sac_identity_small")
        curl, sac, identity = (last_returns("choices_small", baseline, task) for baseline in baselines)
        assert are_close(curl, sac) is (task == "walker-walk") and min(len(curl), len(identity)) >= 3
        assert task == "walker-walk" or statistics.mean(curl) < statistics.mean(sac)
        assert max(curl + sac + identity) < min(default)
        assert statistics.stdev(bf16) > statistics.stdev(default)
        for other in (separate, predictor):
            assert statistics.mean(other) < statistics.mean(default) and statistics.stdev(other) > statistics.stdev(default)
        if task == "walker-walk":
            assert max(separate) < min(default) and min(bf16) < 0.75 * min(default)
        else:
            assert max(curl + sac + identity) < min(default + separate + joint + predictor + bf16)
    identity, *orthogonal = (
        last_returns("choices_small", f"sac_identity_small{choice}") for choice in ("", "_orthogonal", "_orthogonal_squashed")
    )
    assert all(len(runs) >= 3 and statistics.stdev(runs) < statistics.stdev(identity) for runs in orthogonal)
    on_walker = [last_returns("choices_small", f"sac_identity_small{choice}", "walker-walk") for choice in ("", "_orthogonal")]
    squashed = last_returns("choices_small", "sac_identity_small_orthogonal_squashed", "walker-walk")
    assert len(on_walker[1]) == len(squashed) == 3 and min(on_walker[1]) > max(on_walker[0])
    assert sum(run > max(on_walker[0]) for run in squashed) == 1
    dense, orthogonal_dense, aarl, orthogonal_aarl = (
        last_returns("choices_small", f"{variant}_small{choice}", "walker-walk")
        for variant in ("sac_dense_mlp", "aarl_state")
        for choice in ("", "_orthogonal")
    )
    assert statistics.mean(orthogonal_dense) < statistics.mean(dense)
    assert max(on_walker[1]) < min(aarl) < max(aarl) < min(orthogonal_aarl)
    on_cheetah = [last_returns("choices_small", f"aarl_state_small{choice}") for choice in ("", "_orthogonal")]
    assert len(on_cheetah[1]) == 2 and max(on_cheetah[1]) <= max(on_cheetah[0])
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
    said = [
        f"{statistics.mean(runs):.0f} ± {statistics.stdev(runs):.0f}"
        for runs in (on_walker[1], orthogonal_dense, orthogonal_aarl)
    ]
    assert f"it gets {said[0]} there, SAC with the same encoder {said[1]}, AARL-State {said[2]} (3 seeds each)." in readme
    arguments = inspect.signature(SACAux).parameters
    of_policy = inspect.signature(SACAux.policy_aliases["MlpPolicy"]).parameters
    assert arguments["precision"].default == "fp32"
    assert arguments["joint_optimizer"].default is False and of_policy["share_features_extractor"].default is True
    assert (arguments["predictor_width"].default, arguments["predictor_batch_norm"].default) == (256, False)


def test_the_figures_of_the_first_readme() -> None:
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
    said = ["here"]
    for variant in ("aarl_state_bf16", "sac_dense_mlp_bf16", "curl_state_bf16", "sac_identity_bf16"):
        returns = last_returns("choices", variant)
        said.append(f"{statistics.mean(returns):.0f} ± {statistics.stdev(returns):.0f}")
        assert f"{len(returns)} seeds" in readme
    assert " | ".join(said) in readme
    paper = paper_scores(4).query("checkpoint == 100_000 and environment == 'dm_control/cheetah-run-v0'").set_index("column")
    of_paper = [paper.loc[column] for column in ("AARL-State", "SAC", "CURL", "SAC-Identity")]
    assert " | ".join(["paper", *(f"{score['mean']:.0f} ± {score['std']:.0f}" for score in of_paper)]) in readme
    marks = read_tables(RESULTS / "choices").comparison.set_index("variant")["mark"]
    assert "All but SAC are more than two standard errors from the paper's" in readme
    assert {variant for variant, mark in marks.items() if not mark} == {"sac_dense_mlp_bf16"}
    minutes = [about["seconds"] / 60 for about in read_abouts(RESULTS / "choices")[0].values()]
    assert f"A run takes {min(minutes):.0f} to {max(minutes):.0f} minutes of one core" in readme

    def both(variant: str, between: str) -> str:
        returns = [last_returns("choices_small", variant, task) for task in ("cheetah-run", "walker-walk")]
        return between.join(f"{statistics.mean(of_task):.0f} ± {statistics.stdev(of_task):.0f}" for of_task in returns)

    variants = [f"{name}_small" for name in ("aarl_state", "sac_dense_mlp", "curl_state", "sac_identity")]
    columns = [both(variant, "|").split("|") for variant in variants]
    for row, task in enumerate(("Cheetah-Run", "Walker-Walk")):
        assert " | ".join([task, *(column[row] for column in columns)]) in readme
    n_runs = [
        len(last_returns("choices_small", variant, task)) for variant in variants for task in ("cheetah-run", "walker-walk")
    ]
    assert n_runs == [3] * 6 + [n_runs[6]] * 2 and f"3 seeds each, {n_runs[6]} of the last:" in readme
    walker = paper_scores(4).query("checkpoint == 100_000 and environment == 'dm_control/walker-walk-v0'")["mean"]
    assert f"all four are level on Walker-Walk ({walker.min():.0f} to {walker.max():.0f})" in readme
    assert f"AARL-State gets {both('aarl_state_small_joint', ' and ')} where one optimizer" in readme
    assert f"in bfloat16 {both('aarl_state_small_bf16', ' and ')}, emulated" in readme
    abouts = read_abouts(RESULTS / "choices_small")[0].values()
    minutes = [about["seconds"] / 60 for about in abouts if about["variant"] == "aarl_state_small"]
    assert f"(AARL-State: {min(minutes):.0f} to {max(minutes):.0f} minutes of one core)" in readme
