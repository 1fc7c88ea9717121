"""Options that several commands have, and the folders and studies that they name."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sb3_aarl.search.training.shipped import find_file
from typer import Argument, Option

if TYPE_CHECKING:
    from optuna import Study

SearchFile = Annotated[
    Path,
    Argument(
        callback=lambda path: find_file(path, searches=True),
        help="Configuration of a search: a file, or a shipped one by name, such as demo.",
    ),
]
BENCHMARK = Path("runs/benchmark")
SHIPPED = "a file, or a shipped one by name, such as aarl_state"
Imports = Annotated[str, Option(help="Modules of yours that register environments, such as my_env,other.")]
DryRun = Annotated[
    bool, Option("--dry-run", help="Start nothing: measure some steps here, and show what all runs would cost.")
]
Json = Annotated[bool, Option("--json", help="Print JSON instead.")]
Folder = Annotated[Path | None, Option(help="Folder of the search. Default: runs/ and the name of the configuration file.")]
Benchmark = Annotated[Path, Argument(help="Folder of a benchmark.")]
SearchFolder = Annotated[
    Path | None, Argument(help="Folder of a search, or its configuration file. Not needed with --storage.")
]
Storage = Annotated[
    str | None,
    Option(
        help="URL of a database, such as postgresql://user@host/db; the study has the name of the search's folder, which need "
        "not be there. Default: SQLite in the folder."
    ),
]
Workers = Annotated[int, Option(help="Runs at the same time, each in a process of its own.", min=1)]
Threads = Annotated[int | None, Option(help="Threads of each run. Default: the configuration's.", min=1)]


def modules(imports: str) -> list[str]:
    """The modules that ``--imports`` names."""
    return imports.split(",") if imports else []


def search_folder(search: Path | None) -> Path | None:
    """The folder of a search, which is named itself or by its configuration file."""
    if search is None:
        return None
    default = Path("runs") / search.stem
    is_config = search.suffix.lower() in (".yml", ".yaml") or (not search.exists() and default.exists())
    return default if is_config else search


def open_study(search: Path | None, storage: str | None) -> "tuple[Study, Path]":
    """The study in a folder, or the one of the folder's name in a database, and its folder."""
    from sb3_aarl.search.execution.storage import load_study, open_storage

    path = search_folder(search)
    opened = open_storage(path, storage, create=False)
    study = load_study(opened, path.name if path is not None and storage is not None else None)
    return study, path or Path("runs") / study.study_name
