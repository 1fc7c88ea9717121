"""Options that several commands have, and the folders and studies that they name."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
Folder = Annotated[Path | None, Option(help="Folder of the search. Default: runs/ and the name of the configuration file.")]
Benchmark = Annotated[Path, Argument(help="Folder of a benchmark.")]
SearchFolder = Annotated[
    Path | None, Argument(help="Folder of a search, or its configuration file. Not needed with --storage.")
]
Storage = Annotated[
    str | None,
    Option(
        help="URL of a database, such as postgresql://user@host/db; the study has the name of the search's file; the folder "
        "need not be there. Default: SQLite in the folder."
    ),
]
Workers = Annotated[
    int | None,
    Option(help="Runs at the same time, each in a process of its own.", show_default="1; with Ray or Slurm all", min=1),
]
Threads = Annotated[int | None, Option(help="Threads of each run. Default: the configuration's.", min=1)]
ExecutorName = Annotated[
    Literal["local", "ray", "slurm"],
    Option("--executor", help="Where runs are executed: on this machine, on Ray, or on Slurm."),
]
RayAddress = Annotated[
    str | None, Option(help="A running Ray cluster: auto, or host:port. Default: a Ray of its own on this machine.")
]
Slurm = Annotated[
    list[str] | None,
    Option(help="A parameter of submitit's jobs, such as slurm_partition=gpu or timeout_min=600; may be repeated."),
]
CpusPerRun = Annotated[int | None, Option(help="With Ray or Slurm: cores of each run.", min=1, show_default="1")]
GpusPerRun = Annotated[
    float | None, Option(help="With Ray or Slurm: GPUs of each run; on Ray also 0.25.", min=0, show_default="0")
]


@dataclass(frozen=True)
class Execution:
    """
    Where runs are executed: the values of ``--executor`` and of the options that belong to it.

    :raises ValueError: when an option has no meaning with this executor
    """

    executor: str
    ray_address: str | None
    slurm: list[str] | None
    cpus_per_run: int | None
    gpus_per_run: float | None

    def __post_init__(self) -> None:
        ray_only, slurm_only, both = ["ray_address"], ["slurm"], ["cpus_per_run", "gpus_per_run"]
        for name in {"local": ray_only + slurm_only + both, "ray": slurm_only, "slurm": ray_only}[self.executor]:
            if getattr(self, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} has no meaning with --executor {self.executor}")
        if self.executor == "slurm" and not float(self.gpus_per_run or 0).is_integer():
            raise ValueError(f"--gpus-per-run: Slurm's jobs get whole GPUs, not {self.gpus_per_run}")

    def __str__(self) -> str:
        """The options that were given, each with a space before it; none for this machine."""
        values = {} if self.executor == "local" else vars(self)
        items = [(name, item) for name, value in values.items() for item in (value if isinstance(value, list) else [value])]
        return "".join(f" --{name.replace('_', '-')} {shlex.quote(str(item))}" for name, item in items if item is not None)

    def at_once(self, workers: int | None, n_runs: int) -> int:
        """Runs at the same time: those of ``--workers``; or one here, and all on Ray and Slurm, which queue them."""
        return workers or (1 if self.executor == "local" else n_runs)

    def start(self, at_once: int, folder: Path) -> Any:
        """The executor, for ``with``; files of Slurm's jobs are in a folder ``slurm`` of this one."""
        cpus, gpus = self.cpus_per_run or 1, self.gpus_per_run or 0
        if self.executor == "ray":
            from sb3_aarl.search.execution.ray import RayExecutor

            return RayExecutor(self.ray_address, cpus, gpus)
        if self.executor == "slurm":
            from sb3_aarl.search.execution.slurm import SlurmExecutor

            items = (item.partition("=")[::2] for item in self.slurm or [])
            parameters: dict[str, Any] = {name: int(value) if value.isdigit() else value for name, value in items}
            return SlurmExecutor(folder / "slurm", cpus, int(gpus), **parameters)
        from sb3_aarl.search.execution.executors import LocalExecutor

        return LocalExecutor(at_once)


def modules(imports: str) -> list[str]:
    """The modules that ``--imports`` names."""
    return [name.strip() for name in imports.split(",")] if imports else []


def search_folder(search: Path | None) -> Path | None:
    """The folder of a search, which is named itself or by its configuration file."""
    if search is None:
        return None
    default = Path("runs") / search.stem
    is_config = search.is_file() or search.suffix.lower() in (".yml", ".yaml") or (not search.exists() and default.exists())
    return default if is_config else search


def open_study(search: Path | None, storage: str | None) -> "tuple[Study, Path]":
    """The study in a folder, or the one of the folder's name in a database, and its folder."""
    from sb3_aarl.search.execution.storage import load_study, open_storage

    path = search_folder(search)
    opened = open_storage(path, storage, create=False)
    study = load_study(opened, path.name if path is not None and storage is not None else None)
    return study, path or Path("runs") / study.study_name
