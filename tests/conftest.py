"""Set before anything imports torch or dm_control: one thread for each test process, and a renderer without a display."""

import os
import sys
from collections.abc import Iterator

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
if sys.platform.startswith("linux"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import pytest  # noqa: E402
import torch  # noqa: E402
from postgres import Postgres  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A server of this test process; each test makes a database of its own in it."""
    server = Postgres(fsync="off")
    yield server
    server.close()
