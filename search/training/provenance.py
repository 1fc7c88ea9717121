"""Where a number comes from: commit, versions, machine and command, as plain values for JSON and notes."""

import functools
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import torch as th

from sb3_aarl.callbacks import replace_text
from search.execution.passwords import storage_name

# Of a run, in its folder.
ABOUT = "provenance.json"

PACKAGES = ("stable-baselines3", "torch", "gymnasium", "dm-control", "mujoco", "shimmy", "optuna", "numpy")


@functools.cache
def commit() -> str:
    """
    The commit of this checkout, with ``+changes.`` and a hash of them if files differ from it; the version where there is
    no checkout, or an installation that lies in somebody else's. It is looked up once: a process keeps the code that it has
    begun with, whatever is checked out later.
    """
    root = Path(__file__).parents[2]

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, check=True).stdout.strip()

    try:
        if not root.samefile(os.fsdecode(git("rev-parse", "--show-toplevel"))):
            return metadata.version("sb3-aarl")
        changes = git("diff", "--no-ext-diff", "HEAD")
        digest = f"+changes.{hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
        return git("rev-parse", "--short=12", "HEAD").decode() + digest
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("sb3-aarl")


def cpu() -> str:
    """The processor's name, how many of its cores this process may use, and which of its instructions PyTorch uses."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = names[0] if names else name
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores, {th.backends.cpu.get_cpu_capability()}"


@functools.cache
def versions() -> str:
    """The packages that a figure depends on, those that are there."""
    found = []
    for package in PACKAGES:
        try:
            found.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def provenance() -> dict[str, str]:
    """What has to stand beside every figure: commit, command, date, hardware, versions."""
    name = Path(sys.argv[0]).name
    program = "aarl" if name == "main.py" else name  # that is python -m search.cli.main
    return {
        "commit": commit(),
        # It stands in notes and reports, which others read.
        "command": " ".join(storage_name(argument) for argument in [program, *sys.argv[1:]]),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cpu": cpu(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else "none",
        "python": platform.python_version(),
        "versions": versions(),
    }


def read_about(path: Path) -> dict[str, Any]:
    """
    What stands in a run's folder; nothing if it is not there, or torn.

    :param path: The folder
    """
    try:
        about = json.loads((path / ABOUT).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}


def write_about(path: Path, about: Mapping[str, Any]) -> None:
    """
    Leave in a run's folder how it is trained.

    :param path: The folder
    :param about: Plain values
    """
    replace_text(path / ABOUT, json.dumps(about, indent=1) + "\n")


def save_result(path: Path, **result: Any) -> None:
    """
    Write a figure as JSON, with :func:`provenance` beside it.

    :param path: File
    :param result: What was measured, plain values
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**provenance(), **result}, indent=1) + "\n")
