"""Text files: YAML, of which nothing is evaluated, and files that are replaced atomically."""

import json
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml


class ConfigError(ValueError):
    """A configuration cannot be used: one line for each problem, with the file, the key and what is wrong with it."""


class _Loader(yaml.SafeLoader):
    """Also reads ``1e-3`` as a number, which is text in YAML 1.1, ``1e5`` as an integer; refuses a key that appears twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.value != "<<"]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key!r} appears twice", node.start_mark)
        return super().construct_mapping(node, deep)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        number = super().construct_yaml_float(node)
        return int(number) if number.is_integer() else number


_FLOAT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read the mapping in a YAML file. Nothing in it is evaluated; a ConfigError names the file and, if known, the line."""
    try:
        values = yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
        json.dumps(values, default=str)  # refuses a mapping or list that contains itself
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{path}: {line}{error.problem}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:  # not UTF-8, or no date, such as 2020-13-45
        raise ConfigError(f"{path}: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: must hold a mapping, not {values!r}")
    return values


def replace_text(path: Path, text: str) -> None:
    """Write a file atomically, and create its folder. Other processes may read or write it at any time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")) as unfinished:
        unfinished.write_text(text, encoding="utf-8", newline="")


@contextmanager
def replacing(path: Path, unfinished: Path) -> Iterator[Path]:
    """Replace a file in one step by ``unfinished``, of which nothing is left if that fails: a full disk has room again."""
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
