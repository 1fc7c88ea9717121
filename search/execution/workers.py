"""Who works on a trial, and what becomes of the trials of a worker that has died."""

import contextlib
import os
import platform
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import psutil
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.storages._heartbeat import is_heartbeat_enabled
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

# User attribute of a trial: the identity of the process that asked for it.
WORKER_KEY = "worker"
# User attribute of a failed trial: not its candidate but a process died, of its worker or of an environment.
DIED_KEY = "died"
# A worker gives its name milliseconds after it took a trial; after so many seconds without one it has died in between.
UNNAMED_SECONDS = 60.0


def identity(pid: int | None = None) -> str:
    """
    What names a process for good: host, boot, process namespace, number and start time.

    :param pid: Process number on this machine, None for this process
    :raises psutil.NoSuchProcess: when there is none
    """
    pid = os.getpid() if pid is None else pid
    return f"{_machine()} {pid} {_started(pid)}"


def _started(pid: int) -> str:
    """When a process started. On Linux in ticks since the machine did: no change of the clock moves these."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return f"{psutil.Process(pid).create_time():.2f}"


@cache
def _machine() -> str:
    """Host, boot and process namespace: process numbers of two containers, or from before a reboot, say nothing."""
    parts = [platform.node()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        with contextlib.suppress(OSError):
            parts.append(read())
    return "/".join(parts)


def is_dead(worker: str) -> bool:
    """
    Whether a worker is known to have died. False for workers of other machines, of which nothing is known here.

    :param worker: What :func:`identity` gave
    """
    machine, pid, started = ["", "", *worker.rsplit(" ", 2)][-3:]
    if machine != _machine() or not pid.isdecimal():
        return False
    try:
        return _started(int(pid)) != started or psutil.Process(int(pid)).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def fail(study: Study, trial: FrozenTrial, reason: str) -> bool:
    """
    Mark a running trial as failed from outside.

    :param study: The study
    :param trial: The trial
    :param reason: Kept as the user attribute ``reason``
    :return: False if it had finished, or another worker was faster
    """
    storage = study._storage
    try:
        storage.set_trial_user_attr(trial._trial_id, "reason", reason)
        storage.set_trial_user_attr(trial._trial_id, DIED_KEY, True)
        return storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
    except UpdateFinishedTrialError:
        return False


def was_failed(error: Exception) -> bool:
    """
    Whether a worker stumbled over its trial having been failed by another one, who took it for dead: a laptop that slept.

    :param error: What ``study.optimize`` raised
    """
    # Where the objective has returned, Optuna stumbles once more over its own exception.
    return any(
        isinstance(each, UpdateFinishedTrialError) or str(each).startswith("Cannot tell a FAIL trial")
        for each in (error, error.__context__)
    )


_first_seen: WeakKeyDictionary[BaseStorage, dict[int, float]] = WeakKeyDictionary()


def _known_for(storage: BaseStorage, trial: FrozenTrial) -> float:
    """For how many seconds this process has known a trial; when it began is a matter of another machine's clock."""
    now = time.monotonic()
    return now - _first_seen.setdefault(storage, {}).setdefault(trial._trial_id, now)


def beat(storage: BaseStorage, trial_id: int) -> None:
    """
    Give a sign of life for a running trial, where the storage keeps them.

    ``study.optimize`` does so while the objective runs; this is for the time before, in which a trial is asked for.

    :param storage: The storage
    :param trial_id: Identity of the trial in the storage, not its number
    """
    if is_heartbeat_enabled(storage):
        storage.record_heartbeat(trial_id)  # type: ignore[attr-defined]


def fail_dead(
    study: Study, trials: Iterable[FrozenTrial], all_have_names: bool = False, but: FrozenTrial | None = None
) -> int:
    """
    Fail the running trials whose worker is gone, so that their places are given out again.

    Of this machine it is known at once which workers have died. Of all machines, and of workers that were stopped, it is
    known by the signs of life of their trials, where the storage keeps them and this process keeps looking: once a heartbeat
    interval at least, for about two of them (see :class:`search.execution.storage.WithHeartbeat`). No callback of the
    storage makes a copy of them: who looks waits for a place itself, and could not take the copy's.

    :param study: The study
    :param trials: Trials to look at; those without a sign of life are failed whether they are among these or not
    :param all_have_names: Whether all workers of the study give their names, so that one without has died
    :param but: Not this one: the caller's own, which is alive however long its program has slept
    :return: How many were failed
    """
    failed = 0
    for trial in trials:
        if trial.state != TrialState.RUNNING:
            continue
        worker = trial.user_attrs.get(WORKER_KEY)
        if worker is None:
            died = all_have_names and _known_for(study._storage, trial) > UNNAMED_SECONDS
        else:
            # A heartbeat's copy of a dead trial begins with the name of the dead worker.
            died = is_dead(worker) and ("failed_trial" not in trial.system_attrs or _known_for(study._storage, trial) > 10)
        failed += died and fail(study, trial, "its worker died")
    storage: Any = study._storage
    if is_heartbeat_enabled(storage):
        reason = f"no sign of life from its worker for {2 * storage.get_heartbeat_interval()} seconds"
        for trial_id in storage._get_stale_trial_ids(study._study_id):
            if but is None or trial_id != but._trial_id:
                failed += fail(study, storage.get_trial(trial_id), reason)
    return failed
