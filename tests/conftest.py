"""Set before anything imports torch or dm_control: one thread for each test process, a renderer without a display."""

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
if sys.platform.startswith("linux"):
    os.environ.setdefault("MUJOCO_GL", "egl")
# Folders of tests in memory: a commit of SQLite waits 20 ms for a disk.
MEMORY = Path("/dev/shm")
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 2**32:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

import numpy as np  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from executors import Planted  # noqa: E402
from postgres import Postgres  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """numpy's and torch's global generators start alike in every test: or a statistic is beyond its threshold some day."""
    np.random.seed(0)
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A server of this test process; each test makes a database of its own in it."""
    server = Postgres()
    yield server
    server.close()


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> Planted:
    """In the place of this machine's processes."""
    executor = Planted()
    monkeypatch.setattr("sb3_aarl.search.execution.executors.LocalExecutor", executor)
    monkeypatch.setattr("sb3_aarl.search.execution.matrix.POLL_SECONDS", 0)
    monkeypatch.setattr("sb3_aarl.search.execution.driver.POLL_SECONDS", 0)
    return executor


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first, so that two processes end at the same time."""
    items.sort(key=lambda item: "slow" not in item.keywords)
