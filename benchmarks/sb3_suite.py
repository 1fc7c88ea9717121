"""
SB3's own test suite with SACAux in SAC's place.

Downloads the source distribution of the installed SB3 version with pip, puts ``stable_baselines3.SAC = SACAux`` before
the tests are imported, and runs those that concern SAC. SB3's tests need a few packages that SB3 itself does not:
``pip install tensorboard opencv-python-headless pandas matplotlib``.

    python benchmarks/sb3_suite.py --out sb3_suite.json
"""

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import stable_baselines3
from sb3_aarl.search.training.provenance import provenance

# By default all tests that run SAC, and those of what SACAux has of its own (replay buffer, n-step returns, gSDE).
SELECTION = "SAC or sac or sde or n_step or buffer"

# Imported by pytest before any test is. Tests that use SAC without its name in theirs get it as a keyword.
PLUGIN = """
import inspect
import json
import os

import pytest
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_aarl import SACAux

for module in (stable_baselines3, stable_baselines3.sac):
    module.SAC = SACAux

results = {}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        others = [p for p in parameters if inspect.isclass(p) and issubclass(p, BaseAlgorithm) and p is not SACAux]
        if not others and "SAC(" in inspect.getsource(item.function):
            item.extra_keyword_matches.add("sac")


def pytest_runtest_logreport(report):
    if report.when == "call" or report.outcome != "passed":
        reason = ""
        if report.failed and getattr(report.longrepr, "reprcrash", None):
            reason = report.longrepr.reprcrash.message.splitlines()[0]
        elif report.longrepr:
            reason = report.longrepr[2] if report.skipped else str(report.longrepr).splitlines()[-1]
        results[report.nodeid] = {"outcome": report.outcome, "reason": reason, "seconds": round(report.duration, 2)}


def pytest_collectreport(report):
    # test_utils.py needs ale-py; none of its tests concerns SAC.
    if report.failed:
        reason = [line for line in str(report.longrepr).splitlines() if line.strip()][-1]
        results[report.nodeid] = {"outcome": "not collected", "reason": reason}


def pytest_sessionfinish():
    with open(os.environ["SB3_SUITE_RESULTS"], "w") as file:
        json.dump(results, file)
"""


def unpack_tests(folder: Path, version: str) -> None:
    """
    Put SB3's tests and its pytest settings into a folder.

    :param folder: Where to
    :param version: Version of SB3
    """
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "download", "--dest", str(folder)]
    source_only = ["--no-binary", ":all:", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, *source_only, f"stable-baselines3=={version}"], check=True)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        for member in archive.getmembers():
            # Without the top folder (name and version) and without SB3's code: the installed one is tested.
            member.name = member.name.partition("/")[2]
            if member.name == "pyproject.toml" or member.name.startswith("tests/"):
                archive.extract(member, folder, filter="data")


def run_suite(selection: str, pytest_arguments: list[str]) -> dict[str, dict[str, str]]:
    """
    Outcome and reason of each test, by name.

    :param selection: Which tests, as pytest's ``-k`` takes it
    :param pytest_arguments: Further arguments of pytest
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        unpack_tests(folder, stable_baselines3.__version__)
        (folder / "sac_aux_in_sacs_place.py").write_text(PLUGIN)
        results = folder / "results.json"
        path = os.pathsep.join([str(folder), str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])
        subprocess.run(
            [sys.executable, "-m", "pytest", "-p", "sac_aux_in_sacs_place", "-q", "-k", selection, *pytest_arguments, "tests"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path, "SB3_SUITE_RESULTS": str(results)},
        )
        return json.loads(results.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description="SB3's own test suite with SACAux in SAC's place.")
    parser.add_argument("-k", dest="selection", default=SELECTION, help="which tests, as pytest's -k (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write the outcome of every test to this JSON file")
    args, pytest_arguments = parser.parse_known_args()
    tests = run_suite(args.selection, ["--tb=no", "--continue-on-collection-errors", *pytest_arguments])

    outcomes = [test["outcome"] for test in tests.values()]
    counts = {outcome: outcomes.count(outcome) for outcome in ("passed", "failed", "skipped", "not collected")}
    print(f"\nSB3 {stable_baselines3.__version__}: " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    for name, test in tests.items():
        if test["outcome"] in ("failed", "not collected"):
            print(f"  {name}: {test['reason']}")
    if args.out:
        result = {"provenance": provenance(), "sb3": stable_baselines3.__version__, **counts, "tests": tests}
        args.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
