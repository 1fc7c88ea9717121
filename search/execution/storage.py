"""Where a search keeps its study: SQLite in its folder, or any database that Optuna knows."""

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import optuna
from filelock import FileLock, Timeout
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage
from sqlalchemy import URL, text
from sqlalchemy.exc import OperationalError

STUDY_FILE = "study.db"
LOCK = "driver.lock"
# PostgreSQL's advisory locks have two numbers: this one, and that of the study.
ADVISORY_LOCK = 5_334_225
# Seconds for which a commit of SQLite waits for readers such as the dashboard.
SQLITE_TIMEOUT = 120


def open_storage(folder: Path | None, url: str | None = None, create: bool = True) -> RDBStorage:
    """
    Open the storage of a search: ``study.db`` in its folder, or the database of a URL such as ``postgresql://user@host/db``;
    passwords are better kept in ``PGPASSWORD``.

    :param create: Whether to make a file of SQLite that is not there
    :raises ValueError: when there is neither a study's file nor a URL
    """
    if url is None:
        if folder is None:
            raise ValueError("name the folder of a search, or the URL of its storage")
        path = folder / STUDY_FILE
        if not create and not path.exists():
            raise ValueError(f"{folder} has no search: {path} does not exist. aarl search starts one")
        folder.mkdir(parents=True, exist_ok=True)
        url = URL.create("sqlite", database=str(path)).render_as_string()  # which quotes `?` and `%`
    engine: dict[str, Any] = {"pool_pre_ping": True}  # reconnects after a restart of the server
    if url.startswith("sqlite"):
        engine = {"connect_args": {"timeout": SQLITE_TIMEOUT}}
    return RDBStorage(url, engine_kwargs=engine)


def load_study(storage: BaseStorage, name: str | None = None) -> optuna.Study:
    """Load a study of one objective by its name, or the only one; a ValueError names those that are there."""
    names = optuna.get_all_study_names(storage)
    if name is None and len(names) == 1:
        name = names[0]
    if name not in names:
        wanted = "which study?" if name is None else f"there is no study {name!r}."
        raise ValueError(f"{wanted} The storage has: {', '.join(names) or 'none'}")
    study = optuna.load_study(study_name=name, storage=storage)
    if len(study.directions) > 1:
        raise ValueError(f"study {name!r} has {len(study.directions)} objectives, a search has one")
    return study


def cause(error: BaseException | None) -> str:
    """The message of the database in one line. Optuna's own message blames invalid data for every error."""
    return str(getattr(error, "__cause__", None) or error).splitlines()[0]


def is_temporary(error: BaseException) -> bool:
    """Whether a database may recover by itself: a server is away, or SQLite's file is locked by another program."""
    problem = error.__cause__ if isinstance(error, StorageInternalError) else None
    is_of_sqlite = isinstance(getattr(problem, "orig", None), sqlite3.Error)
    return isinstance(problem, OperationalError) and ("locked" in str(problem) or not is_of_sqlite)


@contextmanager
def driver_lock(storage: BaseStorage, study_name: str, folder: Path) -> Iterator[None]:
    """
    Hold the locks of a search: that of its folder, and that of its study, which is a file beside a database of SQLite, and the
    database's own in PostgreSQL. A ValueError where another program holds one of them.
    """
    study_id, files = storage.get_study_id_from_name(study_name), [folder / LOCK]
    engine = storage.engine if isinstance(storage, RDBStorage) else None
    if engine is not None and engine.name == "sqlite":
        with engine.connect() as connection:  # SQLite itself knows its file, of which a URL may be a URI
            database = connection.scalar(text("SELECT file FROM pragma_database_list WHERE name = 'main'"))
        if database:
            path = Path(database).resolve()
            files.append(path.with_name(f"{path.name}.{study_id}.lock"))
    with ExitStack() as stack:
        try:
            for path in files:
                stack.enter_context(FileLock(path, timeout=0, fallback_to_soft=False))
        except Timeout:
            raise ValueError(f"another program runs this search: it holds {path}") from None
        if engine is not None and engine.name == "postgresql":
            engine = engine.execution_options(isolation_level="AUTOCOMMIT")
            connection = stack.enter_context(closing(engine.connect()))
            connection.detach()  # else it would return to the pool with the lock
            numbers = {"search": ADVISORY_LOCK, "study": study_id}
            if not connection.scalar(text("SELECT pg_try_advisory_lock(:search, :study)"), numbers):
                raise ValueError(f"another program runs this search: it holds the lock of {study_name!r} in the database")
        yield


def has_driver(storage: BaseStorage, study_name: str, folder: Path) -> bool:
    """Whether a driver runs: on this machine, or on any with PostgreSQL."""
    try:
        with driver_lock(storage, study_name, folder):
            return False
    except ValueError:
        return True
    except OSError:
        return False  # where one can only read
