"""Provenance of a result: commit, versions, machine and command, as plain values for JSON and notes."""

import contextlib
import functools
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import torch as th

from sb3_aarl.files import replace_text

ABOUT = "provenance.json"
PACKAGES = ("stable-baselines3", "torch", "gymnasium", "dm-control", "mujoco", "shimmy", "optuna", "numpy")


@functools.cache
def commit() -> str:
    """
    The commit of this checkout, with ``-dirty`` where files differ from it; the version where there is no checkout. It is
    looked up once: a process keeps the code that it started with, whatever is checked out later.
    """
    root = Path(__file__).parents[2]
    if (root / ".git").exists():  # else installed, perhaps inside another checkout
        command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
        with contextlib.suppress(OSError, subprocess.CalledProcessError):  # no git
            return subprocess.run(command, cwd=root, capture_output=True, check=True, text=True).stdout.strip()
    return metadata.version("sb3-aarl")


def cpu() -> str:
    """The processor's name, how many of its cores this process may use, and which of its instructions PyTorch uses."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.+)", info.read_text()) if info.exists() else None
    name = model[1] if model else platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores, {th.backends.cpu.get_cpu_capability()}"


@functools.cache
def versions() -> str:
    """Versions of the installed packages that results depend on."""
    installed = []
    for package in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed.append(f"{package} {metadata.version(package)}")
    return ", ".join(installed)


def hide_password(text: str) -> str:
    """A text that may hold the URL of a database, without its password."""
    return re.sub(r"(://[^:/@\s]*):[^@\s]*@", r"\1:***@", text)


def provenance() -> dict[str, str]:
    """Commit, command, date, hardware and versions: they belong beside every result."""
    name = Path(sys.argv[0]).name
    command = shlex.join(["aarl" if name == "main.py" else name, *sys.argv[1:]])  # main.py: python -m sb3_aarl.search.cli.main
    return {
        "commit": commit(),
        "command": hide_password(command),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cpu": cpu(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else "none",
        "python": platform.python_version(),
        "versions": versions(),
    }


def read_about(path: Path) -> dict[str, Any]:
    """The ``provenance.json`` in the folder of a run, empty if there is none."""
    file = path / ABOUT
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}


def write_about(path: Path, about: Mapping[str, Any]) -> None:
    """Write the ``provenance.json`` of a run, in one step."""
    replace_text(path / ABOUT, json.dumps(about, indent=1) + "\n")


def add_session(path: Path, **session: Any) -> None:
    """Add a session, in which a run is started or resumed; its command is that of the program that submitted the run."""
    about = read_about(path)
    session = {**provenance(), **session}
    session["command"] = about.get("command", session["command"])
    write_about(path, {**about, "sessions": [*about.get("sessions", ()), session]})
