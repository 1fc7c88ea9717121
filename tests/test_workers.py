"""Who works on a trial, and whether he is alive."""

import os
import subprocess
import sys
import time
from datetime import datetime, timedelta
from pathlib import Path

import optuna
import psutil
import pytest
from optuna.trial import TrialState, create_trial

from search.execution import workers
from search.execution.storage import HEARTBEAT_KEY, open_storage


def sleeper() -> subprocess.Popen[bytes]:
    """A process that lives until its input is closed."""
    return subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)


def test_identity_names_one_process_for_good() -> None:
    process = sleeper()
    try:
        mine, other = workers.identity(), workers.identity(process.pid)
        assert mine == workers.identity(os.getpid()) != other
        assert str(os.getpid()) == mine.split()[-2]
        assert not workers.is_dead(mine)
        assert not workers.is_dead(other)
        # The same number, but another start: the number was given to a new process.
        assert workers.is_dead(f"{other.rsplit(' ', 1)[0]} 1")
        # Of other machines nothing is known.
        machine = other.rsplit(" ", 2)[0]
        assert not workers.is_dead(other.replace(machine, "elsewhere", 1))
    finally:
        process.kill()
        # Dead, but not yet waited for.
        while psutil.Process(process.pid).status() != psutil.STATUS_ZOMBIE:
            pass
        assert workers.is_dead(other)
        process.communicate()
    assert workers.is_dead(other)
    with pytest.raises(psutil.NoSuchProcess):
        workers.identity(process.pid)


def test_a_change_of_the_clock_kills_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = workers.identity()
    created = psutil.Process().create_time()
    monkeypatch.setattr(psutil.Process, "create_time", lambda process: created + 3600)
    assert workers.identity() == mine
    assert not workers.is_dead(mine)


def test_only_running_trials_of_dead_workers_are_failed() -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    process = sleeper()
    dead = workers.identity(process.pid)
    process.communicate()
    study = optuna.create_study()
    for worker in (dead, workers.identity(), None, "elsewhere 1 2"):
        trial = study.ask()
        if worker is not None:
            trial.set_user_attr(workers.WORKER_KEY, worker)
    study.enqueue_trial({}, user_attrs={workers.WORKER_KEY: dead})
    study.add_trial(create_trial(value=1.0, user_attrs={workers.WORKER_KEY: dead}))
    assert workers.fail_dead(study, study.trials) == 1
    states = [trial.state for trial in study.trials]
    running = [TrialState.RUNNING] * 3
    assert states == [TrialState.FAIL, *running, TrialState.WAITING, TrialState.COMPLETE]
    assert study.trials[0].user_attrs["reason"] == "its worker died"
    assert workers.fail_dead(study, study.trials) == 0


def test_a_copy_of_a_dead_trial_has_time_to_get_the_name_of_its_new_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    process = sleeper()
    dead = workers.identity(process.pid)
    process.communicate()
    study = optuna.create_study()
    for _ in range(2):
        trial = study.ask()
        trial.set_user_attr(workers.WORKER_KEY, dead)
        study._storage.set_trial_system_attr(trial._trial_id, "failed_trial", 0)
    trials, now = study.trials, time.monotonic()
    trials[0].datetime_start = datetime.now() - timedelta(hours=1)  # by the clock of another machine
    assert workers.fail_dead(study, trials) == 0
    monkeypatch.setattr(time, "monotonic", lambda: now + 9)
    assert workers.fail_dead(study, trials) == 0
    monkeypatch.setattr(time, "monotonic", lambda: now + 12)
    assert workers.fail_dead(study, trials) == 2


@pytest.mark.parametrize("hours", [-8, 0, 8])
def test_a_worker_that_died_before_it_gave_its_name_is_found_whatever_its_clock(
    hours: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = optuna.create_study()
    study.ask()

    def look(all_have_names: bool = True) -> int:
        trials = study.trials
        for trial in trials:
            trial.datetime_start = datetime.now() + timedelta(hours=hours)
        return workers.fail_dead(study, trials, all_have_names)

    now = time.monotonic()
    assert look() == 0
    monkeypatch.setattr(time, "monotonic", lambda: now + workers.UNNAMED_SECONDS - 1)
    study.ask()
    assert look() == 0
    monkeypatch.setattr(time, "monotonic", lambda: now + workers.UNNAMED_SECONDS + 1)
    assert look(all_have_names=False) == 0  # a user's own study, whose workers have no names
    assert look() == 1
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.RUNNING]


def test_failing_a_trial_that_has_finished_changes_nothing() -> None:
    study = optuna.create_study()
    trial = study.ask()
    before = study.trials[0]
    study.tell(trial, 1.0)
    assert not workers.fail(study, before, "its worker died")
    assert study.trials[0].state == TrialState.COMPLETE
    assert "reason" not in study.trials[0].user_attrs


def test_signs_of_life_are_given_where_the_storage_keeps_them(tmp_path: Path) -> None:
    in_memory = optuna.create_study()
    workers.beat(in_memory._storage, in_memory.ask()._trial_id)
    assert in_memory.trials[0].system_attrs == {}
    study = optuna.create_study(storage=open_storage(tmp_path, heartbeat_interval=1))
    with pytest.warns(UserWarning, match="Heartbeat"):
        trial = study.ask()
    signs = []
    for _ in range(2):
        workers.beat(study._storage, trial._trial_id)
        signs.append(tuple(study.trials[0].system_attrs[HEARTBEAT_KEY]))
    assert len(set(signs)) == 2
    study.tell(trial, 1.0)
    workers.beat(study._storage, trial._trial_id)
    assert tuple(study.trials[0].system_attrs[HEARTBEAT_KEY]) == signs[-1]
