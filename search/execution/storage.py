"""Storages of studies: an embedded journal by default, SQLite, databases and Optuna's proxy by URL."""

import contextlib
import functools
import json
import logging
import math
import os
import re
import sys
import threading
import time
import uuid
import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import optuna
from optuna.exceptions import DuplicatedStudyError, ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages._cached_storage import _CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.storages.journal._file import BaseJournalFileLock, get_lock_file
from optuna.study import StudyDirection
from optuna.trial import TrialState
from sqlalchemy import URL, create_engine, inspect
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError, PendingRollbackError, SQLAlchemyError

from search.execution.passwords import storage_name, without_password

if sys.platform != "win32":
    import fcntl

logger = logging.getLogger(__name__)

JOURNAL = "journal.log"
# Seconds: SQLite's lock is held for milliseconds, but many workers may queue for it.
SQLITE_TIMEOUT = 120
# Seconds between two signs of life of a worker (paper-sized trials run for hours).
HEARTBEAT_INTERVAL = 60
# Seconds that a call of a storage waits for a server that is away: a restart, a failing network.
PATIENCE = 600.0
# Seconds between two attempts: the first pause, each next one twice as long, the longest.
PAUSES = (0.1, 5.0)
# Seconds that a proxy has to answer when it is opened.
PROXY_TIMEOUT = 5.0
# Calls that the proxy serves at a time, each with a connection of its own. Those that wait together share a reading: 32
# workers had 7.0 trials a second with 34, 6.0 with 16 and 5.9 with 4; 5.2 with 4 before readings were shared.
PROXY_THREADS = 32
# Seconds between two looks at signs of life after which watching begins anew, where the signs come faster.
LATE_SECONDS = 10.0
# User attribute of a study.
ID_KEY = "id"
# System attribute of a trial: changes with each sign of life of its worker.
HEARTBEAT_KEY = "heartbeat"
# How every journal of Optuna begins.
JOURNAL_BEGIN = b'{"op_code":'

T = TypeVar("T")


class KernelLock(BaseJournalFileLock):
    """
    A journal's lock that the operating system frees when its holder dies.

    Optuna's own locks are files: after a SIGKILL the others wait half a minute for them, and with a relative path
    forever.

    :param path: The lock's file, made if it is not there
    """

    def __init__(self, path: Path):
        self._path = path

    def acquire(self) -> bool:
        """Wait for the lock and take it."""
        descriptor = os.open(self._path, os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except BaseException:  # Ctrl-C
            os.close(descriptor)
            raise
        self._descriptor = descriptor
        return True

    def release(self) -> None:
        """Give the lock back."""
        os.close(self._descriptor)


class JournalFile(JournalFileBackend):
    """
    A journal that survives a line cut short, which a SIGKILL or a full disk leaves in the middle of a long one.

    Optuna would write its next line behind the rest of that one, and never read the file again.

    :param path: The file
    :param lock: Its lock
    """

    def __init__(self, path: Path, lock: BaseJournalFileLock):
        super().__init__(str(path), lock)
        self._path = path
        self._file_lock = lock

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Cut off what was never finished, then write."""
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        with get_lock_file(self._file_lock), open(self._path, "rb+", opener=_appending) as file:
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    file.seek(0)
                    file.truncate(file.read().rfind(b"\n") + 1)
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())


def _appending(path: str, flags: int) -> int:
    """Opens a file that is there; what others append meanwhile is not written over."""
    return os.open(path, flags | os.O_APPEND)


class ServerLost(StorageInternalError):
    """A server could not be reached for as long as a call may wait; the message says which, how long and why."""


class _Attempts(threading.local):
    """
    When this thread's attempts at a call were begun and lost: an answer that got lost on its way may have been a yes.
    None outside of a call. Calls inside a call do not wait by themselves, or their times would multiply.
    """

    lost: list[tuple[datetime, datetime]] | None = None


_attempts = _Attempts()
_away: dict[str, object] = {}  # servers that are waited for, so that many threads log it once


def outlast(call: Callable[[], T], is_lost: Callable[[Exception], bool], patience: Callable[[], float], server: str) -> T:
    """
    Repeat a call until the server answers.

    :param call: The call
    :param is_lost: Whether an exception says that the server cannot be reached
    :param patience: Gives the seconds to go on trying from the beginning of the first attempt, which a proxy's wait for its
        own database is part of; 0 for one attempt. Asked each time, for it may change while the call waits
    :param server: Its name in messages, without a password
    :raises ServerLost: when time is up
    """
    if _attempts.lost is not None:
        return call()
    _attempts.lost = []
    began, lost, pause, token = time.monotonic(), False, PAUSES[0], object()
    try:
        while True:
            tried = datetime.now()
            try:
                result = call()
            except Exception as error:
                if not is_lost(error):
                    raise
                now, seconds = time.monotonic(), patience()
                if not lost:
                    lost = True
                    if seconds and _away.setdefault(server, token) is token:
                        logger.warning("Cannot reach %s, trying again for %.0f s: %s", server, seconds, root_cause(error))
                if now - began >= seconds:
                    tried_for = f", tried for {now - began:.0f} s" if seconds else ""
                    raise ServerLost(f"cannot reach {server}{tried_for}: {root_cause(error)}") from None
                _attempts.lost.append((tried, datetime.now()))
                time.sleep(min(pause, began + seconds - now))
                pause = min(2 * pause, PAUSES[1])
            else:
                if lost and _away.pop(server, None) is not None:
                    logger.warning("%s is back after %.0f s", server, time.monotonic() - began)
                return result
    finally:
        _attempts.lost = None
        if _away.get(server) is token:
            del _away[server]


def _outlasting(method: Callable[..., Any]) -> Callable[..., Any]:
    """The method of an :class:`Outlasting` storage, repeated while its server is away."""

    @functools.wraps(method)
    def call(storage: "Outlasting", *arguments: Any, **keywords: Any) -> Any:
        def patience() -> float:
            if storage.gave_up:  # who puts away what it has shall not wait as long once more
                return 0.0
            # What a late sign of life says is no longer true, and the end of a trial waits for the thread that gives them.
            return min(storage.patience, storage.heartbeat_interval) if method.__name__ == "_beat" else storage.patience

        try:
            result = outlast(lambda: method(storage, *arguments, **keywords), storage.is_lost, patience, storage.server)
        except ServerLost:
            storage.gave_up = storage.gave_up or method.__name__ != "_beat"
            raise
        except Exception as error:
            refused = storage.refusal(error)
            if refused is None:
                raise
            raise refused from None
        storage.gave_up = False  # a proxy lives on, and the next outage is another one
        return result

    return call


class _Watch:
    """
    For how long signs have not changed, as far as this process kept watching: it may have slept, or had no network.

    :param gap: Seconds between two looks after which watching begins anew, or ``LATE_SECONDS`` if that is longer. A look
        vouches for half of it at most: where signs come faster than this process can look, it takes more looks. Those that
        follow faster than a twentieth of it are saved
    """

    def __init__(self, gap: float):
        self._gap = gap
        self._looked = -math.inf
        self._seconds: dict[int, tuple[Any, float]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _Watch, (self._gap,)  # another process has another clock

    def unchanged(self, look: Callable[[], dict[int, Any]]) -> dict[int, tuple[Any, float]]:
        """
        :param look: Reads the sign of each key
        :return: The sign of each key, and for how many seconds it has not changed; empty soon after another look
        """
        if time.monotonic() - self._looked < self._gap / 20:
            return {}
        signs = look()
        now = time.monotonic()
        seconds, self._looked = now - self._looked, now
        if seconds > max(self._gap, LATE_SECONDS):
            self._seconds = {}
        known, seconds = self._seconds, min(seconds, self._gap / 2)
        self._seconds = {
            key: (sign, known[key][1] + seconds) if key in known and known[key][0] == sign else (sign, 0.0)
            for key, sign in signs.items()
        }
        return self._seconds


class WithHeartbeat(BaseStorage, BaseHeartbeat):
    """
    A storage with signs of life: a system attribute of the trial that changes with each of them.

    A trial is stale when its sign has not changed while this process watched for two intervals of the trial's own worker,
    which the sign names. No clocks are compared, and nobody is blamed for a time in which the server, the network or this
    process stood still. So somebody has to look once an interval at least, as workers do that wait for a place: as long as
    none waits, nobody needs the place of a stale trial. Trials without any sign (of a user's own ``ask``) are never stale.
    """

    heartbeat_interval: int = HEARTBEAT_INTERVAL

    def record_heartbeat(self, trial_id: int) -> None:
        """Give a sign of life for a trial; for one that is finished it does nothing. Never fails."""
        try:
            self._beat(trial_id)
        except UpdateFinishedTrialError:
            pass
        except Exception as error:  # a full disk, a server that is away: the thread has to live until it is over
            logger.warning("No sign of life could be given: %s", root_cause(error))

    def _beat(self, trial_id: int) -> None:
        self.set_trial_system_attr(trial_id, HEARTBEAT_KEY, [time.time_ns(), self.heartbeat_interval])

    def _signs(self, study_id: int) -> dict[int, Any]:
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        return {trial._trial_id: trial.system_attrs[HEARTBEAT_KEY] for trial in running if HEARTBEAT_KEY in trial.system_attrs}

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        watches: dict[int, _Watch] = vars(self).setdefault("_watches", {})
        watch = watches.setdefault(study_id, _Watch(self.heartbeat_interval))
        unchanged = watch.unchanged(lambda: self._signs(study_id))
        return [trial_id for trial_id, (sign, seconds) in unchanged.items() if seconds >= 2 * sign[1]]

    def get_heartbeat_interval(self) -> int:
        """Seconds between two signs of life."""
        return self.heartbeat_interval

    def get_heartbeat_stale_trial_callback(self) -> None:
        """None: the search gives a stale trial's place out again by itself."""


class Outlasting(WithHeartbeat):
    """
    A storage that outlives its server: every call waits until it is back, ``patience`` seconds at most.

    A call whose answer was lost may have been carried out, so a repeated one takes its own work for success:

    - A trial that has finished with the same state and values, or that was set running in the moment of the lost attempt
      by the clock of who sets it (of the proxy, where there is one; if the clocks differ, the trial is left without a
      worker, and the search fails it).
    - A study of the same name, and a study that is no longer there to be deleted.
    - A repeated ``create_new_trial`` may leave a running trial without a worker, which the search fails, or enqueue twice.
    """

    patience: float = PATIENCE
    gave_up: bool = False  # whether a call has waited in vain, and none has been answered since
    server: str

    def __init_subclass__(cls) -> None:
        private = ("_beat", "_create_new_trial", "_set_trial_param", "_get_trials", "_get_best_trial_id", "_signs")
        public = [name for name, value in vars(BaseStorage).items() if not name.startswith("_") and callable(value)]
        for name in (*public, *private):
            if hasattr(cls, name):
                setattr(cls, name, _outlasting(getattr(cls, name)))

    @abstractmethod
    def is_lost(self, error: Exception) -> bool:
        """Whether an exception says that the server is away, and not that it refuses what it is asked for."""

    def refusal(self, error: Exception) -> StorageInternalError | None:
        """What to raise in the place of a server's own exception, None for that itself."""
        return None

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Sequence[float] | None = None) -> bool:
        """As in Optuna."""
        try:
            done = super().set_trial_state_values(trial_id, state, values)  # type: ignore[safe-super]
        except UpdateFinishedTrialError:
            trial = self.get_trial(trial_id) if _attempts.lost else None
            if trial is None or trial.state != state or (values is not None and list(trial.values or ()) != list(values)):
                raise
            return True
        if not done and _attempts.lost:
            started = self.get_trial(trial_id).datetime_start
            return started is not None and any(begun <= started <= lost for begun, lost in _attempts.lost)
        return done

    def create_new_study(self, directions: Sequence[StudyDirection], study_name: str | None = None) -> int:
        """As in Optuna."""
        try:
            return super().create_new_study(directions, study_name)  # type: ignore[safe-super]
        except DuplicatedStudyError:
            if not _attempts.lost or study_name is None:
                raise
            return self.get_study_id_from_name(study_name)

    def delete_study(self, study_id: int) -> None:
        """As in Optuna."""
        try:
            super().delete_study(study_id)  # type: ignore[safe-super]
        except KeyError:
            if not _attempts.lost:
                raise


class Database(Outlasting, RDBStorage):
    """
    A database. Beside the signs of life that workers behind a proxy see too, it has Optuna's own, for Optuna's own tools:
    a trial that has only these is stale when the database's clock says so, and still does after this process watched for
    two more intervals, in which a live worker would have come back from an outage.

    :param url: Its URL
    :param heartbeat_interval: Seconds between two signs of life
    :param skip_table_creation: Whether it has Optuna's tables already
    """

    heartbeat_interval: int

    def __init__(self, url: URL, heartbeat_interval: int = HEARTBEAT_INTERVAL, skip_table_creation: bool = False):
        self.server = without_password(str(url))
        # Ping: a connection that was lost while nobody used it costs no attempt.
        engine_kwargs = {"connect_args": _connect_args(url), "pool_size": PROXY_THREADS, "pool_pre_ping": True}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)  # heartbeats are, says Optuna
            super().__init__(
                url.render_as_string(hide_password=False),
                engine_kwargs,
                heartbeat_interval=heartbeat_interval,
                skip_table_creation=skip_table_creation,
            )

    def is_lost(self, error: Exception) -> bool:
        """Whether the connection was lost or refused for now."""
        return _is_lost(error)

    def _beat(self, trial_id: int) -> None:
        RDBStorage.record_heartbeat(self, trial_id)
        super()._beat(trial_id)

    def _signs(self, study_id: int) -> dict[int, Any]:
        of_optuna = dict.fromkeys(RDBStorage._get_stale_trial_ids(self, study_id), (None, self.heartbeat_interval))
        return of_optuna | super()._signs(study_id)


def _is_lost(error: BaseException | None) -> bool:
    """Whether a database's exception, or what it came from, is a lost or refused connection."""
    if not isinstance(error, StorageInternalError | SQLAlchemyError) or isinstance(error, ServerLost):
        return False
    while error is not None:
        if isinstance(error, DBAPIError):
            if error.connection_invalidated:
                return True
            if type(error.orig).__module__.startswith("psycopg"):
                code = getattr(error.orig, "sqlstate", None) or getattr(error.orig, "pgcode", None)
                # Connection exceptions, shutdowns and starts, too many connections.
                if code is not None and code.startswith(("08", "57P01", "57P02", "57P03", "53300")):
                    return True
                if code is None and error.statement is None:  # while connecting, where errors have no code
                    text = str(error.orig)
                    for_now = ("starting up", "shutting down", "recovery", "not yet accepting", "too many", "terminating")
                    return "FATAL" not in text or any(words in text for words in for_now)
        error = error.__cause__ or error.__context__
    return False


class Proxy(Outlasting, GrpcStorageProxy):
    """
    Optuna's proxy in front of a database.

    :param host: Host, an IPv6 address in brackets
    :param port: Port
    :param heartbeat_interval: Seconds between two signs of life
    """

    def __init__(self, host: str, port: int, heartbeat_interval: int = HEARTBEAT_INTERVAL):
        self.server = f"grpc://{host}:{port}"
        self.heartbeat_interval = heartbeat_interval
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            super().__init__(host=host, port=port)

    def _setup(self) -> None:
        import grpc
        from optuna.storages._grpc.auto_generated.api_pb2_grpc import StorageServiceStub
        from optuna.storages._grpc.client import GrpcClientCache

        options = [
            ("grpc.max_receive_message_length", -1),
            # Else a proxy that is back after minutes is not tried for two more.
            ("grpc.max_reconnect_backoff_ms", int(1000 * PAUSES[1])),
            # Finds out that the network is gone. More often than every 300 s is more than Optuna's own server accepts.
            ("grpc.keepalive_time_ms", 310_000),
        ]
        self._channel = grpc.insecure_channel(f"{self._host}:{self._port}", options)
        self._stub = StorageServiceStub(self._channel)
        self._cache = GrpcClientCache(self._stub)

    def check(self) -> None:
        """
        Whether a proxy answers.

        :raises grpc.RpcError: when nobody does
        :raises ValueError: when it is no proxy of Optuna
        """
        import grpc
        from optuna.storages._grpc.auto_generated.api_pb2 import GetStudyIdFromNameRequest

        try:
            self._stub.GetStudyIdFromName(GetStudyIdFromNameRequest(study_name=""), timeout=PROXY_TIMEOUT)
        except grpc.RpcError as error:
            if error.code() == grpc.StatusCode.UNIMPLEMENTED:
                raise ValueError("what answers is no proxy of Optuna") from None
            if error.code() != grpc.StatusCode.NOT_FOUND:
                raise

    def is_lost(self, error: Exception) -> bool:
        """Whether nobody answers, or the proxy stopped in the middle."""
        import grpc

        lost = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED, grpc.StatusCode.DEADLINE_EXCEEDED)
        return isinstance(error, grpc.RpcError) and error.code() in lost

    def refusal(self, error: Exception) -> StorageInternalError | None:
        """What stands behind the proxy, such as a full disk, in its own words."""
        import grpc

        if not isinstance(error, grpc.RpcError) or self.is_lost(error):
            return None
        return StorageInternalError(f"{self.server}: {root_cause(error)}")


class Journal(WithHeartbeat, JournalStorage):
    """
    An embedded journal.

    :param backend: Its file
    :param heartbeat_interval: Seconds between two signs of life
    """

    def __init__(self, backend: JournalFile, heartbeat_interval: int = HEARTBEAT_INTERVAL):
        super().__init__(backend)
        self.heartbeat_interval = heartbeat_interval


def open_storage(
    where: str | Path, create: bool = True, patience: float = 0.0, heartbeat_interval: int = HEARTBEAT_INTERVAL
) -> BaseStorage:
    """
    Open a storage. Each call of one with a server waits for it where it is away, see :class:`Outlasting`.

    :param where: A folder, for the embedded journal in it, which is safe for several processes of one machine; a file
        that ends in ``.log``, for a journal; the URL of a database, such as ``sqlite:///study.db`` or
        ``postgresql://user:password@host/database``; or ``grpc://host:port`` of a proxy (:func:`serve_proxy`).
        PostgreSQL also takes the password from ``PGPASSWORD`` or ``~/.pgpass``, where nobody sees it in a list of processes
    :param create: Whether to make a journal, a file of SQLite, or tables in a database, that are not there
    :param patience: Seconds to wait for a server that cannot be reached; 0 for one attempt
    :param heartbeat_interval: Seconds between two signs of life of the trials that run in this process
    :raises ValueError: when it cannot be opened: nobody answers, or it is no storage, or one of another version of Optuna.
        Passwords are left out of the message. Nothing that is there and no storage is changed
    """
    where = str(where)
    shown = storage_name(where)
    try:
        if "://" not in where:
            return _open_journal(where, create, heartbeat_interval)
        if where.startswith("grpc:"):
            proxy = _make_proxy(where, heartbeat_interval)
            outlast(proxy.check, proxy.is_lost, lambda: patience, proxy.server)
            return proxy
        url = _parse_url(where)
        return outlast(lambda: _open_database(url, create, heartbeat_interval), _is_lost, lambda: patience, shown)
    except ServerLost as error:
        raise ValueError(str(error)) from None
    except Exception as error:  # whatever a driver raises
        raise ValueError(f"cannot open the storage {shown}: {root_cause(error)}") from None


def _open_journal(where: str, create: bool, heartbeat_interval: int) -> Journal:
    if re.match(r"\w{2,}:", where):
        raise ValueError("a URL has // after its colon")
    path = Path(where)
    if path.suffix != ".log":
        if path.exists() and not path.is_dir():
            raise ValueError("it is neither a folder nor a journal, which ends in .log")
        path = path / JOURNAL
    if not path.exists() and not create:
        raise FileNotFoundError(f"{path} does not exist")
    if path.exists():
        if not path.is_file():
            raise ValueError(f"{path} is no file")
        with path.open("rb") as file:
            begin = file.read(len(JOURNAL_BEGIN))
        if not begin and not create:
            raise ValueError(f"{path} is empty")
        if not JOURNAL_BEGIN.startswith(begin):
            raise ValueError(f"{path} is no journal of Optuna")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not .lock, the file of Optuna's own lock, which removes what it takes for that of a dead process.
    lock_path = path.with_name(f"{path.name}.flock")
    lock = JournalFileOpenLock(str(path.absolute())) if sys.platform == "win32" else KernelLock(lock_path)
    try:
        return Journal(JournalFile(path, lock), heartbeat_interval)
    except (AssertionError, KeyError, TypeError, ValueError) as error:
        message = f"{path} is no journal of Optuna {optuna.__version__}, or it is damaged"
        raise ValueError(f"{message} ({type(error).__name__}: {error})") from None


def _parse_url(where: str) -> URL:
    """The URL of a database; messages do not repeat it, for it may be the password that is at fault."""
    scheme = where.partition("://")[0]
    try:
        url = make_url(where)
    except Exception:
        raise ValueError(f"malformed URL, {scheme}://user@host:port/database is expected") from None
    if scheme.startswith("sqlite"):
        return url
    if "@" in f"{url.host}{url.database}" or re.search(r"\s", where):
        raise ValueError("malformed URL: in a password, write @ as %40, / as %2F, a space as %20")
    return url.set(drivername="postgresql+psycopg") if scheme in ("postgresql", "postgres") else url


def is_local(where: str) -> bool:
    """
    Whether a storage can be reached from this machine only.

    :param where: As for :func:`open_storage`
    """
    if "://" not in where or where.startswith("sqlite"):
        return True
    host: object = urlsplit(where).hostname
    if not where.startswith("grpc:"):
        url = make_url(where)
        # As PostgreSQL looks for it; without any, and with a path, it is a socket.
        host = url.host or url.query.get("host") or os.environ.get("PGHOST")
    hosts = str(host or "").split(",")
    return all(host in ("", "localhost", "::1") or host.startswith(("127.", "/", "@")) for host in hosts)


def _connect_args(url: URL) -> dict[str, Any]:
    """How to connect, as far as the URL does not say."""
    if url.get_backend_name() == "sqlite":
        return {"timeout": SQLITE_TIMEOUT}
    if not url.drivername.startswith("postgresql+psycopg"):
        return {}
    # Seconds (the last one: milliseconds) after which a server that is silently gone counts as lost.
    silence = {"keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3, "tcp_user_timeout": 60_000}
    return {key: value for key, value in {"connect_timeout": 10, **silence}.items() if key not in url.query}


def _open_database(url: URL, create: bool, heartbeat_interval: int) -> Database:
    is_sqlite = url.get_backend_name() == "sqlite"
    path = Path(url.database or ":memory:")
    if is_sqlite and (path.name == ":memory:" or str(path).startswith("file:")):
        raise ValueError("a file that all workers open is expected, such as sqlite:///study.db")
    if is_sqlite and not create and not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    for attempt in range(3):
        tables = _tables(url)
        if "version_info" in tables:
            return Database(url, heartbeat_interval, skip_table_creation=True)
        if not create:
            raise ValueError("there are no studies in it")
        if "studies" in tables or "trials" in tables or (is_sqlite and tables):
            raise ValueError(f"it holds something else than Optuna's studies: {', '.join(sorted(tables))[:80]}")
        try:
            return Database(url, heartbeat_interval)
        except SQLAlchemyError as error:
            # Another process made the tables in the same moment.
            if _is_lost(error) or attempt == 2:
                raise
            time.sleep(0.5)
    raise AssertionError("unreachable")


def _tables(url: URL) -> list[str]:
    try:
        engine = create_engine(url, connect_args=_connect_args(url))
    except ImportError as error:
        extra = ": pip install sb3-aarl[postgres]" if url.get_backend_name() == "postgresql" else ""
        raise ValueError(f"its driver is not installed ({error}){extra}") from None
    try:
        return inspect(engine).get_table_names()
    finally:
        engine.dispose()


def _make_proxy(where: str, heartbeat_interval: int) -> Proxy:
    parts = urlsplit(where)
    with contextlib.suppress(ValueError):
        if parts.hostname and parts.port and not (parts.username or parts.path.strip("/") or parts.query or parts.fragment):
            host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
            return Proxy(host, parts.port, heartbeat_interval)
    raise ValueError("malformed URL, grpc://host:port is expected")


class SharedReads(_CachedStorage):
    """
    Optuna's memory of a database for many threads: those that wait to read its trials share one reading.

    Each reading is of all unfinished trials with all their parameters, and workers read several times a trial.

    :param database: The database
    """

    def __init__(self, database: RDBStorage):
        super().__init__(database)
        self._reading = threading.Lock()
        self._n_begun = 0
        self._last_read: dict[int, int] = {}  # by study, which of the readings it was

    def _read_trials_from_remote_storage(self, study_id: int) -> None:
        begun_before = self._n_begun
        with self._reading:
            # One that began after this was asked for, and is over, has seen all that the caller may know of.
            if self._last_read.get(study_id, 0) > begun_before:
                return
            self._n_begun += 1
            super()._read_trials_from_remote_storage(study_id)
            self._last_read[study_id] = self._n_begun


def serve_proxy(where: str, host: str = "127.0.0.1", port: int = 13000) -> None:
    """
    Serve a database to many workers through Optuna's gRPC proxy until Ctrl-C: what they read comes out of its memory.

    There is neither a password nor encryption: who reaches the port reads and writes all studies.

    :param where: URL of the database
    :param host: Address to listen on, by default of this machine only
    :param port: Port to listen on
    :raises ValueError: when the storage is no database or cannot be opened, or nobody can listen there
    """
    import grpc
    from optuna.storages._grpc.auto_generated.api_pb2_grpc import add_StorageServiceServicer_to_server
    from optuna.storages._grpc.servicer import OptunaStorageProxyService

    if "://" not in where or where.startswith("grpc:"):
        shown = storage_name(where)
        raise ValueError(f"a proxy serves a database, such as postgresql://user@host/database, and not {shown}")
    database = open_storage(where)
    assert isinstance(database, Database)
    storage = SharedReads(database)
    # Optuna's cache refuses the parameters of trials that it has not seen: those that run while the proxy is restarted.
    for study in storage.get_all_studies():
        storage.get_all_trials(study._study_id, deepcopy=False)
    options = [
        ("grpc.so_reuseport", 0),  # else two proxies share one port
        ("grpc.max_receive_message_length", -1),
    ]

    class Answers(grpc.ServerInterceptor):  # type: ignore[misc]
        """Tells workers what is wrong with the database, so that they wait for it, or name it; gRPC says "unknown"."""

        def intercept_service(self, continuation: Any, details: Any) -> Any:
            handler = continuation(details)
            if handler is None:  # a call that Optuna's proxy does not have
                return None

            def answer(request: Any, context: Any) -> Any:
                try:
                    return handler.unary_unary(request, context)
                except StorageInternalError as error:
                    lost = isinstance(error, ServerLost)
                    context.abort(grpc.StatusCode.UNAVAILABLE if lost else grpc.StatusCode.INTERNAL, root_cause(error))

            return grpc.unary_unary_rpc_method_handler(answer, handler.request_deserializer, handler.response_serializer)

    server = grpc.server(ThreadPoolExecutor(PROXY_THREADS), interceptors=[Answers()], options=options)
    add_StorageServiceServicer_to_server(OptunaStorageProxyService(storage), server)
    try:
        server.add_insecure_port(f"{host}:{port}")
    except RuntimeError:
        problem = "the port is in use, or the address is not one of this machine"
        raise ValueError(f"cannot listen on {host}:{port}: {problem}") from None
    server.start()
    logger.info("Serving %s on grpc://%s:%d", storage_name(where), host, port)
    try:
        server.wait_for_termination()
    except KeyboardInterrupt:
        database.patience = 0.0  # calls that wait for the database must not keep the program
        server.stop(grace=1).wait()


def study_id(study: optuna.Study) -> str:
    """
    What tells a study from an earlier one of its name, whose storage was deleted while its folder was kept.

    :param study: The study; it gets its id with the first call
    """
    if ID_KEY not in study.user_attrs:
        study.set_user_attr(ID_KEY, uuid.uuid4().hex)
    return study.user_attrs[ID_KEY]


def root_cause(error: BaseException) -> str:
    """
    What an exception stems from, in one line without passwords.

    :param error: The exception
    """
    while (cause := error.__cause__ or (error.__context__ if isinstance(error, PendingRollbackError) else None)) is not None:
        error = cause
    details = getattr(error, "details", None)  # of gRPC, whose text is a page
    text = str(details() if callable(details) else getattr(error, "orig", None) or error)
    return without_password(" ".join(text.split())) or type(error).__name__


def load_study(storage: BaseStorage, name: str | None = None) -> optuna.Study:
    """
    A study of the storage.

    :param storage: The storage
    :param name: Its name, None for the only one
    :raises ValueError: naming the studies that there are, when none fits
    """
    names = optuna.get_all_study_names(storage)
    if name is None and len(names) == 1:
        name = names[0]
    if name not in names:
        problem = "which study" if name is None else f"no study {name!r}"
        raise ValueError(f"{problem}: the storage has {', '.join(names) or 'none'}")
    assert name is not None
    return optuna.load_study(study_name=name, storage=storage)
