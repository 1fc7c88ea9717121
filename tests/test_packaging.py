"""What a user gets: a core that needs no extra, an sdist with everything, a package for OptunaHub."""

import runpy
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
import yaml

import sb3_aarl

ROOT = Path(__file__).parent.parent
# Modules of the extras. The import system takes None for one that is not there.
BARE = """
import sys
extras = "dm_control dm_env imageio matplotlib mujoco optuna packaging pandas scipy shimmy"
program = "filelock pydantic rich tqdm typer"
sys.modules.update(dict.fromkeys(f"{extras} {program}".split()))
"""
WITHOUT_EXTRAS = """
from sb3_aarl import SACAux

SACAux("MlpPolicy", "Pendulum-v1", aux_loss="forward-dynamics").learn(110)
for module in program.split():
    del sys.modules[module]
from sb3_aarl.envs import make_dmc_env
from sb3_aarl.search.cli.main import app

for arguments in ("train cheetah-run", "search demo", "train Pendulum-v1 --steps 40 --evaluations 1 --episodes 1"):
    app(arguments.split(), standalone_mode=False)
try:
    make_dmc_env("cheetah-run")
except ImportError as error:
    print(error, file=sys.stderr)
"""


def python(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_without_extras_an_agent_is_trained_beside_a_module_called_search(tmp_path: Path) -> None:
    """What needs an extra names it in one line; SACAux needs none of the modules of the program either."""
    for name in ("search.py", "zoo_configs.py"):  # the user's own
        (tmp_path / name).write_text("raise SystemExit('not the package')")
    ran = python(BARE + WITHOUT_EXTRAS, tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert list(tmp_path.rglob("model.zip"))
    lines = ran.stderr.splitlines()
    assert [extra for line in lines for extra in ("[dmc]", "[search]") if f"sb3-aarl{extra}" in line] == [
        "[dmc]",
        "[search]",
        "[dmc]",
    ]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a checkout")
def test_the_sdist_has_every_file_of_the_checkout(tmp_path: Path) -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    files = {name for name in listed if (ROOT / name).is_file()} - {".gitignore"}
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    built = python("from setuptools.build_meta import build_sdist\nbuild_sdist('dist')", tmp_path)
    assert built.returncode == 0, built.stderr
    with tarfile.open(next((tmp_path / "dist").glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert files <= names


def test_the_package_for_optunahub_finds_a_loss(capsys: pytest.CaptureFixture[str]) -> None:
    package = ROOT / "contrib/optunahub/package/samplers/aux_loss_sampler"
    runpy.run_path(str(package / "example.py"), run_name="__main__")
    assert "the best loss is {s_t, a_t} -> {s_t+1}" in capsys.readouterr().out
    about = yaml.safe_load((package / "README.md").read_text(encoding="utf-8").split("---")[1])
    assert about["license"] == "MIT License" and "sampler" in about["tags"]


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == sb3_aarl.__version__
