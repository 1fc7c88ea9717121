"""PostgreSQL and Optuna's proxy: outages in the middle of the work, signs of life, addresses that are wrong."""

import logging
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

import grpc
import optuna
import psycopg
import pytest
from optuna.exceptions import DuplicatedStudyError, StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, RDBStorage
from optuna.study import StudyDirection
from optuna.trial import TrialState
from postgres import PASSWORD, Postgres, free_port
from sqlalchemy.exc import DBAPIError, OperationalError

from search.execution import workers
from search.execution.storage import Database, ServerLost, SharedReads, open_storage, serve_proxy
from search.studies.objective import disk_problem

pytestmark = pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed")
names = (f"database{number}" for number in count())


@pytest.fixture(autouse=True)
def quiet() -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)


@pytest.fixture
def url(postgres: Postgres) -> str:
    """URL of an empty database."""
    return postgres.create(next(names))


@contextmanager
def python(code: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """A program in a process of its own, killed at the end."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        text=True,
        stdout=subprocess.PIPE,
        # Whoever runs the tests in the background may ignore Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def proxy(url: str, port: int) -> Any:
    return python(f"from search.execution.storage import serve_proxy; serve_proxy({url!r}, port={port})")


# Outages.


def value(x: float, worker: int) -> float:
    return 1000 * worker + x


def work(where: str, worker: int, done: dict[int, float], enough: Callable[[], bool]) -> None:
    """Ask and tell until there is enough."""
    storage = open_storage(where, patience=20)
    study = optuna.load_study(study_name="study", storage=storage, sampler=optuna.samplers.RandomSampler(worker))
    while not enough():
        trial = study.ask()
        score = value(trial.suggest_float("x", 0, 1), worker)
        trial.set_user_attr("worker", worker)
        trial.report(score, 1)
        study.tell(trial, score)
        done[trial.number] = score


def check_work_through(where: str, url: str, outages: list[Callable[[], None]], n_workers: int = 3) -> None:
    """Nothing may be lost or doubled, whatever happens in the middle of the work."""
    study = optuna.create_study(study_name="study", storage=open_storage(url))
    done: dict[int, float] = {}
    ended = threading.Event()
    with ThreadPoolExecutor(n_workers) as pool:
        running = [pool.submit(work, where, worker, done, ended.is_set) for worker in range(n_workers)]
        try:
            for outage in (*outages, lambda: None):
                enough, deadline = len(done) + 2 * n_workers, time.monotonic() + 30
                while len(done) < enough and not any(future.done() for future in running):
                    assert time.monotonic() < deadline, "nobody works"
                    time.sleep(0.01)
                outage()
        finally:
            ended.set()
        for future in running:
            future.result()
    trials = study.trials
    assert [trial.number for trial in trials] == list(range(len(trials)))
    assert {trial.number: trial.value for trial in trials if trial.state == TrialState.COMPLETE} == done
    for number, score in done.items():
        worker = int(score // 1000)
        assert value(trials[number].params["x"], worker) == score
        assert trials[number].user_attrs["worker"] == worker
        assert trials[number].intermediate_values == {1: score}
    # Asked for twice, because the first answer was lost.
    orphans = [trial for trial in trials if trial.state != TrialState.COMPLETE]
    assert all(trial.state == TrialState.RUNNING and not trial.params for trial in orphans)
    assert len(orphans) <= n_workers * len(outages)


def test_work_goes_on_through_restarts_of_postgresql(postgres: Postgres, url: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    check_work_through(url, url, [lambda: postgres.restart(seconds=0.5), lambda: postgres.restart(crash=True)])
    lines = [record.getMessage() for record in caplog.records if record.name == "search.execution.storage"]
    # One line when it begins and one when it is over, not one for each thread and call.
    assert [" is back after " in line for line in lines] in ([False, True], [False, True] * 2), lines
    assert PASSWORD not in caplog.text


def test_work_through_a_proxy_goes_on_when_either_is_restarted(postgres: Postgres, url: str) -> None:
    port = free_port()
    where = f"grpc://127.0.0.1:{port}"
    first, second = proxy(url, port), proxy(url, port)
    with first as process:
        storage = open_storage(where, patience=30)
        half = optuna.create_study(study_name="half", storage=storage).ask()
        half.suggest_float("x", 0, 1)

        def kill() -> None:
            process.kill()
            process.wait()
            time.sleep(0.2)
            second.__enter__()

        try:
            check_work_through(where, url, [lambda: postgres.restart(seconds=0.5), kill])
            # A new proxy knows the trials of the old one.
            half.suggest_float("y", 0, 1)
            half.study.tell(half, 3.0)
            assert storage.get_trial(half._trial_id).value == 3.0
            assert set(storage.get_trial(half._trial_id).params) == {"x", "y"}
        finally:
            second.__exit__(None, None, None)


def test_opening_waits_as_long_as_it_may(postgres: Postgres, url: str) -> None:
    postgres.stop()
    try:
        started = time.monotonic()
        with pytest.raises(ValueError, match=r"cannot reach .*, tried for \d s: .*refused") as error:
            open_storage(url, patience=0.5)
        assert 0.5 <= time.monotonic() - started < 5
        assert PASSWORD not in "".join(traceback.format_exception(error.value))
        with ThreadPoolExecutor(1) as pool:
            opened = pool.submit(open_storage, url, patience=30)
            time.sleep(0.3)
            postgres.start()
            assert opened.result().get_all_studies() == []
    finally:
        if postgres._process.poll() is not None:
            postgres.start()


def test_time_is_up_once_however_calls_are_nested(postgres: Postgres, url: str) -> None:
    storage = open_storage(url)
    assert isinstance(storage, Database)
    study = optuna.create_study(storage=storage)
    trial = study.ask()
    study.tell(trial, 1.0)
    postgres.stop()
    try:
        for call in (lambda: study.best_trial, lambda: storage.get_best_trial(study._study_id)):
            storage.patience, storage.gave_up = 1.0, False
            started = time.monotonic()
            with pytest.raises(ServerLost, match="tried for 1 s"):
                call()
            assert time.monotonic() - started < 4
            # What is put away after that does not wait as long again.
            started = time.monotonic()
            with pytest.raises(ServerLost):
                storage.set_trial_user_attr(trial._trial_id, "reason", "lost")
            assert time.monotonic() - started < 0.9
        # The thread that gives signs of life must live, and the end of a trial waits for it.
        storage.patience, storage.gave_up, storage.heartbeat_interval = 600, False, 1
        started = time.monotonic()
        storage.record_heartbeat(trial._trial_id)
        assert time.monotonic() - started < 4
        storage.patience = 0.5
        with pytest.raises(ServerLost, match="tried for"):
            storage.get_all_studies()
    finally:
        postgres.start()
    # The next outage, of a proxy that lives on, is waited for again.
    storage.patience = 30
    assert len(storage.get_all_studies()) == 1
    postgres.stop()
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(storage.get_all_studies)
        time.sleep(1)
        postgres.start()
        assert len(read.result()) == 1


def test_errors_that_are_no_outage_are_not_waited_for(url: str) -> None:
    storage = open_storage(url)
    assert isinstance(storage, Database)
    optuna.create_study(storage=storage)
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("DROP TABLE trial_heartbeats, trial_user_attributes CASCADE")
    started = time.monotonic()
    with pytest.raises(StorageInternalError):
        storage.set_trial_user_attr(storage.create_new_trial(1), "key", 1)
    assert time.monotonic() - started < 5

    def raised(cause: Exception, statement: str | None = "SELECT 1", invalidated: bool = False) -> Exception:
        error = StorageInternalError()
        error.__cause__ = OperationalError(statement, {}, cause, connection_invalidated=invalidated)
        return error

    for lost in (
        raised(psycopg.errors.AdminShutdown()),
        raised(psycopg.errors.CannotConnectNow()),
        raised(psycopg.errors.TooManyConnections(), None),
        raised(psycopg.OperationalError("consuming input failed"), invalidated=True),
        raised(psycopg.OperationalError("connection failed: FATAL: the database system is starting up"), None),
        raised(psycopg.OperationalError("connection failed: Connection refused"), None),
        raised(psycopg.errors.ConnectionTimeout("connection timeout expired"), None),
    ):
        assert storage.is_lost(lost)
    for real in (
        raised(psycopg.errors.DiskFull()),
        raised(psycopg.errors.DiskFull(), None),
        raised(psycopg.errors.DeadlockDetected()),
        raised(psycopg.errors.OutOfMemory()),
        raised(psycopg.OperationalError('connection failed: FATAL: role "me" does not exist'), None),
        raised(__import__("sqlite3").OperationalError("database is locked"), None),
        ValueError(),
    ):
        assert not storage.is_lost(real)


# Answers that are lost: the call was carried out, and is repeated.


@pytest.fixture
def lose(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., None]]:
    """``lose(name, before, after)``: the next call of the storage that is called so loses its answer."""

    def set_up(name: str, after: Callable[[], None] = lambda: None, carried_out: bool = True) -> None:
        method = getattr(RDBStorage, name)
        is_first = [True]

        def call(*arguments: Any, **keywords: Any) -> Any:
            if not is_first[0]:
                return method(*arguments, **keywords)
            is_first[0] = False
            if carried_out:
                method(*arguments, **keywords)
            after()
            raise DBAPIError("COMMIT", {}, ConnectionResetError(), connection_invalidated=True)

        monkeypatch.setattr(RDBStorage, name, call)

    yield set_up


@pytest.fixture
def study(tmp_path: Path) -> optuna.Study:
    return optuna.create_study(study_name="study", storage=open_storage(f"sqlite:///{tmp_path}/study.db"))


def test_a_result_whose_receipt_was_lost_is_not_told_twice(study: optuna.Study, lose: Callable[..., None]) -> None:
    trial = study.ask()
    lose("set_trial_state_values")
    study.tell(trial, 2.5)
    assert [(trial.state, trial.value) for trial in study.trials] == [(TrialState.COMPLETE, 2.5)]
    with pytest.raises(ValueError, match="Cannot tell"):
        study.tell(trial, 2.5)


def test_a_trial_that_another_one_finished_meanwhile_is_not_ours(
    study: optuna.Study, lose: Callable[..., None], tmp_path: Path
) -> None:
    trial = study.ask()
    other = open_storage(f"sqlite:///{tmp_path}/study.db")

    def fail() -> None:
        assert RDBStorage.set_trial_state_values(other, trial._trial_id, TrialState.FAIL)

    lose("set_trial_state_values", after=fail, carried_out=False)
    with pytest.raises(UpdateFinishedTrialError):
        study.tell(trial, 2.5)
    assert study.trials[0].state == TrialState.FAIL


@pytest.mark.parametrize("by_us", [True, False])
def test_who_takes_an_enqueued_trial_learns_it_though_the_answer_is_lost(
    by_us: bool, study: optuna.Study, lose: Callable[..., None], tmp_path: Path
) -> None:
    study.enqueue_trial({"x": 1.0})
    trial_id = study.trials[0]._trial_id
    other = open_storage(f"sqlite:///{tmp_path}/study.db")

    def take() -> None:
        if not by_us:
            assert other.set_trial_state_values(trial_id, TrialState.WAITING)
            assert RDBStorage.set_trial_state_values(other, trial_id, TrialState.RUNNING)

    if by_us:
        lose("set_trial_state_values")
    else:  # taken before our attempt, by the clock
        assert RDBStorage.set_trial_state_values(other, trial_id, TrialState.RUNNING)
        lose("set_trial_state_values", carried_out=False)
    before = datetime.now()
    assert study._storage.set_trial_state_values(trial_id, TrialState.RUNNING) == by_us
    started = study.trials[0].datetime_start
    assert started is not None and (started >= before) == by_us


def test_studies_are_made_and_deleted_once(study: optuna.Study, lose: Callable[..., None]) -> None:
    storage = study._storage
    lose("create_new_study")
    made = optuna.create_study(study_name="other", storage=storage)
    assert optuna.get_all_study_names(storage) == ["study", "other"]
    with pytest.raises(DuplicatedStudyError):
        optuna.create_study(study_name="other", storage=storage)
    lose("delete_study")
    storage.delete_study(made._study_id)
    assert optuna.get_all_study_names(storage) == ["study"]
    with pytest.raises(KeyError):
        storage.delete_study(made._study_id)


# Signs of life.

WORKER = """
import sys, time, optuna
from search.execution import workers
from search.execution.storage import open_storage
optuna.logging.set_verbosity(optuna.logging.ERROR)
study = optuna.load_study(study_name="study", storage=open_storage(sys.argv[1], heartbeat_interval=1))
def objective(trial):
    workers.beat(study._storage, trial._trial_id)
    print(trial.number, flush=True)
    time.sleep(60)
study.optimize(objective, n_trials=1)
"""


@pytest.mark.parametrize("kind", ["journal", "postgresql", "proxy"])
def test_the_trial_of_a_stopped_worker_fails_and_that_of_a_live_one_does_not(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    if kind == "journal":
        where, server = str(tmp_path), python("")
    else:
        where, server = request.getfixturevalue("url"), python("")
        if kind == "proxy":
            port = free_port()
            where, server = f"grpc://127.0.0.1:{port}", proxy(where, port)
    with server:
        storage = open_storage(where, heartbeat_interval=1, patience=30)
        study = optuna.create_study(study_name="study", storage=storage)
        silent = study.ask()  # of a user whose program gives no signs of life
        with python(WORKER, where) as stopped:
            assert stopped.stdout is not None
            number = int(stopped.stdout.readline())
            ended = threading.Event()
            live = threading.Thread(target=study.optimize, args=(lambda trial: float(ended.wait(30)),), kwargs={"n_trials": 1})
            live.start()
            time.sleep(0.4)  # not between two signs: who is stopped with the lock of a journal in his hand stops all
            stopped.send_signal(signal.SIGSTOP)
            began = time.monotonic()
            while not (failed := workers.fail_dead(study, [])):
                assert time.monotonic() - began < 15
                time.sleep(0.1)
            seconds = time.monotonic() - began
            ended.set()
            live.join()
        assert failed == 1
        assert seconds > 1.5  # two intervals after a sign that may be a moment old
        trials = study.trials
        assert trials[number].state == TrialState.FAIL
        assert trials[number].user_attrs["reason"] == "no sign of life from its worker for 2 seconds"
        assert [trial.state for trial in trials if trial.number != number] == [TrialState.RUNNING, TrialState.COMPLETE]
        # Late signs are no error.
        workers.beat(study._storage, trials[number]._trial_id)
        workers.beat(storage, silent._trial_id)
        assert study.trials[number].state == TrialState.FAIL


def test_workers_of_the_proxy_and_of_its_database_see_each_other(url: str) -> None:
    port = free_port()
    with proxy(url, port):
        ways = [open_storage(where, patience=60, heartbeat_interval=1) for where in (url, f"grpc://127.0.0.1:{port}")]
        optuna.create_study(study_name="both", storage=ways[0])
        studies = [optuna.load_study(study_name="both", storage=way) for way in ways]
        for study in studies:
            workers.beat(study._storage, study.ask()._trial_id)
        deadline = time.monotonic() + 30
        # Each watches; only the first worker still gives signs of life.
        while studies[0].trials[1].state == TrialState.RUNNING:
            assert time.monotonic() < deadline
            workers.beat(studies[0]._storage, studies[0].trials[0]._trial_id)
            for study in studies:
                workers.fail_dead(study, [])
            time.sleep(0.1)
        assert studies[1].trials[0].state == TrialState.RUNNING
        while studies[1].trials[0].state == TrialState.RUNNING:
            assert time.monotonic() < deadline
            workers.fail_dead(studies[1], [])
            time.sleep(0.1)


def test_a_worker_is_judged_by_its_own_interval(tmp_path: Path) -> None:
    slow, fast = (open_storage(tmp_path, heartbeat_interval=seconds) for seconds in (60, 1))
    study = optuna.create_study(study_name="study", storage=slow)
    workers.beat(study._storage, study.ask()._trial_id)
    watching = optuna.load_study(study_name="study", storage=fast)
    deadline = time.monotonic() + 3
    while time.monotonic() < deadline:
        workers.fail_dead(watching, [])
        time.sleep(0.1)
    assert watching.trials[0].state == TrialState.RUNNING


@pytest.mark.parametrize("kind", ["journal", "sqlite"])
def test_nobody_is_blamed_for_a_time_in_which_nobody_looked(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("search.execution.storage.LATE_SECONDS", 2.0)
    where = str(tmp_path) if kind == "journal" else f"sqlite:///{tmp_path}/study.db"
    study = optuna.create_study(storage=open_storage(where, heartbeat_interval=1))
    workers.beat(study._storage, study.ask()._trial_id)
    for _ in range(2):  # all have slept: a laptop's lid, a server that was away
        assert workers.fail_dead(study, []) == 0
        time.sleep(2.1)
    began = time.monotonic()
    while not workers.fail_dead(study, []):
        time.sleep(0.05)
    assert 1.9 < time.monotonic() - began < 5


# What is wrong is said at once, in one line.


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("postgresql://aarl:wr0ng@127.0.0.1:{port}/postgres", "password authentication failed"),
        ("postgresql://aarl:s3cret@127.0.0.1:{port}/nothing", 'database "nothing" does not exist'),
        ("postgresql://aarl:s3cret@127.0.0.1:{closed}/postgres", "cannot reach .*refused"),
        ("postgresql://aarl:s3cret@nowhere.invalid/postgres", "cannot reach .*nowhere.invalid"),
        ("postgresql://aarl:s3cret@x@127.0.0.1/postgres", "malformed URL: in a password, write @ as %40"),
        ("postgresql://aarl:s3cret x@127.0.0.1/postgres", "malformed URL: in a password"),
        ("postgresql://aarl:s3cret@127.0.0.1:54x/postgres", "malformed URL"),
        ("postgresql://aarl:s3cret/x@y:z@127.0.0.1/postgres", "malformed URL"),
        ("postgresql:/aarl:s3cret@127.0.0.1/postgres", "//"),
        ("oracle+wrong://aarl:s3cret@127.0.0.1/postgres", "oracle"),
        ("grpc://127.0.0.1:{closed}", "cannot reach .*refused"),
        ("grpc://127.0.0.1:{port}", "cannot reach grpc://127.0.0.1"),
        ("grpc://127.0.0.1", "grpc://host:port is expected"),
        ("grpc://127.0.0.1:99999", "grpc://host:port is expected"),
        ("grpc://aarl:s3cret@127.0.0.1:13000", "grpc://host:port is expected"),
        ("grpc://127.0.0.1:13000/database", "grpc://host:port is expected"),
    ],
)
def test_what_is_wrong_with_an_address(where: str, message: str, postgres: Postgres) -> None:
    where = where.format(port=postgres.port, closed=free_port())
    started = time.monotonic()
    with pytest.raises(ValueError, match=message) as error:
        open_storage(where)
    assert time.monotonic() - started < 8
    text = str(error.value)
    assert "\n" not in text and "s3cret" not in text and "wr0ng" not in text
    shown = "".join(traceback.format_exception(error.value))
    assert "s3cret x" not in shown and "Error: cannot" in shown


def test_a_password_may_stand_elsewhere_or_have_any_characters(postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> None:
    with psycopg.connect(postgres.url(), autocommit=True) as connection:
        connection.execute("CREATE ROLE odd LOGIN SUPERUSER PASSWORD 'a{b}@c:/%d e'")
    host = f"127.0.0.1:{postgres.port}/{postgres.create(next(names)).rpartition('/')[2]}"
    with pytest.raises(ValueError, match="password"):
        open_storage(f"postgresql://odd@{host}")
    monkeypatch.setenv("PGPASSWORD", "a{b}@c:/%d e")
    open_storage(f"postgresql://odd@{host}")
    monkeypatch.delenv("PGPASSWORD")
    quoted = "a%7Bb%7D%40c%3A%2F%25d%20e"
    storage = open_storage(f"postgresql+psycopg://odd:{quoted}@{host}", create=False)
    assert storage.get_all_studies() == []


def test_a_database_is_made_once_and_of_strangers_nothing_is_touched(postgres: Postgres, url: str) -> None:
    with pytest.raises(ValueError, match="no studies"):
        open_storage(url, create=False)
    with ThreadPoolExecutor(4) as pool:  # workers that are started in the same moment
        storages = list(pool.map(open_storage, [url] * 4))
    optuna.create_study(study_name="one", storage=storages[0])
    assert optuna.get_all_study_names(storages[-1]) == ["one"]

    url = postgres.create(next(names))
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("CREATE TABLE studies (patient TEXT)")
        with pytest.raises(ValueError, match="something else than Optuna's studies: studies"):
            open_storage(url)
        tables = connection.execute("SELECT tablename FROM pg_tables WHERE schemaname = 'public'").fetchall()
    assert tables == [("studies",)]


def test_what_a_proxy_cannot_serve(postgres: Postgres, url: str, tmp_path: Path) -> None:
    for where in (str(tmp_path), "grpc://127.0.0.1:13000"):
        with pytest.raises(ValueError, match="a proxy serves a database"):
            serve_proxy(where)
    with socket.create_server(("127.0.0.1", 0)) as used:
        port = used.getsockname()[1]
        with pytest.raises(ValueError, match=f"cannot listen on 127.0.0.1:{port}: the port is in use"):
            serve_proxy(url, port=port)
    with pytest.raises(ValueError, match=r"cannot listen on 192\.0\.2\.1:"):
        serve_proxy(url, host="192.0.2.1", port=free_port())


def test_a_proxy_stops_on_ctrl_c_also_while_its_database_is_away(postgres: Postgres, url: str) -> None:
    port = free_port()
    with proxy(url, port) as process:
        storage: BaseStorage = open_storage(f"grpc://127.0.0.1:{port}", patience=30)
        assert storage.get_all_studies() == []

        def wait() -> None:
            with pytest.raises((ServerLost, grpc.RpcError)):
                storage.get_all_studies()

        postgres.stop()
        try:
            waiting = threading.Thread(target=wait)
            storage.patience = 0.0  # type: ignore[attr-defined]
            waiting.start()
            time.sleep(0.5)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
            waiting.join(10)
        finally:
            postgres.start()


IMPATIENT = """
import sys
from search.execution import storage
storage.Database.patience = 0.5
storage.serve_proxy(sys.argv[1], port=int(sys.argv[2]))
"""


def test_workers_wait_for_the_database_behind_a_proxy_that_gave_up(postgres: Postgres, url: str) -> None:
    port = free_port()
    with python(IMPATIENT, url, str(port)):
        storage: BaseStorage = open_storage(f"grpc://127.0.0.1:{port}", patience=30)
        study = optuna.create_study(study_name="study", storage=storage)
        for _ in range(2):
            postgres.stop()
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(study.ask)
                time.sleep(2)
                assert not asked.done()
                postgres.start()
                study.tell(asked.result(), 1.0)


def test_what_the_database_behind_a_proxy_refuses_reaches_the_worker(url: str) -> None:
    port = free_port()
    with proxy(url, port):
        storage: BaseStorage = open_storage(f"grpc://127.0.0.1:{port}", patience=30)
        study = optuna.create_study(study_name="study", storage=storage)
        trial = study.ask()
        with psycopg.connect(url, autocommit=True) as connection:
            # PostgreSQL's own words for a full disk.
            connection.execute(
                "CREATE FUNCTION full_disk() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN RAISE EXCEPTION "
                "'could not extend file: No space left on device' USING ERRCODE = 'disk_full'; END $$"
            )
            connection.execute(
                "CREATE TRIGGER full_disk BEFORE INSERT ON trial_user_attributes FOR EACH ROW EXECUTE FUNCTION full_disk()"
            )
            with pytest.raises(StorageInternalError, match="No space left on device") as error:
                trial.set_user_attr("key", 1)
            problem = disk_problem(error.value)
            assert problem is not None and "Free or mend the disk" in problem and "\n" not in problem
            assert PASSWORD not in problem
            connection.execute("DROP TRIGGER full_disk ON trial_user_attributes")
        trial.set_user_attr("key", 1)
        study.tell(trial, 1.0)


class CountedLock:
    """A lock that knows who has asked for it."""

    def __init__(self) -> None:
        self.asked: list[int] = []
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self.asked.append(threading.get_ident())
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def test_threads_of_a_proxy_that_wait_share_one_reading(tmp_path: Path) -> None:
    where = f"sqlite:///{tmp_path / 'study.db'}"
    database = open_storage(where)
    assert isinstance(database, Database)
    shared, elsewhere = SharedReads(database), open_storage(where)
    study_id = shared.create_new_study([StudyDirection.MAXIMIZE], "shared")
    begun, go_on, turn = threading.Event(), threading.Event(), CountedLock()
    shared._reading = turn  # type: ignore[assignment]
    n_readings, read = 0, database._get_trials

    def slow(*args: Any, **kwargs: Any) -> Any:
        nonlocal n_readings
        n_readings += 1
        trials = read(*args, **kwargs)
        begun.set()
        assert go_on.wait(30)
        if n_readings == 2:
            raise ValueError("the second reading fails")
        return trials

    database._get_trials = slow  # type: ignore[method-assign]
    with ThreadPoolExecutor(8) as pool:
        first = pool.submit(shared.get_all_trials, study_id)
        assert begun.wait(30)
        # What is written now, past the proxy, must be seen by all that ask from now on, though a reading is under way.
        elsewhere.create_new_trial(study_id)
        others = [pool.submit(shared.get_all_trials, study_id) for _ in range(6)]
        while len(turn.asked) < 7:
            time.sleep(0.01)
        go_on.set()
        assert first.result() == []
        errors = [future.exception() for future in others]
        seen = [future.result() for future in others if future.exception() is None]
    # One of the six reads and fails, another one reads again for all that are left.
    assert [type(error) for error in errors if error] == [ValueError] and n_readings == 3
    assert [len(trials) for trials in seen] == [1] * 5
    assert len(shared.get_all_trials(study_id)) == 1 and n_readings == 4
