"""Where a search keeps its study: SQLite in its folder, or any database that Optuna knows."""

from pathlib import Path
from typing import Any

import optuna
from optuna.storages import RDBStorage

STUDY_FILE = "study.db"
# Readers such as the dashboard hold up a commit of SQLite: it waits so many seconds for them.
SQLITE_TIMEOUT = 120


def open_storage(folder: Path | None, url: str | None = None, create: bool = True) -> RDBStorage:
    """
    Open the storage of a search.

    :param folder: Folder of the search, whose ``study.db`` is used unless a URL is given
    :param url: URL of a database, such as ``postgresql://user@host/db``; passwords are better kept in ``PGPASSWORD``
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
        url = f"sqlite:///{path}"
    engine: dict[str, Any] = {"pool_pre_ping": True}  # a connection that a restarted server has closed is opened again
    if url.startswith("sqlite"):
        engine = {"connect_args": {"timeout": SQLITE_TIMEOUT}}
    return RDBStorage(url, engine_kwargs=engine)


def load_study(storage: RDBStorage, name: str | None = None) -> optuna.Study:
    """
    Load a study.

    :raises ValueError: naming the studies that are there, when it is not one of them
    """
    names = optuna.get_all_study_names(storage)
    if name is None and len(names) == 1:
        name = names[0]
    if name not in names:
        wanted = "which study?" if name is None else f"there is no study {name!r}."
        raise ValueError(f"{wanted} The storage has: {', '.join(names) or 'none'}")
    return optuna.load_study(study_name=name, storage=storage)
