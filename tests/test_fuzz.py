"""Hostile notations and configurations: refused in one clear line, within bounds of time and memory, nothing executed."""

import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_aarl import AuxLoss
from search.studies.config import load_config
from search.training.config import ConfigError, load_aux_loss, load_hyperparameters

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from fuzz_texts import configurations, notations


@pytest.mark.parametrize(("target", "inputs"), [(notations, 400), (configurations, 150)])
def test_inputs_that_are_altered_at_random(
    target: Callable[[Path, Path], Callable[[random.Random], tuple[str, str]]],
    inputs: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same as in benchmarks/fuzz.py, which tries many more."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    marker = tmp_path / "executed"
    attempt = target(tmp_path, marker)
    outcomes: Counter[str] = Counter()
    for number in range(inputs):
        outcomes[attempt(random.Random(f"test {number}"))[1]] += 1
        assert not marker.exists(), number
    # Near enough to what is real that some of it can be read.
    assert outcomes["read"] > inputs / 20 and outcomes["refused"] > inputs / 2


SEARCH = {"environment": "Pendulum-v1", "hyperparameters": "hyper.yml", "checkpoints": [400, 800]}
HYPER = {"default": {"batch_size": 64}}


def write(folder: Path, search: Any = SEARCH, hyper: Any = HYPER) -> Path:
    for name, values in (("search.yml", search), ("hyper.yml", hyper)):
        (folder / name).write_text(values if isinstance(values, str) else yaml.safe_dump(values), encoding="utf-8")
    return folder / "search.yml"


def laughs(levels: int, width: int, line: str) -> str:
    """Every level refers to the one before so often."""
    return "".join(
        f"k{i}: &k{i} " + line.format(", ".join([f"*k{i - 1}" if i else "{x: 1}"] * width)) + "\n" for i in range(levels)
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (laughs(9, 9, "[{}]"), "too large with all of them written out"),
        (laughs(9, 9, "{{<<: [{}]}}"), "merges too much"),
        ("k: &k {" + "".join(f"x{i}: 1, " for i in range(3000)) + "}\n" + "l:\n" + "- {<<: *k}\n" * 3000, "merges too much"),
        ("k: &k\n  <<: *k\n", "recursion"),
        ("k: &k [*k]\n", "an alias refers to itself"),
        ("[" * 50_000, "nested more than 100 deep"),
        ("[{" * 20_000, "nested more than 100 deep"),
        ("k: " + "[" * 101 + "]" * 101, "nested more than 100 deep"),
        ("k: " + "[" * 100 + "]" * 100, "unknown key 'k'"),
        ("k: [" + "[], " * 1000 + "]", "unknown key 'k'"),
        ("- " * 1000, "not YAML of plain values"),
        ("k:" + " [\n" * 5000, "nested more than 100 deep"),
        ("# " * 200_000, "has more than 200000 characters"),
        ("stages: 0x" + "f" * 50_000, "a number has more than 300 digits"),
        ("stages: " + "1:" * 5000 + "1", "a number has more than 300 digits"),
        ("? " + "ab" * 50_000 + "\n: 1\n", "not YAML|unknown key 'abab"),
        ("? 'k" + "k" * 90_000 + "'\n: 1\n", "unknown key 'kkkk"),
        ('"\\e[2J\\a\\u202e": 1', r"unknown key '\\x1b\[2J"),
        (
            'cross_validation: {environments: [Pendulum-v1], checkpoints: {"a\\nb\\e[31m": 3}}',
            r"checkpoints\.a\\nb\\x1b\[31m must",
        ),
    ],
    ids=lambda value: repr(value[:40]) if isinstance(value, str) else None,
)
def test_little_that_becomes_much(text: str, problem: str, tmp_path: Path) -> None:
    began = time.process_time()
    with pytest.raises(ConfigError, match=problem) as error:
        load_config(write(tmp_path, yaml.safe_dump(SEARCH) + text))
    assert time.process_time() - began < 3
    assert str(error.value).isprintable() and len(str(error.value)) < 1100


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"population_size": 10**9}, "population_size must be at most 100000"),
        ({"n_random": 10**9}, "n_random must be at most 100000"),
        ({"n_prior": 10**9}, "n_prior must be at most 100000"),
        ({"stages": 10**9}, "stages must be at most 100000"),
        ({"screening": 10**9}, "screening must be at most 100000"),
        ({"evaluation_episodes": 10**9}, "evaluation_episodes must be at most 100000"),
        ({"max_horizon": 10**9}, "max_horizon must be at most 1000, not 1000000000"),
        ({"seed": -1}, "seed must not be negative, but is -1"),
        ({"seeds": [2**32]}, "seeds must be different numbers from 0 to"),
        ({"baselines": [{"name": "a", "aux_loss": "{s_t} -> {s_t+1000000000}"}]}, "an offset of at most 1000"),
        ({"baselines": [{"name": "a", "aux_loss": {"loss": "{s_t} -> {s_t}", "horizon": 10**9}}]}, "from 1 to 1000"),
        ({"cross_validation": {"environments": ["Pendulum-v1"] * 2}}, "must name each environment once"),
    ],
    ids=str,
)
def test_numbers_that_would_ask_for_the_moon(change: dict[str, Any], problem: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=problem):
        load_config(write(tmp_path, SEARCH | change))


HOSTILE = [
    ({"learning_rate": "lin_1e-3"}, "learning_rate must be a number, not 'lin_1e-3'"),
    ({"learning_rate": "__import__('os').system('touch MARKER')"}, "learning_rate must be a number"),
    ({"policy": "__import__('os').system('touch MARKER')"}, None),  # a text: SB3 looks it up among its names
    ({"train_freq": "exec(open('MARKER', 'w'))"}, "train_freq must be"),
    ({"policy_kwargs": "dict(net_arch=[8], f=open('MARKER', 'w'))"}, "policy_kwargs must be a mapping"),
    ({"policy_kwargs": {"activation_fn": "torch.nn.ReLU"}}, "activation_fn can be set in Python only, not to 'torch.nn.ReLU'"),
    ({"policy_kwargs": {"optimizer_class": "os.system"}}, "optimizer_class can be set in Python only, not to 'os.system'"),
    ({"policy_kwargs": {"features_extractor_class": "os.system"}}, "unknown encoder 'os.system'"),
    ({"replay_buffer_class": "canary.Buffer"}, "unknown key 'replay_buffer_class'"),
    ({"env_wrapper": "canary.Wrapper"}, "unknown key 'env_wrapper'"),
    ({"callback": "canary.Callback"}, "unknown key 'callback'"),
    ({"action_noise": "canary.Noise"}, "unknown key 'action_noise'"),
    ({"env_kwargs": {"wrapper": "canary"}}, "unknown key 'wrapper'"),
    ({"vec_env": "canary.Env"}, "vec_env must be one of"),
    ({"aux_loss": "__import__('os').system('touch MARKER')"}, "unknown auxiliary loss"),
]


@pytest.fixture
def canary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that appears when code of a configuration is executed, or a module that it names imported."""
    marker = tmp_path / "executed"
    (tmp_path / "canary.py").write_text(f"import pathlib\npathlib.Path({str(marker)!r}).touch()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return marker


@pytest.mark.parametrize(("hyper", "problem"), HOSTILE, ids=[str(hyper)[:50] for hyper, _ in HOSTILE])
def test_what_other_programs_would_evaluate(hyper: dict[str, Any], problem: str | None, tmp_path: Path, canary: Path) -> None:
    text = yaml.safe_dump({"default": hyper}).replace("MARKER", str(canary))
    path = write(tmp_path, hyper=text)
    if problem is None:
        load_hyperparameters(tmp_path / "hyper.yml", "Pendulum-v1")
    else:
        for read in (lambda: load_config(path), lambda: load_hyperparameters(tmp_path / "hyper.yml", "Pendulum-v1")):
            with pytest.raises(ConfigError, match=problem) as error:
                read()
            assert str(error.value).isprintable()
    assert not canary.exists() and "canary" not in sys.modules


@pytest.mark.parametrize("env_id", ["os:system", "canary:Pendulum-v1", "canary:canary/Env-v0", "canary", "canary.py"])
def test_an_environments_name_imports_nothing(env_id: str, tmp_path: Path, canary: Path) -> None:
    places = [{"environment": env_id}, {"cross_validation": {"environments": [env_id]}}]
    places.append({"operator_selection": {"environments": [env_id]}})
    places.append({"cross_validation": {"environments": ["Pendulum-v1"], "checkpoints": {env_id: [400]}}})
    for change in places:
        with pytest.raises(ConfigError, match="unknown environment"):
            load_config(write(tmp_path, SEARCH | change))
    assert not canary.exists() and "canary" not in sys.modules


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system ['touch MARKER']",
        "!!python/object/apply:pathlib.Path.touch [!!python/object/new:pathlib.Path [MARKER]]",
        "!!python/name:os.system",
        "!!python/module:canary",
        "!!python/object:canary.Thing {}",
        "!!python/tuple [1, 2]",
        "!<tag:yaml.org,2002:python/object/apply:os.system> ['touch MARKER']",
    ],
)
def test_tags_of_python_are_refused_wherever_they_stand(tag: str, tmp_path: Path, canary: Path) -> None:
    tag = tag.replace("MARKER", str(canary))
    search = yaml.safe_dump(SEARCH)
    for text in (f"stages: {tag}", f"baselines: [{{name: {tag}}}]", f"? {tag}\n: 1", f"overrides: {{<<: {tag}}}"):
        with pytest.raises(ConfigError, match="not YAML of plain values"):
            load_config(write(tmp_path, f"{search}{text}\n"))
        with pytest.raises(ConfigError, match="not YAML of plain values"):
            load_config(write(tmp_path, hyper=f"default: {{}}\n{text}\n"))
    (tmp_path / "loss.yml").write_text(f"aux_loss: {tag}\n")
    with pytest.raises(ConfigError, match="not YAML of plain values"):
        load_aux_loss(tmp_path / "loss.yml")
    assert not canary.exists() and "canary" not in sys.modules


TOKENS = ", ".join(f"{kind}_t+{i}" for i in range(1000) for kind in "sar")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{s_t" + " " * 50_000 + "} -> {s_t" + " " * 50_000, "at position"),
        ("{s_{t" + " " * 50_000 + "+" + "1" * 50_000, "at position 1,"),
        ("{s_{t+" + "1" * 50_000 + " " * 50_000 + "x", "at position 1,"),
        ("$" * 100_000, "expected '{'"),
        ("{" * 100_000, "expected a token"),
        ("{s_t} -> {s_t} [" + "," * 100_000 + "]", "instead of ''"),
        ("{s_t} -> {s_t} [" + "mse, " * 50_000 + "]", "each once only"),
        ("{s_t} -> {s_t} " + "[" * 100_000, "nothing more"),
        (f"{{{TOKENS}, {TOKENS}}} -> {{s_t}}", "s_t once only"),
        ("{s_t} -> {s_t+" + "0" * 100_000 + "1000000000}", "an offset of at most 1000"),
        ("{s_t} -> {s_t} [horizon=1000000000]", "instead of 'horizon=1000000000'"),
    ],
    ids=lambda value: repr(value[:30]) if isinstance(value, str) else None,
)
def test_long_notations_take_no_time(text: str, problem: str) -> None:
    began = time.process_time()
    with pytest.raises(ValueError, match=problem) as error:
        AuxLoss.parse(text)
    assert time.process_time() - began < 1
    assert len(str(error.value)) < 1000 and str(error.value).isprintable()


def test_the_longest_loss_is_read() -> None:
    began = time.process_time()
    loss = AuxLoss.parse(f"{{{TOKENS}}} -> {{{TOKENS}}}")
    assert time.process_time() - began < 2
    assert loss.horizon == 1000 and sum(loss.source) == sum(loss.target) == 3000


@pytest.mark.parametrize("horizon", [10**9, 10**400, -(10**5000), 2**20_000], ids=["9", "400", "-5000", "bits"])
def test_a_horizon_of_many_digits_allocates_nothing(horizon: int) -> None:
    with pytest.raises(ValueError, match=r"^horizon must be an integer from 1 to 1000, not ") as error:
        AuxLoss.parse("{s_t} -> {s_t}", horizon=horizon)
    assert len(str(error.value)) < 500
