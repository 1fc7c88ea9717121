"""The files of ``zoo_configs/`` by name."""

import difflib
from importlib.resources import files
from pathlib import Path

ZOO = Path(str(files("sb3_aarl.zoo_configs")))
SEARCHES = ZOO / "search"
DEFAULTS = ZOO / "sac_aux.yml"


def find_file(path: Path, searches: bool = False, folder: Path = Path()) -> Path:
    """
    A file that is there, or else the shipped one of that name, such as ``demo``, ``aarl_state`` or ``paper/aarl_state``:
    the configuration of a search, or hyper-parameters.
    """
    if (folder / path).is_file():
        return folder / path
    root = SEARCHES if searches else ZOO
    shipped = [file for file in sorted(root.rglob("*.yml")) if searches or SEARCHES not in file.parents]
    whole = {file.relative_to(root).with_suffix("").as_posix(): file for file in shipped}
    by_name = {file.stem: file for file in shipped} | whole
    name = path.as_posix().removesuffix(".yml")
    if name not in by_name:
        nearest = difflib.get_close_matches(name, by_name, n=1)
        hint = f", nearest: {nearest[0]}" if nearest else f": {', '.join(whole)}"
        raise ValueError(f"{folder / path} is no file, nor the name of a shipped one{hint}")
    return by_name[name]
