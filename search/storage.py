"""Storages of studies: an embedded journal by default, SQLite and databases by URL."""

import json
import os
import re
import sys
import uuid
import warnings
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.storages.journal._file import BaseJournalFileLock, get_lock_file
from sqlalchemy.engine import make_url

if sys.platform != "win32":
    import fcntl

JOURNAL = "journal.log"
# Seconds: SQLite's lock is held for milliseconds, but many workers may queue for it.
SQLITE_TIMEOUT = 120
# Seconds between the signs of life that a worker leaves in a database (paper-sized trials run for hours).
HEARTBEAT_INTERVAL = 60
# User attribute of a study.
ID_KEY = "id"


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
        with get_lock_file(self._file_lock), self._path.open("rb+") as file:
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    file.seek(0)
                    file.truncate(file.read().rfind(b"\n") + 1)
                    file.seek(0, os.SEEK_END)
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())


def open_storage(where: str | Path, create: bool = True) -> BaseStorage:
    """
    Open a storage.

    :param where: A folder, for the embedded journal in it, which is safe for several processes of one machine; a file
        that ends in ``.log``, for a journal; or the URL of a database, such as ``sqlite:///study.db`` or
        ``postgresql://user:password@host/database``
    :param create: Whether to make a journal, or a file of SQLite, that is not there
    :raises ValueError: when it cannot be opened; passwords are left out of the message
    """
    where = str(where)
    path = Path(where)
    path = path if path.suffix == ".log" else path / JOURNAL
    try:
        if where.startswith("sqlite"):
            path = Path(make_url(where).database or ":memory:")
        if not create and ("://" not in where or where.startswith("sqlite")) and not path.exists():
            raise FileNotFoundError(f"{path} does not exist")
        if "://" in where:
            connect_args = {"timeout": SQLITE_TIMEOUT} if where.startswith("sqlite") else {}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)  # heartbeats are, says Optuna
                return RDBStorage(where, engine_kwargs={"connect_args": connect_args}, heartbeat_interval=HEARTBEAT_INTERVAL)
        path.parent.mkdir(parents=True, exist_ok=True)
        lock_path = path.with_name(f"{path.name}.lock")
        lock = JournalFileOpenLock(str(path.absolute())) if sys.platform == "win32" else KernelLock(lock_path)
        return JournalStorage(JournalFile(path, lock))
    except Exception as error:  # whatever a driver raises
        raise ValueError(f"cannot open the storage {without_password(where)}: {without_password(str(error))}") from None


def study_id(study: optuna.Study) -> str:
    """
    What tells a study from an earlier one of its name, whose storage was deleted while its folder was kept.

    :param study: The study; it gets its id with the first call
    """
    if ID_KEY not in study.user_attrs:
        study.set_user_attr(ID_KEY, uuid.uuid4().hex)
    return study.user_attrs[ID_KEY]


def without_password(text: str) -> str:
    """
    :param text: A URL, or a message with URLs in it
    :return: The same with the passwords replaced by ``***``
    """
    text = re.sub(r"(://[^:/@\s]*):[^@\s]*@", r"\1:***@", text)
    return re.sub(r"([?&](?:password|passwd|pwd)=)[^&\s]*", r"\1***", text)


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
