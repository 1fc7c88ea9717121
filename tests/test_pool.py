"""Worker processes: Ctrl-C, threads, GPUs, errors."""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import joblib  # type: ignore[import-untyped]
import psutil
import pytest
import torch as th
from optuna.exceptions import StorageInternalError

from search.execution import local as pool_module
from search.execution.local import Unfit, WorkerError, WorkerPool


def put_away(folder: Path) -> None:
    """A worker that takes a while to put away what it has."""
    try:
        (folder / "ready").touch()
        while True:
            time.sleep(0.01)
    except KeyboardInterrupt:
        (folder / "interrupted").touch()
        while not (folder / "twice").exists():
            time.sleep(0.01)
        (folder / "away").touch()
        raise


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_second_interrupt_does_not_disturb_a_worker_that_puts_away_what_it_has(tmp_path: Path) -> None:
    """A terminal interrupts the workers along with the program, and then the pool does."""
    with WorkerPool(put_away, (tmp_path,), n_workers=1) as pool:
        (worker,) = pool.processes
        wait_for(tmp_path / "ready")
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGINT)
        wait_for(tmp_path / "interrupted")
        os.kill(worker.pid, signal.SIGINT)
        (tmp_path / "twice").touch()
    assert (tmp_path / "away").exists()
    assert worker.exitcode == 128 + signal.SIGINT


class Slow:
    """Something that takes a while to go away."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __del__(self) -> None:
        (self.folder / "going").touch()
        time.sleep(20)


def lets_go(folder: Path) -> None:
    Slow(folder)
    (folder / "gone").touch()
    while True:
        time.sleep(0.01)


def test_an_interrupt_in_a_destructor_is_not_lost(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with WorkerPool(lets_go, (tmp_path,), n_workers=1) as pool:
        (worker,) = pool.processes
        wait_for(tmp_path / "going")
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGINT)
        worker.join(10)
        assert worker.exitcode == 128 + signal.SIGINT
    assert (tmp_path / "gone").exists()  # Python went on behind the destructor that the first one broke off
    assert "Traceback" not in capfd.readouterr().err


def write_threads(folder: Path) -> None:
    """A worker that says how many threads it has."""
    (folder / "threads").write_text(f"{th.get_num_threads()} {os.environ['OMP_NUM_THREADS']}")


@pytest.mark.parametrize(("threads", "expected"), [(3, 3), (None, 5)])
def test_threads_are_those_asked_for_or_all_cores(
    threads: int | None, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(joblib, "cpu_count", lambda: 5)  # of a container, whatever the machine has
    with WorkerPool(write_threads, (tmp_path,), n_workers=1, threads=threads) as pool:
        while pool.check(progressed=False):
            time.sleep(0.01)
    assert (tmp_path / "threads").read_text() == f"{expected} {expected}"


def write_gpu(folder: Path) -> None:
    """A worker that says which GPU it may use, and waits."""
    (folder / str(os.getpid())).write_text(os.environ["CUDA_VISIBLE_DEVICES"])
    while not (folder / "done").exists():
        time.sleep(0.01)


def test_gpus_are_shared_out_and_a_new_worker_takes_that_of_the_dead_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")

    def seen() -> list[str]:
        files = [tmp_path / str(process.pid) for process in pool.processes]
        for file in files:
            wait_for(file)
        return sorted(file.read_text() for file in files)

    with WorkerPool(write_gpu, (tmp_path,), n_workers=3, threads=1) as pool:
        assert seen() == ["2", "2", "5"]
        (of_five,) = [p for p in pool.processes if (tmp_path / str(p.pid)).read_text() == "5"]
        of_five.kill()
        of_five.join()
        assert pool.check(progressed=False)
        assert seen() == ["2", "2", "5"]
        (tmp_path / "done").touch()
        while pool.check(progressed=False):
            time.sleep(0.01)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "2,5"


def fail_on_five(folder: Path) -> None:
    """A worker whose GPU works unless it is number 5."""
    gpu = os.environ["CUDA_VISIBLE_DEVICES"]
    (folder / f"{gpu}-{os.getpid()}").touch()
    if gpu == "5":
        raise Unfit("the GPU\nfailed")
    while not (folder / "done").exists():
        time.sleep(0.01)


def test_a_gpu_that_failed_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    with WorkerPool(fail_on_five, (tmp_path,), n_workers=2, threads=1) as pool:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("2-*"))) < 2:
            assert pool.check(progressed=False) and time.monotonic() < deadline
            time.sleep(0.01)
        assert len(list(tmp_path.glob("5-*"))) == 1
        (tmp_path / "done").touch()
        while pool.check(progressed=False):
            time.sleep(0.01)
    assert [record.getMessage() for record in caplog.records] == ["A worker ended, another one goes on: the GPU failed"]


def unfit() -> None:
    raise Unfit("the GPU failed")


def test_what_workers_died_of_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 1)
    message = r"^2 workers died one after the other \(the GPU failed\)$"
    with pytest.raises(WorkerError, match=message), WorkerPool(unfit, (), 1, 1) as pool:
        while pool.check(progressed=False):
            time.sleep(0.05)


def full_disk(_: Path) -> None:
    """A worker whose disk is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/journal.log")


def lost_database(_: Path) -> None:
    """A worker whose database fails, with its password in the message."""
    try:
        raise RuntimeError("disk full on postgresql://me:secret@host/db")
    except RuntimeError as error:
        raise StorageInternalError("during the commit") from error


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (full_disk, r"^\[Errno 28\] No space left on device: '/data/journal.log'$"),
        (lost_database, r"^disk full on postgresql://me:\*\*\*@host/db$"),
    ],
)
def test_what_a_user_can_mend_is_one_line(target: Callable[[Path], None], expected: str, tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=expected), WorkerPool(target, (tmp_path,), n_workers=1, threads=1) as pool:
        while pool.check(progressed=False):
            time.sleep(0.01)


PROGRAM = """
import sys, time
from pathlib import Path
from search.execution.local import WorkerPool
from test_pool import write_gpu

if __name__ == "__main__":
    with WorkerPool(write_gpu, (Path(sys.argv[1]),), n_workers=1, threads=1) as pool:
        print(pool.processes[0].pid, flush=True)
        time.sleep(100)
"""


def test_workers_of_a_program_that_was_killed_at_once_end_too(tmp_path: Path) -> None:
    """They import for seconds before they can look after their parent."""
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parent.parent)])
    (tmp_path / "program.py").write_text(PROGRAM)
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py"), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, "CUDA_VISIBLE_DEVICES": "0"},
    ) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
    deadline = time.monotonic() + 60
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.1)


def wait_for_the_end(folder: Path) -> None:
    """A worker that counts how often it was started."""
    (folder / str(os.getpid())).touch()
    while not (folder / "done").exists():
        time.sleep(0.01)


def kill_first(pool: WorkerPool) -> None:
    pool.processes[0].kill()
    pool.processes[0].join()


def test_workers_that_are_killed_all_at_once_are_all_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 1)
    with WorkerPool(wait_for_the_end, (tmp_path,), n_workers=3, threads=1) as pool:
        before = list(pool.processes)
        for number, process in enumerate(before):
            wait_for(tmp_path / str(process.pid))
            assert process.pid is not None
            os.kill(process.pid, signal.SIGTERM if number else signal.SIGKILL)  # one is asked politely
        for process in before:
            process.join()
        assert pool.check(progressed=False)
        assert len(pool.processes) == 3 and not set(before) & set(pool.processes)
        # Two deaths in one place, without a trial in between, are too many.
        kill_first(pool)
        with pytest.raises(WorkerError, match="2 workers died one after the other"):
            pool.check(progressed=False)
        (tmp_path / "done").touch()


def test_a_worker_that_lived_long_is_the_first_that_died(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cluster takes a machine away every few hours, while one candidate trains on it."""
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 1)
    monkeypatch.setattr(pool_module, "LONG_LIFE", 0.0)
    with WorkerPool(wait_for_the_end, (tmp_path,), n_workers=1, threads=1) as pool:
        for _ in range(3):
            assert len(pool.processes) == 1
            kill_first(pool)
            assert pool.check(progressed=False)
        monkeypatch.setattr(pool_module, "LONG_LIFE", 600.0)
        kill_first(pool)
        with pytest.raises(WorkerError, match=r"2 workers died one after the other \(exit code -9: killed, as .*memory"):
            pool.check(progressed=False)
        (tmp_path / "done").touch()


def raise_much() -> None:
    try:
        raise RuntimeError("x" * 1_000_000)
    except RuntimeError as error:
        raise KeyError("the last line") from error


def test_a_long_message_does_not_keep_a_worker() -> None:
    with (
        pytest.raises(WorkerError, match=r"^Traceback(.|\n)* \.\.\. (.|\n)*KeyError: 'the last line'\n$") as error,
        WorkerPool(raise_much, (), 1, 1) as pool,
    ):
        deadline = time.monotonic() + 60
        while pool.check(progressed=False):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert len(str(error.value)) < pool_module.MESSAGE_LENGTH + 10


def test_a_finished_trial_forgets_deaths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "MAX_DEATHS", 1)
    with WorkerPool(wait_for_the_end, (tmp_path,), n_workers=1, threads=1) as pool:
        for _ in range(3):
            assert len(pool.processes) == 1
            kill_first(pool)
            assert pool.check(progressed=True)
        (tmp_path / "done").touch()
