"""README and docs: Python blocks run, commands are the programs' own, YAML loads, notations are losses, pages build."""

import re
import runpy
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest
import typer
from executors import InProcess
from sb3_aarl.search.cli.main import app
from sb3_aarl.search.studies.config import load_config
from sb3_aarl.search.training.config import load_hyperparameters, read_yaml
from tiny import SEARCH, write_search

from sb3_aarl import AuxLoss, rl_zoo

ROOT = Path(__file__).parent.parent
PAGES = {path.relative_to(ROOT).as_posix(): path for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]}
LANGUAGES = {"python", "bash", "yaml", "text"}
# What takes long, and what is put in its place.
SHORTER = {r"learn\([\d_]+": "learn(60", r"eval_freq=[\d_]+": "eval_freq=50", r"pendulum\.yml": "small.yml"}


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of the blocks of a page."""
    return re.findall(r"^```([^\n]*)\n(.*?)^```", PAGES[page].read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def in_language(language: str) -> list[tuple[str, str]]:
    return [(page, text) for page in PAGES for name, text in blocks(page) if name == language]


def test_every_block_is_of_a_known_language() -> None:
    names = {name for page in PAGES for name, _ in blocks(page)}
    assert {name for name in names if not name.startswith("{")} <= LANGUAGES
    assert {name for name in names if name.startswith("{")} <= {"{toctree}", "{figure} images/curves.png"}


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if any(name == "python" for name, _ in blocks(page))])
def test_python_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page, one after the other, in a folder with a small search."""
    text = re.sub(r"(generations|n_random|population_size): \d", r"\1: 1", SEARCH).replace("n_prior: 1", "n_prior: 0")
    write_search(tmp_path, f"{text.replace('200, 400', '50, 100')}baselines: [{{name: SAC}}]\n")
    code = "\n".join(text for name, text in blocks(page) if name == "python")
    for pattern, replacement in SHORTER.items():
        code = re.sub(pattern, replacement, code, flags=re.MULTILINE)
    script = tmp_path / "blocks.py"
    script.write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_aarl.search.execution.executors.LocalExecutor", lambda workers: InProcess())
    runpy.run_path(str(script), run_name="__main__")


def commands() -> list[tuple[str, str]]:
    """Pages and commands, of blocks for a shell and of indented ones."""
    lines = [(page, line) for page, text in in_language("bash") for line in text.splitlines()]
    for page, path in PAGES.items():
        lines += [(page, line) for line in re.findall(r"^    ((?:aarl|make|pip|python) .*)", path.read_text(), re.MULTILINE)]
    lines = [(page, line.split(" # ")[0].strip()) for page, line in lines]
    return [(page, part) for page, line in lines for part in line.split(" && ") if part]


def check_aarl(words: list[str]) -> None:
    """Parse the arguments of ``aarl``, and run nothing."""
    command: Any = typer.main.get_command(app)
    context = None
    while hasattr(command, "commands"):
        name, *words = words
        context = command.make_context(name, [], parent=context, resilient_parsing=True)
        command = command.commands[name]
    command.make_context(command.name, words, parent=context)


@pytest.mark.parametrize(("page", "line"), commands(), ids=str)
def test_commands_are_there(page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options and values of ``aarl``, and shipped files by their names; targets of make, extras, programs of RL-Zoo."""
    write_search(tmp_path)
    for name in re.findall(r"[\w./-]+\.yml", line):
        if not name.startswith("zoo_configs/"):
            (tmp_path / Path(name).name).touch()
    (tmp_path / "zoo_configs").symlink_to(ROOT / "zoo_configs")
    monkeypatch.chdir(tmp_path)
    split = f"printf '%s\\n' {line}"  # bash, for quotes and braces
    program, *words = subprocess.run(["bash", "-c", split], capture_output=True, text=True, check=True).stdout.splitlines()
    assert all((ROOT / word).exists() for word in words if word.startswith(("zoo_configs/", "examples/", "results/")))
    if program == "aarl":
        check_aarl(words)
    elif program == "make":
        assert re.search(rf"^{words[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "pip":
        setup = ConfigParser()
        setup.read(ROOT / "setup.cfg")
        extras = [extra for word in words for found in re.findall(r"\[(.+)\]", word) for extra in found.split(",")]
        assert {*extras} <= {*setup["options.extras_require"]}
    elif words[:2] == ["-m", "sb3_aarl.rl_zoo"]:
        assert words[2] in rl_zoo.PROGRAMS
    else:
        assert program in ("cd", "git", "python", "docker", "ray"), "no test knows this program"


def test_files_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches with the modules and files that they name, files of hyper-parameters for each of their environments."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    found = 0
    for page in PAGES:
        text = PAGES[page].read_text(encoding="utf-8")
        for name, contents in re.findall(
            r"`(\w+\.(?:py|yml))`:\n\n```(?:python|yaml)\n(.*?)^```", text, re.DOTALL | re.MULTILINE
        ):
            Path(name).write_text(contents, encoding="utf-8")
            found += name.endswith(".yml")
    assert found == len(in_language("yaml")), "a YAML block follows its name: `name.yml`:"
    for path in Path().glob("*.yml"):
        values = read_yaml(path)
        is_search = "checkpoints" in values
        if is_search:
            assert load_config(path).environment == values.get("environment")
        for env_id in [] if is_search else values:
            assert load_hyperparameters(path, "Pendulum-v1" if env_id == "default" else env_id)


def test_notations_are_losses() -> None:
    losses = {
        loss
        for page in PAGES.values()
        for loss in re.findall(r"\{[^{}\n]*\} -> \{[^{}\n]*\}(?: \[[^]\n]*\])?", page.read_text())
    }
    assert len(losses) > 4
    for loss in losses - {"{s_t} -> {s_t+1} [name]"}:
        assert str(AuxLoss.parse(loss)) == loss


@pytest.mark.slow
def test_pages_build_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="needs the extra docs")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", ROOT / "docs", tmp_path / "html"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "html" / "api" / "sac_aux.html").read_text(encoding="utf-8")
    assert "aux_kwargs" in page and "Polyak coefficient of the momentum encoder" in page
