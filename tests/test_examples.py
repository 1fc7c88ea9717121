"""The scripts and the notebook in examples/ run as they are, with fewer steps."""

import json
import runpy
import sys
from pathlib import Path

import pytest
from executors import OneProcess

EXAMPLES = Path(__file__).parent.parent / "examples"
# What each prints at its end.
LAST = {
    "sac_to_sac_aux": "SACAux: -",
    "pixels": "after 110 steps:",
    "own_encoder_and_loss": "mean return: -",
    "search_from_python": "Best: {",
}


def test_all_are_here() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*LAST}
    assert all(len(path.read_text(encoding="utf-8").splitlines()) <= 60 for path in EXAMPLES.glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", LAST)
def test_example(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setenv("PYTHONPATH", "")  # which one of them sets
    monkeypatch.setattr("sb3_aarl.search.execution.executors.LocalExecutor", OneProcess)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--steps", "110"])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().out.splitlines()[-1].startswith(LAST[name])


@pytest.mark.slow
def test_notebook(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The code cells, one after the other, with few steps."""
    monkeypatch.setenv("STEPS", "80")
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = json.loads((EXAMPLES / "from_sac_to_sac_aux.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert "(1000, 17) -> (1000, 81)" in capsys.readouterr().out
