"""Configurations: the paper's tables typed in again, one clear error for whatever is wrong, nothing executed."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_aarl import AuxLoss, SACAux, catalog
from search.training.config import ConfigError, SearchConfig, load_config, load_hyperparameters, merge, resolve_env_id
from search.training.run import make_env

ZOO = Path(__file__).parent.parent / "zoo_configs"
SEARCHES = sorted((ZOO / "search").glob("*.yml"))
PAPER = [path for path in SEARCHES if not path.stem.endswith("-small") and path.stem != "demo"]

CONFIG: dict[str, Any] = {
    "environment": "dm_control/cheetah-run-v0",
    "hyperparameters": "hyper.yml",
    "checkpoints": [400, 800],
}
HYPER: dict[str, Any] = {"default": {"env_kwargs": {"action_repeat": 4}, "batch_size": 64}}


def write(folder: Path, config: Any = CONFIG, hyper: Any = HYPER) -> Path:
    for name, values in (("search.yml", config), ("hyper.yml", hyper)):
        (folder / name).write_text(values if isinstance(values, str) else yaml.safe_dump(values), encoding="utf-8")
    return folder / "search.yml"


def test_the_papers_searches_are_all_there() -> None:
    tasks = {"state": ("cheetah_run", "hopper_hop", "quadruped_run"), "pixel": ("cheetah_run", "reacher_easy", "walker_walk")}
    names = {f"{task}_{kind}{size}" for kind, group in tasks.items() for task in group for size in ("", "-small")}
    assert {path.stem for path in SEARCHES} == names | {"demo"}


@pytest.mark.parametrize("path", PAPER, ids=lambda path: path.stem)
def test_the_papers_budgets(path: Path) -> None:
    config = load_config(path)
    pixel = path.stem.endswith("pixel")
    assert config.environment == "dm_control/{}-v0".format(path.stem.rpartition("_")[0].replace("_", "-"))
    assert (config.n_random, config.n_prior, config.population_size, config.stages) == (100, 25, 100, 7)
    shares = (config.parents, config.replacement, config.crossover, config.horizon_change, config.random)
    assert shares == (0.25, 0.5, 0.2, 0.1, 0.2)
    assert (config.max_horizon, config.operators, config.screening, config.pruner) == (10, None, 1, "none")
    assert config.evaluation_episodes == 10
    short, long = (100_000, 200_000, 300_000, 400_000, 500_000), (300_000, 600_000, 900_000, 1_200_000, 1_500_000)
    assert config.cross_validation.top == 5 and len(config.cross_validation.seeds) == 3
    assert not {*config.seeds} & {*config.cross_validation.seeds}  # or what was chosen for its luck counts again
    environments = config.cross_validation.environments
    expected = ("cheetah-run", "reacher-easy", "walker-walk") if pixel else ("cheetah-run", "hopper-hop", "quadruped-run")
    assert environments == tuple(f"dm_control/{task}-v0" for task in expected)
    for env_id in environments:
        assert config.checkpoints_for(env_id) == (short if pixel or "cheetah" in env_id else long)
        assert config.hyperparameters_for(env_id).get("env_kwargs", {}).get("pixels", False) is pixel
    assert len(config.baselines) == 3
    if pixel:
        assert config.operator_selection.environments == environments
        assert len(config.operator_selection.seeds) == 5


@pytest.mark.parametrize("path", [path for path in SEARCHES if path.stem.endswith("-small")], ids=lambda path: path.stem)
def test_small_searches_are_smaller(path: Path) -> None:
    small, whole = load_config(path), load_config(path.with_name(path.name.replace("-small", "")))
    assert small.environment == whole.environment
    assert small.cross_validation.environments == whole.cross_validation.environments
    for name in ("stages", "population_size", "n_random", "n_prior"):
        assert getattr(small, name) < getattr(whole, name)
    assert max(small.checkpoints) <= max(whole.checkpoints) / 5


@pytest.mark.parametrize("path", PAPER, ids=lambda path: path.stem)
def test_every_baseline_can_be_built(path: Path) -> None:
    config = load_config(path)
    for baseline in config.baselines:
        values = config.hyperparameters_for(config.environment, baseline.overrides)
        values.pop("n_timesteps")
        values["policy_kwargs"]["net_arch"] = [8]
        env = make_env(config.environment, values.pop("env_kwargs"))
        model = SACAux(values.pop("policy"), env, aux_loss=baseline.aux_loss, **{**values, "buffer_size": 10})
        assert model.aux_loss == (catalog.load("curl") if "CURL" in baseline.name else None)
        assert bool(list(model.critic.features_extractor.parameters())) is ("Identity" not in baseline.name)
        if "no aug" in baseline.name:
            assert model.policy.augmentation == "none" and model.observation_space.shape == (9, 84, 84)


# What the loader does.


def test_defaults_are_the_papers_and_lists_become_tuples(tmp_path: Path) -> None:
    config = load_config(write(tmp_path))
    assert config == SearchConfig(
        path=tmp_path / "search.yml",
        environment="dm_control/cheetah-run-v0",
        hyperparameters=tmp_path / "hyper.yml",
        checkpoints=(400, 800),
    )
    assert config.sampler_settings()["population_size"] == 100


def test_everything_that_can_be_said(tmp_path: Path) -> None:
    parts = {
        "cross_validation": {
            "environments": ["dm_control/walker-run-v0", "Pendulum-v1"],
            "seeds": [3],
            "top": 2,
            "checkpoints": {"Pendulum-v1": [200]},
        },
        "operator_selection": {"environments": ["dm_control/cheetah-run-v0"], "seeds": [1, 2]},
        "baselines": [
            {"name": "a", "aux_loss": "{s_t} -> {r_t}"},
            {"name": "b", "aux_loss": None, "overrides": {"policy_kwargs": {"features_extractor_class": "identity"}}},
        ],
        "operators": ["mse", "inner"],
        "overrides": {"policy_kwargs": {"net_arch": [7]}},
    }
    config = load_config(write(tmp_path, CONFIG | parts))
    assert config.cross_validation.seeds == (3,) and config.operator_selection.seeds == (1, 2)
    assert config.checkpoints_for("Pendulum-v1") == (200,)
    assert config.checkpoints_for("dm_control/walker-run-v0") == (400, 800)
    assert [baseline.aux_loss for baseline in config.baselines] == [AuxLoss.parse("{s_t} -> {r_t}"), None]
    assert config.operators == ("mse", "inner")
    assert config.hyperparameters_for("Pendulum-v1", config.baselines[1].overrides) == {
        "env_kwargs": {"action_repeat": 4},
        "batch_size": 64,
        "policy_kwargs": {"net_arch": [7], "features_extractor_class": "identity"},
    }


def test_an_environments_own_entry_is_merged_over_the_default(tmp_path: Path) -> None:
    own = {"env_kwargs": {"frame_stack": 2}, "learning_rate": "REPLACED"}
    text = yaml.safe_dump(HYPER | {"Pendulum-v1": own}).replace("REPLACED", "1e-3")
    write(tmp_path, hyper=text + "\nn_envs: {}\n")
    path = tmp_path / "hyper.yml"
    assert load_hyperparameters(path, "Pendulum-v1") == {
        "env_kwargs": {"action_repeat": 4, "frame_stack": 2},
        "batch_size": 64,
        "learning_rate": 0.001,  # YAML 1.1 would have taken it for text
    }
    assert load_hyperparameters(path, "dm_control/fish-swim-v0") == HYPER["default"]


mappings = st.recursive(
    st.dictionaries(st.sampled_from("abc"), st.integers(0, 9), max_size=3),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
)


def leaves(values: Any, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    if not isinstance(values, dict):
        return {path: values}
    return {where: leaf for key in values for where, leaf in leaves(values[key], (*path, key)).items()}


@given(mappings, mappings)
def test_merging(one: dict[str, Any], other: dict[str, Any]) -> None:
    merged = leaves(merge(one, other))
    assert leaves(other).items() <= merged.items()
    assert merged.keys() <= leaves(one).keys() | leaves(other).keys()
    # Of the first one stays what the other does not touch.
    untouched = {k: v for k, v in leaves(one).items() if not any(k[: len(o)] == o or o[: len(k)] == k for o in leaves(other))}
    assert all(merged[k] == v for k, v in untouched.items() if k in merged)


def test_short_names_of_environments() -> None:
    assert resolve_env_id("cheetah-run") == resolve_env_id("dm_control/cheetah-run-v0") == "dm_control/cheetah-run-v0"
    assert resolve_env_id("Cheetah-Run") == "dm_control/cheetah-run-v0"  # the paper's
    assert resolve_env_id("Pendulum-v1") == "Pendulum-v1"
    with pytest.raises(ValueError, match="cheetah-run"):
        resolve_env_id("chetah-run")


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"populaton_size": 3}, "'populaton_size'.*'population_size'"),
    ({"path": "x"}, "unknown key 'path'"),
    ({"cross_validation": {"environments": ["Pendulum-v1"], "sedes": [1]}}, "cross_validation.*'sedes'.*'seeds'"),
    ({"operator_selection": {"environment": ["Pendulum-v1"]}}, "operator_selection.*'environment'.*'environments'"),
    ({"cross_validation": {}}, "cross_validation.*environments is missing"),
    ({"baselines": [{"name": "a", "aux_los": None}]}, r"baselines\[0\].*'aux_los'.*'aux_loss'"),
    ({"baselines": [{"name": "a", "aux_loss": "curll"}]}, r"baselines\[0\]\.aux_loss.*curl"),
    ({"baselines": [{"name": "a"}, {"name": "a"}]}, "baselines"),
    ({"overrides": {"bach_size": 3}}, "overrides.*'bach_size'.*'batch_size'"),
    ({"overrides": {"env_kwargs": {"action_repeats": 2}}}, "env_kwargs.*'action_repeats'.*'action_repeat'"),
    ({"overrides": {"policy_kwargs": {"net_arc": [2]}}}, "policy_kwargs.*'net_arc'.*'net_arch'"),
    ({"overrides": {"replay_buffer_kwargs": {"storage_devise": "cpu"}}}, "replay_buffer_kwargs.*'storage_device'"),
    ({"overrides": {"replay_buffer_kwargs": {"n_envs": 2}}}, "replay_buffer_kwargs.*unknown key 'n_envs'"),
    (
        {"overrides": {"policy_kwargs": {"optimizer_kwargs": {"epss": 1e-5}}}},
        r"kwargs\.optimizer_kwargs.*'epss'.*'eps'",
    ),
    ({"overrides": {"policy_kwargs": {"optimizer_kwargs": {"eps": "small"}}}}, "optimizer_kwargs.*eps must be a number"),
    (
        {"overrides": {"policy_kwargs": {"features_extractor_kwargs": {"n_layer": 2}}}},
        r"policy_kwargs\.features_extractor_kwargs: unknown key 'n_layer', nearest known key: 'n_layers'",
    ),
    (
        {"overrides": {"policy_kwargs": {"features_extractor_class": "mlp", "features_extractor_kwargs": {"n_filters": 2}}}},
        "features_extractor_kwargs: unknown key 'n_filters'",
    ),
    (
        {"overrides": {"policy_kwargs": {"features_extractor_class": "identity", "features_extractor_kwargs": {"width": 2}}}},
        "unknown key 'width', there are none here",
    ),
    ({"overrides": {"batch_size": "many"}}, "batch_size must be an integer, not 'many'"),
    ({"overrides": {"learning_rate": "lin_1e-3"}}, "learning_rate must be a number, not 'lin_1e-3'"),
    ({"overrides": {"aux_loss": "no-such-loss"}}, "no-such-loss"),
    ({"overrides": {"seed": 3}}, "unknown key 'seed'"),
    ({"overrides": {"n_envs": 0}}, "n_envs must be at least 1, not 0"),
    ({"overrides": {"n_envs": 1.5}}, "n_envs must be an integer"),
    ({"overrides": {"env_kwargs": {"action_repeat": 0}}}, "overrides: action_repeat must be at least 1, not 0"),
    (
        {"overrides": {"policy_kwargs": {"features_extractor_class": "dens_mlp"}}},
        "overrides: .*unknown encoder 'dens_mlp'.*dense_mlp",
    ),
    ({"overrides": {"vec_env": "threads"}}, "vec_env must be one of dummy, subproc, not 'threads'"),
    ({"overrides": {"device": "gpu"}}, "overrides: device must be auto, cpu, cuda or cuda:N, not 'gpu'"),
    ({"environment": 3}, "environment must be text, not 3"),
    ({"environment": "dm_control/cheetah-rum-v0"}, "cheetah-run"),
    ({"environment": "cheetah-run"}, "dm_control/cheetah-run-v0"),
    ({"environment": "os:Pendulum-v1"}, "unknown environment"),
    ({"hyperparameters": "missing.yml"}, "missing.yml"),
    ({"hyperparameters": "."}, "cannot be read"),
    ({"checkpoints": 5}, "checkpoints must be a list of an integer, not 5"),
    ({"checkpoints": []}, "checkpoints"),
    ({"checkpoints": [800, 400]}, "checkpoints must be positive environment steps in ascending order"),
    ({"checkpoints": [401]}, "multiples of .*cheetah-run.*action repeat 4"),
    ({"checkpoints": [400, 1.5]}, r"checkpoints\[1\] must be an integer, not 1.5"),
    ({"stages": True}, "stages must be an integer, not True"),
    ({"stages": 0}, "stages"),
    ({"parents": float("nan")}, "parents must be a number"),
    ({"parents": 2.0}, "parents"),
    ({"random": 0.9}, "sum to 1"),
    ({"population_size": 0}, "population_size"),
    ({"operators": ["mse", "huber"]}, "huber"),
    ({"operators": "mse"}, "operators"),
    ({"pruner": "medain"}, "pruner.*median"),
    ({"seeds": [1, 1]}, "seeds"),
    ({"seeds": []}, "seeds"),
    ({"seeds": [-1]}, "seeds"),
    ({"evaluation_episodes": 0}, "evaluation_episodes"),
    ({"allow_duplicates": "no!"}, "allow_duplicates must be true or false"),
    ({"cross_validation": {"environments": ["Pendulum-v1"], "top": 0}}, "top"),
    ({"cross_validation": {"environments": []}}, "cross_validation.environments"),
    ({"cross_validation": {"environments": ["Pendulum"]}}, "cross_validation.environments.*Pendulum-v1"),
    ({"cross_validation": {"environments": ["Pendulum-v1"], "checkpoints": {"Pendulum-v1": [3]}}}, "multiples of Pendulum"),
    (
        {"cross_validation": {"environments": ["Pendulum-v1"], "checkpoints": {"MountainCarContinuous-v0": [5]}}},
        "checkpoints: 'MountainCarContinuous-v0' is not trained on",
    ),
]


@pytest.mark.parametrize(("change", "message"), WRONG, ids=[str(change)[:60] for change, _ in WRONG])
def test_one_clear_line_for_what_is_wrong(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write(tmp_path, CONFIG | change)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    text = str(error.value)
    assert re.search(message, text) and "\n" not in text
    assert str(tmp_path) in text  # which file


@pytest.mark.parametrize("key", ["environment", "hyperparameters", "checkpoints"])
def test_what_is_missing_is_named(tmp_path: Path, key: str) -> None:
    path = write(tmp_path, {name: value for name, value in CONFIG.items() if name != key})
    with pytest.raises(ConfigError, match=f"{key} is missing"):
        load_config(path)


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['touch {marker}']",
        "overrides: !!python/object/apply:subprocess.check_call [[touch, '{marker}']]",
        "overrides: !!python/name:os.system",
        "overrides: {{learning_starts: !!python/object/new:os.system ['touch {marker}']}}",
        "overrides: {{learning_rate: \"__import__('os').system('touch {marker}')\"}}",
        "stages: 2020-13-45",
        "stages: !!int ''",
        "stages: !!timestamp x",
        "overrides: {{n_timesteps: 2020-01-01}}",
        "overrides: !!binary aGVsbG8=",
        "overrides: !!set {{a, b}}",
        "1: 2",
        "[a, b]",
        "just text",
        "",
        "stages: 1\nstages: 2",
        "a: &a [*a]",
        "a: &a {{b: *a}}",
        "a: &a [1,1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
        "d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: [*d,*d,*d,*d,*d,*d,*d,*d,*d,*d]",
        "[" * 5000,
        "stages: " + "9" * 5000,
        "\x00",
        "{{a: b",
    ],
)
def test_files_that_are_not_plain_are_refused_and_execute_nothing(tmp_path: Path, text: str) -> None:
    marker = tmp_path / "executed"
    text = text.format(marker=marker)
    files = [(text, HYPER), (CONFIG, text), *([(yaml.safe_dump(CONFIG) + text, HYPER)] if text else [])]
    for config, hyper in files:
        path = write(tmp_path, config, hyper)
        with pytest.raises(ConfigError) as error:
            load_config(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 1000
    assert not marker.exists()


def test_auto_is_a_loss_of_hyperparameters(tmp_path: Path) -> None:
    path = write(tmp_path, CONFIG, {"default": {"aux_loss": "auto"}})
    load_config(path)
    assert load_hyperparameters(tmp_path / "hyper.yml", "Pendulum-v1") == {"aux_loss": "auto"}


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_bytes(b"\xff\xfe\x00stages: 1")
    with pytest.raises(ConfigError):
        load_config(path)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=10), inner, max_size=3),
    max_leaves=8,
)
keys = st.sampled_from([name for name in SearchConfig.__dataclass_fields__ if name != "path"]) | st.text(max_size=12)
hyper_keys = st.sampled_from(
    ["batch_size", "learning_rate", "policy", "env_kwargs", "policy_kwargs", "train_freq", "aux_loss"]
)


@given(st.dictionaries(keys, plain, max_size=4), st.dictionaries(hyper_keys, plain, max_size=3))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_plain_values_are_read_or_refused(tmp_path: Path, change: dict[str, Any], hyper: dict[str, Any]) -> None:
    path = write(tmp_path, CONFIG | change, {"default": HYPER["default"] | hyper})
    try:
        config = load_config(path)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(config, SearchConfig)


@given(st.text(alphabet=st.sampled_from(list("ab:-[]{}&*!<'\"#|>%@ \n\t0123.e~,?\\")), max_size=40))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_text_is_read_or_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, yaml.safe_dump(CONFIG) + text)
    try:
        load_config(path)
    except ConfigError as error:
        assert "\n" not in str(error)
