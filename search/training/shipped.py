"""The files of ``zoo_configs/`` by name."""

import difflib
from importlib.resources import files
from pathlib import Path

ZOO = Path(str(files("sb3_aarl.zoo_configs")))
SEARCHES = ZOO / "search"


def shipped_files(searches: bool) -> dict[str, Path]:
    """The shipped files by name, such as ``paper/aarl_state``: configurations of searches, or hyper-parameters."""
    folder = SEARCHES if searches else ZOO
    files = [path for path in sorted(folder.rglob("*.yml")) if searches or SEARCHES not in path.parents]
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in files}


def find_file(path: Path, searches: bool = False, folder: Path = Path()) -> Path:
    """A file that is there, or else the shipped one of that name, such as ``demo``, ``aarl_state`` or ``paper/aarl_state``."""
    if (folder / path).is_file():
        return folder / path
    files = shipped_files(searches)
    by_name = {file.stem: file for file in files.values()} | files
    name = path.as_posix().removesuffix(".yml")
    if name not in by_name:
        nearest = difflib.get_close_matches(name, by_name, n=1) or list(files)
        raise ValueError(f"{path} is no file, nor the name of a shipped one, nearest: {', '.join(nearest)}")
    return by_name[name]
