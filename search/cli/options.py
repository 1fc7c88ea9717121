"""Options that several commands have, and the folders and studies that they name."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

if TYPE_CHECKING:
    from optuna import Study

    from search.studies.config import SearchConfig

ZOO = Path(__file__).parents[2] / "zoo_configs"

SearchFile = Annotated[Path, Argument(help="Configuration of a search, such as zoo_configs/search/demo.yml.")]
Folder = Annotated[Path | None, Option(help="Folder of the search. Default: runs/ and the name of the configuration file.")]
Benchmark = Annotated[Path, Argument(help="Folder of a benchmark.")]
SearchFolder = Annotated[
    Path | None, Argument(help="Folder of a search, or its configuration file. Default: the only one in runs/.")
]
SearchFolders = Annotated[
    list[Path] | None, Argument(help="Folders of searches, or their configuration files. Default: the only one in runs/.")
]
Storage = Annotated[
    str | None, Option(help="URL of a database, such as postgresql://user@host/db. Default: SQLite in the search's folder.")
]
StudyName = Annotated[str | None, Option(help="Name of the study. Default: the folder's name.")]
StudyNames = Annotated[list[str] | None, Option(help="Name of a study; may be repeated. Default: the folder's name.")]
Workers = Annotated[int, Option(help="Runs at the same time, each in a process of its own.", min=1)]
Threads = Annotated[int | None, Option(help="Threads of each run. Default: the configuration's.", min=1)]
Patterns = Annotated[
    list[str] | None,
    Option(help='A pattern beside those of table 5, in notation or by name, such as "{s_t} -> {r_t}"; may be repeated.'),
]
Ties = Annotated[bool, Option("--ties-without", help="Count n_target = n_source as not n_target > n_source.")]
Top = Annotated[int, Option(help="How many of the best candidates the metrics are compared on.", min=1)]


def read_config(path: Path, **changes: Any) -> "SearchConfig":
    """The configuration of a search, with the values of options over those of its file; that its runs can start is checked."""
    from search.studies.config import load_config
    from search.studies.search import make_run
    from search.training.run import check_run

    config = load_config(path).model_copy(update={key: value for key, value in changes.items() if value is not None})
    check_run(make_run(config, config.environment, None, config.seeds[0]))
    return config


def run_folder(config: Path, folder: Path | None) -> Path:
    """The folder of a search: ``folder`` if the user named one."""
    return Path("runs") / config.stem if folder is None else folder


def search_folder(folder: Path | None, storage: str | None) -> Path | None:
    """The folder of a search, named itself or by its configuration file, or the only one; None if there is a storage only."""
    from search.execution.storage import STUDY_FILE

    if folder is not None:
        return run_folder(folder, None) if folder.suffix in (".yml", ".yaml") else folder
    if storage is not None:
        return None
    folders = sorted(path.parent for path in Path("runs").glob(f"*/{STUDY_FILE}"))
    if len(folders) != 1:
        names = ", ".join(map(str, folders)) or "none"
        raise ValueError(f"name the folder of a search, or its --storage; in runs/ there are: {names}")
    return folders[0]


def open_studies(
    folders: Sequence[Path | None] | None, storage: str | None, names: Sequence[str | None] | None
) -> "dict[str, tuple[Study, Path]]":
    """Studies and their folders by name, one of each folder or several of one storage; by folder where names are alike."""
    from search.execution.storage import load_study, open_storage

    folders, names = folders or [None], names or [None]
    if names != [None] and len(folders) > 1:
        raise ValueError(f"--study names studies of one folder or --storage, but there are {len(folders)} folders")
    found = []
    for folder in folders:
        path = search_folder(folder, storage)
        opened = open_storage(path, storage, create=False)
        for name in names:
            # Studies and folders are called alike, unless both are named.
            study = load_study(opened, name or (path.name if path else None))
            found.append((study, path or Path("runs") / study.study_name))
    alike = len({study.study_name for study, _ in found}) < len(found)
    studies = {str(path) if alike else study.study_name: (study, path) for study, path in found}
    if len(studies) < len(found):
        raise ValueError(f"a study is named twice: {', '.join(study.study_name for study, _ in found)}")
    return studies
