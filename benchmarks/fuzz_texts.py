"""Hostile notations and configurations for fuzz.py, made at random out of real ones."""

import copy
import math
import random
import re
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_aarl import AuxLoss, catalog
from search.evolution import space
from search.training import config

# Seconds of processor time, and bytes of memory more than before, that one input may take.
SECONDS = 5.0
BYTES = 2**29


class UnboundedError(Exception):
    """An input took too much time or memory, or an error was not one clear line."""


def bounded(attempt: Callable[[], None], longest_error: int) -> str:
    """
    What came of an input: ``read`` or ``refused``.

    :param attempt: Reads it
    :param longest_error: Characters that the message of a ValueError may have
    :raises UnboundedError: when it took too much, or was not refused in one line
    """
    began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        attempt()
        outcome = "read"
    except ValueError as error:
        outcome, message = "refused", str(error)
        if not message or len(message) > longest_error or not message.isprintable():
            raise UnboundedError(f"an error that is no clear line: {message[:2000]!a}") from None
    seconds = time.process_time() - began
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory)
    if seconds > SECONDS or grown > BYTES:
        raise UnboundedError(f"{seconds:.1f} s, {grown / 2**20:.0f} MiB more")
    return outcome


FULL_CONFIG = """
environment: Pendulum-v1
hyperparameters: hyper.yml
checkpoints: [400, 800]
operators: [mse, inner]
pruner: median
seeds: &seeds [0, 1]
cross_validation:
  environments: [Pendulum-v1, dm_control/walker-run-v0]
  seeds: *seeds
  top: 2
  checkpoints: {Pendulum-v1: [200, 400]}
operator_selection: {environments: [Pendulum-v1], seeds: [1, 2]}
baselines:
- {name: a, aux_loss: "{s_t} -> {r_t} [cosine]"}
- {name: b, aux_loss: none, overrides: &own {policy_kwargs: {features_extractor_class: identity}}}
- {name: c, aux_loss: {loss: "{s_t} -> {s_t+1}", horizon: 3}, overrides: {<<: *own, gamma: 0.9}}
overrides: {policy_kwargs: {net_arch: [7]}, replay_buffer_kwargs: {handle_timeout_termination: true}}
"""
FULL_HYPER = """
default: &default
  n_timesteps: 1e5
  env_kwargs: {action_repeat: 4, frame_stack: 2}
  learning_rate: 1e-3
  train_freq: [1, step]
  policy_kwargs: {net_arch: {pi: [8], qf: [8, 8]}, squash_log_std: [-10, 2]}
Pendulum-v1:
  <<: *default
  aux_loss: "{s_t, a_t} -> {s_t+1}"
  n_envs: 2
  vec_env: dummy
  ent_coef: auto_0.1
  ent_coef_betas: [0.5, 0.999]
"""

HOSTILE_TEXTS = (
    *("", "\x00", "\x1b[2J", "²", "٣", "ｓ_t", "\u202e", "'", '"', "\\", "%s", "{0}", "lin_1e-3", "os:system"),
    *("aarl_canary:Env-v0", "torch.nn.ReLU", "os.system", "../../../etc/passwd", "/dev/full", "none", "auto", "~", "null"),
)
KEYS = (*config.SearchConfig.__dataclass_fields__, *config._ARGUMENTS, *config._POLICY_ARGUMENTS)
NOTATION_PIECES = (
    *("{", "}", r"\{", r"\}", "->", "→", r"\rightarrow", r"\to", "s_t", "a_t", "r_t", "s_{t+1}", "s_t+", "_", "t", "+", ","),
    *(" ", "\t", "\n", "$", "[", "]", "mse", "bilinear", "cosine", "negatives", "horizon=3", "horizon=1000000000", "horizon="),
    *("999999999", "0", "-1", "1e9", "0x10", *HOSTILE_TEXTS),
)


def notation(rng: random.Random) -> str:
    """A loss's notation with a few things wrong, rarely none."""
    kind = rng.random()
    if kind < 0.05:
        return "".join(chr(rng.randrange(1, 0x3000)) for _ in range(rng.randrange(40)))
    if kind < 0.15:
        return "".join(rng.choices(NOTATION_PIECES, k=rng.randrange(30)))
    loss = space.random_loss(np.random.default_rng(rng.getrandbits(32)), 10, ("mse", "bilinear", "n_mse"))
    text = rng.choice([str(loss), loss.latex(), rng.choice(catalog.names())])
    pieces = re.findall(r"[a-z]+|[0-9]+|\s+|->|\\?.", text)
    for _ in range(rng.randrange(4)):
        place = rng.randrange(len(pieces) + 1)
        end = min(len(pieces), place + rng.choice([0, 1, 1, 5]))
        what = rng.choice(["remove", "replace", "insert", "repeat", "swap"])
        if what == "remove":
            del pieces[place:end]
        elif what == "replace":
            pieces[place:end] = [rng.choice(NOTATION_PIECES)]
        elif what == "insert":
            pieces.insert(place, rng.choice(NOTATION_PIECES))
        elif what == "repeat":
            pieces[place:end] = pieces[place:end] * rng.choice([2, 2, 3, 3, 1000, 20_000])
        elif what == "swap" and pieces:
            other = rng.randrange(len(pieces))
            pieces[place:end], pieces[other : other + 1] = pieces[other : other + 1], pieces[place:end]
    return "".join(pieces)


def hostile_value(rng: random.Random, marker: Path, depth: int = 0) -> Any:
    """A plain value that is likely to be wrong wherever it stands."""
    numbers = (0, -1, 1, 2, 1.5, 1e-300, 1e300, math.nan, math.inf, -math.inf, 10**9, 2**63, 10**400, True, False)
    code = (f"__import__('os').system('touch {marker}')", f"open({str(marker)!r}, 'w')", f"exec('touch {marker}')")
    choice = rng.randrange(7 if depth < 3 else 4)
    if choice == 0:
        return rng.choice(numbers)
    if choice == 1:
        return rng.choice(HOSTILE_TEXTS)
    if choice == 2:
        return rng.choice([*code, None, "x" * rng.choice([30, 300, 3000])])
    if choice == 3:
        return notation(rng)
    if choice == 4:
        return [hostile_value(rng, marker, depth + 1) for _ in range(rng.choice([0, 1, 2, 5]))]
    if choice == 5:
        keys = ("loss", "operator", "negatives", "horizon", "name", *HOSTILE_TEXTS)
        return {rng.choice(keys): hostile_value(rng, marker, depth + 1) for _ in range(rng.randrange(4))}
    value: Any = 1
    for _ in range(rng.choice([3, 10, 200])):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return value


def notations(folder: Path, marker: Path) -> Callable[[random.Random], tuple[str, str]]:
    """
    Notations, names and mappings, given to what reads all of them.

    :param folder: Not used
    :param marker: A file that code in them would leave
    """

    def attempt(rng: random.Random) -> tuple[str, str]:
        kind = rng.choice(["notation", "notation", "notation", "mapping", "any value"])
        value: Any = notation(rng)
        if kind == "mapping":
            value = {"loss": value, "operator": "mse", "negatives": False, "horizon": 3}
            for _ in range(rng.randrange(3)):
                value[rng.choice(["loss", "operator", "negatives", "horizon", "orizon"])] = hostile_value(rng, marker)
        elif kind == "any value":
            value = hostile_value(rng, marker)

        def read() -> None:
            # A notation is read as one where a name would be looked up, too.
            loss = AuxLoss.parse(value) if kind == "notation" and rng.random() < 0.5 else catalog.resolve(value)
            assert AuxLoss.parse(str(loss)) == loss == AuxLoss.from_dict(loss.to_dict())
            assert len(loss.source) == len(loss.target) == 3 * loss.horizon + 1 <= 3001

        return kind, bounded(read, longest_error=10_000_000)

    return attempt


def yaml_pieces(marker: Path) -> tuple[str, ...]:
    """What has a meaning in YAML, and tags that execute something where they are believed."""
    apply = "!!python/object/apply"
    return (
        *(f"{apply}:os.system ['touch {marker}']", f"{apply}:subprocess.check_call [[touch, '{marker}']]"),
        *(f"{apply}:pathlib.Path.touch [!!python/object/new:pathlib.Path ['{marker}']]", "!!python/name:os.system ''"),
        *("!!python/module:aarl_canary ''", "!!python/object/new:aarl_canary.Env {}", "!!python/tuple [1]", "!python/none"),
        *(f"{apply}:eval [\"__import__('os').system('touch {marker}')\"]", "!!int ''", "!!float x", "!!binary aGVsbG8="),
        *("!!set {a, b}", "!!omap [a: 1]", "!!pairs [a: 1]", "!!timestamp 2020-13-45", "2020-01-01", "!!null x", "!!map []"),
        *("&a ", "*a", "<<: *a\n", "&a [*a, *a]", "{<<: [*a, *a]}", "{", "}", "[", "]", "- ", "? ", ": ", ", ", "|\n", ">-\n"),
        *(
            "'",
            '"',
            "#",
            "%YAML 9.9\n",
            "---\n",
            "...\n",
            "\t",
            "\n",
            "\r",
            "  ",
            "\x00",
            "\ufeff",
            "\x85",
            "\u2028",
            "!",
            "@",
            "`",
        ),
        *(
            r'"\ud800"',
            "0x" + "f" * 400,
            "1:" * 400 + "1",
            "1_0",
            "0o17",
            "1e999",
            ".nan",
            "-.inf",
            "~",
            "yes",
            "default:\n",
            "overrides:\n",
        ),
    )


def bomb(rng: random.Random) -> str:
    """Little that would become very much, or very deep."""
    levels, width = rng.randrange(1, 12), rng.randrange(1, 12)
    kind = rng.randrange(6)
    if kind == 0:
        lines = [f"k{i}: &k{i} [{', '.join([f'*k{i - 1}' if i else '1'] * width)}]" for i in range(levels)]
    elif kind == 1:
        lines = [f"k{i}: &k{i} {{<<: [{', '.join([f'*k{i - 1}' if i else '{x: 1}'] * width)}]}}" for i in range(levels)]
    elif kind == 2:
        lines = [
            f"k: &k {{{', '.join(f'x{i}: 1' for i in range(1000))}}}",
            *(f"l{i}: {{<<: *k}}" for i in range(rng.choice([5, 500]))),
        ]
    elif kind == 3:
        depth = rng.choice([10, 100, 1000, 20_000])
        return rng.choice(["[", "{a: ", "- ", "? ", "[{", "!!seq [", "&a [", '"', "!" * 9 + " "]) * depth
    elif kind == 4:
        lines = ["k: &k", "  " + rng.choice(["<<: *k", "- *k", "a: *k", "a: {<<: [*k, *k]}"])]
    else:
        lines = [
            rng.choice(["a", "é", "- 1\n", "a: 1\n", "'", "a b ", "# ", "\n", "? a\n"]) * rng.choice([1000, 20_000, 300_000])
        ]
    return "\n".join(lines) + "\n"


def mutated_text(rng: random.Random, text: str, marker: Path) -> bytes:
    """A file of YAML with a few things wrong."""
    pieces = yaml_pieces(marker)
    for _ in range(rng.randrange(1, 4)):
        what = rng.choice(["insert", "insert", "value", "lines", "cut", "bomb"])
        place = rng.randrange(len(text) + 1)
        if what == "insert":
            text = text[:place] + rng.choice(pieces) + text[place:]
        elif what == "value":
            colons = [match.end() for match in re.finditer(r":[ \n]", text)]
            place = rng.choice(colons) if colons else place
            text = text[:place] + rng.choice(pieces) + text[place + rng.choice([0, 1, 5]) :]
        elif what == "lines":
            lines = text.splitlines(keepends=True) or [""]
            i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[i : i + rng.choice([0, 1])] = [rng.choice(["", "  ", "- "]) + lines[j]] * rng.choice([1, 1, 2, 20])
            text = "".join(lines)
        elif what == "cut":
            text = text[:place] + text[place + rng.choice([1, 10, len(text)]) :]
        elif rng.random() < 0.1:
            text += bomb(rng)
    content = text.encode("utf-8", "surrogatepass")
    if rng.random() < 0.05:
        place = rng.randrange(len(content) + 1)
        content = content[:place] + rng.randbytes(rng.choice([1, 3, 40])) + content[place:]
    return content


def mutated_values(rng: random.Random, values: Any, marker: Path) -> bytes:
    """The same values but for a few, anywhere in them."""
    values = copy.deepcopy(values)
    for _ in range(rng.randrange(1, 3)):
        parent = values
        while True:
            key = rng.choice(list(parent) if isinstance(parent, dict) else range(len(parent)))
            if not isinstance(parent[key], (dict, list)) or not parent[key] or rng.random() < 0.3:
                break
            parent = parent[key]
        what = rng.random()
        if what < 0.15 and isinstance(parent, dict) and len(parent) > 1:
            parent[rng.choice([f"{key}s", key[:-1], *HOSTILE_TEXTS])] = parent.pop(key)
        elif what < 0.25 and len(parent) > 1:
            del parent[key]
        elif what < 0.35 and isinstance(parent, dict):
            parent[rng.choice(KEYS)] = hostile_value(rng, marker)
        else:
            parent[key] = hostile_value(rng, marker)
        if not values:
            break
    text = yaml.dump(values, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), allow_unicode=rng.random() < 0.5)
    return text.encode("utf-8", "surrogatepass")


def configurations(folder: Path, marker: Path) -> Callable[[random.Random], tuple[str, str]]:
    """
    The repository's configurations and others, as text and value by value, given to the three functions that read files.

    :param folder: An empty folder
    :param marker: A file that code in them would leave
    """
    canary = folder / "aarl_canary.py"
    canary.write_text(f"import pathlib\npathlib.Path({str(marker)!r}).touch()\nclass Env: ...\n")
    sys.path.insert(0, str(folder))
    zoo = Path(__file__).parent.parent / "zoo_configs"
    searches = [(zoo / "search" / "demo.yml").read_text(encoding="utf-8").replace("../demo.yml", "hyper.yml"), FULL_CONFIG]
    hypers = [(zoo / "demo.yml").read_text(encoding="utf-8"), FULL_HYPER]
    losses = ['aux_loss: "{s_t, a_t} -> {s_t+1}"\n', "aux_loss: {loss: '{s_t} -> {r_t}', horizon: 2, operator: cosine}\n"]
    originals = {"search.yml": searches, "hyper.yml": hypers, "loss.yml": losses}
    values = {text: yaml.safe_load(text) for texts in originals.values() for text in texts}
    readers: dict[str, Callable[[], Any]] = {
        "search.yml": lambda: config.load_config(folder / "search.yml"),
        "hyper.yml": lambda: config.load_config(folder / "search.yml"),
        "loss.yml": lambda: config.load_aux_loss(folder / "loss.yml"),
    }

    def attempt(rng: random.Random) -> tuple[str, str]:
        name = rng.choice(["search.yml", "search.yml", "hyper.yml", "hyper.yml", "loss.yml"])
        for other, texts in originals.items():
            (folder / other).write_text(rng.choice(texts), encoding="utf-8")
        text = rng.choice(originals[name])
        kind = rng.choice(["text", "text", "values", "values", "values", "bytes"])
        if kind == "text":
            content = mutated_text(rng, text, marker)
        elif kind == "values":
            content = mutated_values(rng, values[text], marker)
        else:
            content = bomb(rng).encode() if rng.random() < 0.1 else rng.randbytes(rng.randrange(200))
        (folder / name).write_bytes(content)

        def read() -> None:
            try:
                readers[name]()
            except config.ConfigError:
                raise
            except ValueError as error:
                raise UnboundedError(f"a ValueError that names no file: {error}") from error

        return f"{name} as {kind}", bounded(read, len(str(folder)) + config.LONGEST_ERROR)

    return attempt
