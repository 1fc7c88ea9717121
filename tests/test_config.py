"""Configurations: the paper's searches typed in again, one clear line for each problem, nothing evaluated."""

import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sb3_aarl.search.studies.config import Baseline, CrossValidation, SearchConfig, load_config
from sb3_aarl.search.studies.single import prepare_one
from sb3_aarl.search.training.config import ConfigError, check_hyperparameters, load_hyperparameters, read_yaml, resolve_env_id
from sb3_aarl.search.training.folder import read_run
from sb3_aarl.search.training.setup import make_env

from sb3_aarl import AuxLoss, SACAux, catalog

ZOO = Path(__file__).parent.parent / "zoo_configs"
SEARCHES = sorted((ZOO / "search").glob("*.yml"))
OTHERS = {"cheetah_run_simba", "demo", "template", "three_tasks"}
PAPER = [path for path in SEARCHES if not path.stem.endswith("-small") and path.stem not in OTHERS]

CONFIG: dict[str, Any] = {
    "environment": "dm_control/cheetah-run-v0",
    "hyperparameters": "hyper.yml",
    "checkpoints": [400, 800],
}
HYPER: dict[str, Any] = {"default": {"env_kwargs": {"action_repeat": 4}, "batch_size": 64}}
FORWARD, REWARD = AuxLoss.parse("{s_t, a_t} -> {s_t+1}"), AuxLoss.parse("{s_t} -> {r_t}")


def write(folder: Path, config: Any = CONFIG, hyper: Any = HYPER) -> Path:
    for name, values in (("search.yml", config), ("hyper.yml", hyper)):
        (folder / name).write_text(values if isinstance(values, str) else yaml.safe_dump(values), encoding="utf-8")
    return folder / "search.yml"


# The configurations that come with the project.


def test_the_papers_searches_are_all_there() -> None:
    tasks = {"state": ("cheetah_run", "hopper_hop", "quadruped_run"), "pixel": ("cheetah_run", "reacher_easy", "walker_walk")}
    names = {f"{task}_{kind}{size}" for kind, group in tasks.items() for task in group for size in ("", "-small")}
    assert {path.stem for path in SEARCHES} == names | OTHERS


@pytest.mark.parametrize("path", PAPER, ids=lambda path: path.stem)
def test_the_papers_budgets(path: Path) -> None:
    config = load_config(path)
    pixel = path.stem.endswith("pixel")
    assert config.environment == "dm_control/{}-v0".format(path.stem.rpartition("_")[0].replace("_", "-"))
    assert (config.n_random, config.n_prior, config.population_size, config.generations) == (100, 25, 100, 7)
    shares = (config.parents, config.replacement, config.crossover, config.horizon_change, config.random)
    assert shares == (0.25, 0.5, 0.2, 0.1, 0.2)
    assert (config.max_horizon, config.operators, config.screening, config.pruner) == (10, None, 1, "none")
    assert config.evaluation_episodes == 10
    short, long = (100_000, 200_000, 300_000, 400_000, 500_000), (300_000, 600_000, 900_000, 1_200_000, 1_500_000)
    assert config.cross_validation is not None
    assert config.cross_validation.top == 5 and len(config.cross_validation.seeds) == 3
    assert not {*config.seeds} & {*config.cross_validation.seeds}  # or the luck that chose a candidate counts again
    environments = config.cross_validation.environments
    expected = ("cheetah-run", "reacher-easy", "walker-walk") if pixel else ("cheetah-run", "hopper-hop", "quadruped-run")
    assert environments == tuple(f"dm_control/{task}-v0" for task in expected)
    for env_id in environments:
        steps = config.checkpoints
        if env_id != config.environment:
            steps = config.cross_validation.checkpoints.get(env_id, steps)
        assert steps == (short if pixel or "cheetah" in env_id else long)
        assert config.hyperparameters_for(env_id).get("env_kwargs", {}).get("pixels", False) is pixel
    assert len(config.baselines) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cheetah_run_state", "cheetah_run_pixel"])  # the others have the same baselines
def test_every_baseline_can_be_built(name: str) -> None:
    config = load_config(ZOO / "search" / f"{name}.yml")
    for baseline in config.baselines:
        values = config.hyperparameters_for(config.environment, baseline)
        values.pop("n_timesteps")
        values["policy_kwargs"]["net_arch"] = [8]
        env = make_env(config.environment, values.pop("env_kwargs"))
        model = SACAux(values.pop("policy"), env, **{**values, "aux_loss": baseline.aux_loss, "buffer_size": 10})
        assert model.aux_loss == (catalog.load("curl") if "CURL" in baseline.name else None)
        assert bool(list(model.critic.features_extractor.parameters())) is ("Identity" not in baseline.name)
        if "no aug" in baseline.name:
            assert model.policy.augmentation == "none" and model.observation_space.shape == (9, 84, 84)


def test_sac_of_the_template_is_sb3s() -> None:
    config = load_config(ZOO / "search" / "template.yml")
    baseline, sac = config.baselines[0], load_hyperparameters(ZOO / "sac.yml", config.environment)
    assert baseline.aux_loss is sac.pop("aux_loss") is None
    assert sac.pop("policy") == "MlpPolicy"
    assert config.hyperparameters_for(config.environment, baseline) == sac


def test_a_search_without_hyperparameters_has_those_of_aarl_train(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_aarl.search.studies.single.check_run", lambda *_: None)
    config = load_config(write(tmp_path, {"environment": "cheetah-run", "checkpoints": [400]}))
    trained = read_run(prepare_one("cheetah-run", None, None, folder=tmp_path / "run")).hyperparameters
    assert config.hyperparameters_for(config.environment) == trained
    assert trained["env_kwargs"] == {"action_repeat": 2}


def test_all_searches_of_one_kind_have_the_same_baselines() -> None:
    for kind in ("state", "pixel"):
        baselines = {str(load_config(path).baselines) for path in SEARCHES if kind in path.stem}
        assert len(baselines) == 1


# Searches.


def test_every_part_of_a_search_is_read(tmp_path: Path) -> None:
    parts = {
        "cross_validation": {
            "environments": ["walker-run", "Pendulum-v1"],
            "seeds": [3],
            "top": 2,
            "checkpoints": {"Pendulum-v1": [200]},
        },
        "baselines": [
            {"name": "a", "aux_loss": "{s_t} -> {r_t}"},
            {"name": "b", "aux_loss": None, "overrides": {"policy_kwargs": {"features_extractor_class": "identity"}}},
            {"name": "c", "aux_loss": "none"},
        ],
        "operators": ["mse", "inner"],
        "overrides": {"policy_kwargs": {"net_arch": [7]}},
    }
    config = load_config(write(tmp_path, CONFIG | parts))
    walker = "dm_control/walker-run-v0"
    assert config.cross_validation == CrossValidation(
        environments=(walker, "Pendulum-v1"), seeds=(3,), top=2, checkpoints={"Pendulum-v1": (200,)}
    )
    assert config.baselines[0] == Baseline(name="a", aux_loss=REWARD)
    assert [baseline.aux_loss for baseline in config.baselines[1:]] == [None, None]
    assert config.operators == ["mse", "inner"]
    assert config.hyperparameters_for("Pendulum-v1", config.baselines[1]) == {
        "env_kwargs": {"action_repeat": 4},
        "batch_size": 64,
        "policy_kwargs": {"net_arch": [7], "features_extractor_class": "identity"},
    }


def test_files_are_relative_to_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "searches").mkdir()
    write(tmp_path)
    path = write(tmp_path / "searches", CONFIG | {"hyperparameters": "../hyper.yml", "initial": "../losses.yml"}, "")
    (tmp_path / "losses.yml").write_text("aux_loss: reward-prediction")
    monkeypatch.chdir(tmp_path)
    for config in (load_config(path), load_config("searches/search.yml")):
        assert config.hyperparameters_for("Pendulum-v1")["batch_size"] == 64
        assert config.initial == (catalog.load("reward-prediction"),)
        assert config.path == path


def test_a_search_may_start_from_given_losses(tmp_path: Path) -> None:
    (tmp_path / "winner.yml").write_text("aux_loss: '{s_t} -> {r_t}'")
    published = tuple(catalog.published().values())

    def initial(value: Any, **keys: Any) -> tuple[AuxLoss, ...]:
        return load_config(write(tmp_path, CONFIG | {"initial": value} | keys)).sampler_settings()["initial"]

    assert initial("published") == published
    assert initial("published", max_horizon=3) == tuple(loss for loss in published if loss.horizon <= 3)
    # Without operators the space has mean squared error only; of the handcrafted losses these have it.
    without_operators = {catalog.load(f"{name}-{kind}") for name, kind in (("forward", "dynamics"), ("inverse", "dynamics"))}
    assert {*initial("handcrafted")} == without_operators | {
        catalog.load("reward-prediction"),
        catalog.load("action-inference"),
    }
    assert catalog.load("curl") in initial("handcrafted", operators=["mse", "bilinear"])
    assert initial(["{s_t} -> {r_t}", "forward-dynamics"]) == (REWARD, FORWARD)
    assert initial("winner.yml") == initial("{s_t} -> {r_t}") == (REWARD,)
    assert initial(["winner.yml", "published"]) == (REWARD, *published)


def test_imported_modules_may_register_environments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_envs.py").write_text(
        "import gymnasium as gym\ngym.register('Own-v0', 'gymnasium.envs.classic_control.pendulum:PendulumEnv')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    try:
        config = load_config(write(tmp_path, CONFIG | {"environment": "Own-v0", "imports": ["own_envs"]}))
        assert (config.environment, config.imports) == ("Own-v0", ("own_envs",))
    finally:
        gym.registry.pop("Own-v0", None)
        sys.modules.pop("own_envs", None)


# Hyper-parameters.


def test_an_environments_own_entry_is_merged_over_the_default(tmp_path: Path) -> None:
    own = {"env_kwargs": {"frame_stack": 2}, "learning_rate": "REPLACED"}
    write(tmp_path, hyper=yaml.safe_dump(HYPER | {"Pendulum-v1": own}).replace("REPLACED", "1e-3"))
    path = tmp_path / "hyper.yml"
    assert load_hyperparameters(path, "Pendulum-v1") == {
        "env_kwargs": {"action_repeat": 4, "frame_stack": 2},
        "batch_size": 64,
        "learning_rate": 0.001,  # YAML 1.1 would have taken it for text
    }
    assert load_hyperparameters(path, "dm_control/fish-swim-v0") == HYPER["default"]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("buffer_size: 1e5", 100_000),
        ("buffer_size: 100000.0", 100_000),
        ("tau: 1", 1.0),
        ("tau: 5.0e-3", 0.005),
        ("train_freq: 2", 2),
        ("train_freq: [1, episode]", (1, "episode")),  # SB3 requires a tuple
        ("ent_coef: 0.1", 0.1),
        ("ent_coef: auto_0.1", "auto_0.1"),
        ("learning_rate: lin_7.3e-4", "lin_7.3e-4"),
        ("aux_kwargs: {learning_rate: lin_0.001}", {"learning_rate": "lin_0.001"}),
        ("aux_kwargs: null", None),
        ("ent_coef_optimizer_kwargs: {betas: [0.5, 0.999]}", {"betas": [0.5, 0.999]}),
        ("aux_loss: auto", "auto"),
        ("aux_loss: none", None),
        ("aux_loss: '{s_t} -> {r_t}'", "{s_t} -> {r_t}"),
        ("normalize: true", True),
        ("normalize: {norm_reward: false, clip_obs: 5}", {"norm_reward": False, "clip_obs": 5}),
        ("env_wrapper: gymnasium.wrappers.ClipAction", "gymnasium.wrappers.ClipAction"),
        (
            "env_wrapper: [rl_zoo3.wrappers.HistoryWrapper: {horizon: 2}]",
            [{"rl_zoo3.wrappers.HistoryWrapper": {"horizon": 2}}],
        ),
        ("vec_env: subproc", "subproc"),
        ("policy_kwargs: {net_arch: {pi: [8], qf: [4]}}", {"net_arch": {"pi": [8], "qf": [4]}}),
        ("policy_kwargs: {features_extractor_kwargs: null}", {"features_extractor_kwargs": None}),
        ("policy_kwargs: {optimizer_kwargs: {betas: [0.9, 0.99]}}", {"optimizer_kwargs": {"betas": [0.9, 0.99]}}),
        ("replay_buffer_kwargs: {frame_stack: {image: 3}}", {"frame_stack": {"image": 3}}),
    ],
)
def test_values_have_the_types_of_the_arguments(tmp_path: Path, text: str, value: Any) -> None:
    (tmp_path / "hyper.yml").write_text(f"default:\n  {text}\n")
    ((key, read),) = load_hyperparameters(tmp_path / "hyper.yml", "Pendulum-v1").items()
    assert key == text.partition(":")[0]
    assert read == value and type(read) is type(value)
    assert check_hyperparameters({key: read}, "Pendulum-v1", "again") == {key: read}


def test_short_names_of_environments() -> None:
    assert resolve_env_id("cheetah-run") == resolve_env_id("dm_control/cheetah-run-v0") == "dm_control/cheetah-run-v0"
    assert resolve_env_id("Cheetah-Run") == "dm_control/cheetah-run-v0"  # the paper's
    assert resolve_env_id("humanoid_CMU-run") == "dm_control/humanoid_CMU-run-v0"
    assert resolve_env_id("Pendulum-v1") == "Pendulum-v1"
    with pytest.raises(ConfigError, match="cheetah-run"):
        resolve_env_id("chetah-run")


# What is refused.

PENDULUM = {"environment": "Pendulum-v1", "returns": [-1500, -100]}
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"populaton_size": 3}, "populaton_size: unknown key, .*'population_size'"),
    ({"cross_validation": {"environments": ["Pendulum-v1"], "sedes": [1]}}, "cross_validation.sedes: .*'seeds'"),
    ({"cross_validation": {"seeds": [1, 2], "top": 3, "budget": 5}}, "cross_validation.budget: must be at least 6"),
    ({"environments": [PENDULUM]}, "environment: set either environment or environments"),
    ({"environment": None, "environments": [{"environment": "Pendulum-v1"}]}, r"environments\[0\].returns: is missing"),
    ({"environment": None, "environments": [PENDULUM | {"returns": [3, 3]}]}, r"environments\[0\].returns: must be .*not \[3"),
    ({"environment": None, "environments": [PENDULUM, PENDULUM]}, "environments: .*none twice.*Pendulum-v1"),
    ({"environment": None, "environments": [PENDULUM | {"overrides": {"gama": 1}}]}, "Pendulum-v1: overrides: gama: unknown"),
    (
        {"environment": None, "environments": [PENDULUM], "cross_validation": {"environments": ["walker-run"]}},
        "cross_validation.returns: dm_control/walker-run-v0 is missing",
    ),
    (
        {"cross_validation": {"environments": ["Pendulum-v1", "walker-run"], "returns": {"Pendulum-v1": [-1500, 0]}}},
        "cross_validation.returns: dm_control/walker-run-v0 is missing",
    ),
    (
        {"cross_validation": {"environments": ["walker-run"], "checkpoints": {"Pendulum-v1": [4]}}},
        "cross_validation.checkpoints: Pendulum-v1 is none of its environments",
    ),
    ({"space": {"gamma": {"type": "float", "low": 0.9}}}, "space.gamma: must be a list of choices, or {type: .*not {"),
    ({"space": {"gamma": {"type": "float", "low": 0.9, "high": 0.8}}}, "space.gamma: .*low"),
    ({"space": {"gama": [0.9]}}, "space.gama: gama: unknown key, .*'gamma'"),
    ({"space": {"aux_loss": ["curl"]}}, "space: aux_loss cannot be set"),
    ({"space": {"batch_size": [8, 0.5]}}, "space.batch_size: batch_size: should be a valid integer"),
    ({"baselines": [{"name": "a", "aux_los": None}]}, r"baselines\[0\].aux_los: .*'aux_loss'"),
    ({"baselines": [{"name": "a", "aux_loss": "curll"}]}, r"baselines\[0\].aux_loss: .*nearest: curl"),
    (
        {"baselines": [{"name": "a", "overrides": {"aux_loss": "curl"}}]},
        r"baselines\[0\].overrides: aux_loss cannot be set",
    ),
    ({"overrides": {"aux_loss": "curl"}}, "overrides: aux_loss cannot be set: a search finds losses"),
    ({"baselines": [{"name": "a"}, {"name": "a"}]}, "baselines: must have at least one item, and none twice"),
    ({"initial": ["curll"]}, "initial: .*nearest: curl"),
    ({"initial": ["curl"]}, "mean squared error"),  # which is all that is searched without `operators`
    ({"initial": "missing.yml"}, "initial: .*missing.yml: .*No such file"),
    ({"imports": ["no_such_module"]}, "imports: no_such_module cannot be imported"),
    ({"environment": 3}, "environment: should be a valid string, not 3"),
    ({"environment": "dm_control/cheetah-rum-v0"}, "environment: unknown environment .*cheetah-run"),
    ({"hyperparameters": "arl_state.yml"}, "hyperparameters: /.*/arl_state.yml is no file, .*nearest: aarl_state"),
    ({"checkpoints": 5}, "checkpoints: should be a list, not 5"),
    ({"checkpoints": []}, r"checkpoints: .*not \[\]"),
    ({"checkpoints": [800, 400]}, "checkpoints: must be environment steps in ascending order"),
    ({"checkpoints": [0, 400]}, r"checkpoints\[0\]: should be greater than 0"),
    ({"checkpoints": [400, 1.5]}, r"checkpoints\[1\]: should be a valid integer, not 1.5"),
    ({"generations": True}, "generations: should be a valid integer, not True"),
    ({"random": 0.9}, "sum to 1"),
    ({"pruner": "medain"}, "pruner: should be .*'median'"),
    ({"seeds": [1, 1]}, "seeds: must have at least one item, and none twice"),
    ({"seeds": [2**32]}, r"seeds\[0\]"),
    ({"cross_validation": {"environments": ["Pendulum"]}}, r"cross_validation.environments\[0\]: .*Pendulum-v1"),
    ({"overrides": {"bach_size": 3}}, "overrides: bach_size: unknown key, .*'batch_size'"),
    ({"overrides": {"seed": 3}}, "overrides: seed: unknown key"),
    ({"overrides": {"env_kwargs": {"action_repeats": 2}}}, "env_kwargs.action_repeats: .*'action_repeat'"),
    ({"overrides": {"env_kwargs": {"action_repeat": 0}}}, "env_kwargs.action_repeat: should be greater than 0"),
    ({"overrides": {"policy_kwargs": 3}}, "policy_kwargs: should be a mapping, not 3"),
    ({"overrides": {"policy": "MlpLstmPolicy"}}, "policy: should be 'MlpPolicy'"),
    ({"overrides": {"batch_size": "many"}}, "batch_size: should be a valid integer, not 'many'"),
    ({"overrides": {"learning_rate": "exp_1e-3"}}, "learning_rate: should be a valid number, not 'exp_1e-3', or .*lin_"),
    ({"overrides": {"env_wrapper": "os.TimeLimit"}}, "env_wrapper: must name a gymnasium.Wrapper .*not 'os.TimeLimit'"),
    ({"overrides": {"env_wrapper": [{"gymnasium.wrappers.TimeLimit": 3}]}}, "env_wrapper: must name .*TimeLimit': 3}"),
    ({"overrides": {"replay_buffer_class": "HerReplayBuffer"}}, "replay_buffer_class: cannot be set in a file"),
    ({"overrides": {"callback": "rl_zoo3.callbacks.ParallelTrainCallback"}}, "callback: unknown key"),
    ({"overrides": {"train_freq": 0}}, "train_freq must be a positive number of steps"),
    ({"overrides": {"n_envs": 1.5}}, "n_envs: should be a valid integer"),
    ({"overrides": {"vec_env": "threads"}}, "vec_env: should be 'dummy' or 'subproc', not 'threads'"),
]


@pytest.mark.parametrize(("change", "message"), WRONG, ids=[str(change)[:60] for change, _ in WRONG])
def test_one_clear_line_for_a_problem(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write(tmp_path, CONFIG | change)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    text = str(error.value)
    assert re.search(message, text) and "\n" not in text
    assert str(tmp_path) in text  # which file


def test_every_problem_has_a_line(tmp_path: Path) -> None:
    path = write(tmp_path, CONFIG | {"checkpoints": [8, 4], "seds": [1], "cross_validation": {"environments": ["x"], "to": 1}})
    with pytest.raises(ConfigError) as error:
        load_config(path)
    keys = ["checkpoints", "cross_validation.environments[0]", "cross_validation.to", "seds"]
    assert [line.split(": ")[:2] for line in str(error.value).splitlines()] == [[str(path), key] for key in keys]


def test_arguments_of_an_environment_are_those_of_its_wrapper() -> None:
    values = {"env_kwargs": {"image_size": 84}}
    assert check_hyperparameters(values, "dm_control/cheetah-run-v0", "here") == values
    with pytest.raises(ConfigError, match=r"env_kwargs.image_size: unknown key"):
        check_hyperparameters(values, "Pendulum-v1", "here")


@pytest.mark.parametrize("key", [key for key in CONFIG if key != "hyperparameters"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    path = write(tmp_path, {name: value for name, value in CONFIG.items() if name != key})
    with pytest.raises(ConfigError, match=rf"search.yml: {key}: is missing$"):
        load_config(path)


def test_the_entry_of_an_environment_may_have_its_short_name_and_is_missed(tmp_path: Path) -> None:
    path = write(tmp_path, hyper={"Pendulum-v1": {}})
    with pytest.raises(ConfigError, match=r"hyper.yml: neither 'dm_control/cheetah-run-v0' nor 'default'"):
        load_config(path)
    with pytest.raises(ConfigError, match=r"hyper.yml: default must be a mapping"):
        load_config(write(tmp_path, hyper={"default": 3}))
    for name in ("dm_control/cheetah-run-v0", "Cheetah-Run"):
        config = load_config(
            write(tmp_path, hyper={"default": {"gamma": 0.9, "tau": 0.1}, name: {"gamma": 0.5}, "other": None})
        )
        assert config.hyperparameters_for("dm_control/cheetah-run-v0") == {"gamma": 0.5, "tau": 0.1}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: [1", "line 1"),
        ("a: 1\nb: {c: 2\nd: 3", "line 3"),
        ("a: 1\n b: 2", "line 2"),
        ("a: 1\nb: {c: 1, c: 2}", "line 2: 'c' appears twice"),
        ("a: &x {b: 1}\n<<: *x\n<<: *x", None),
        ("a: &x {b: 1, c: 1}\nd: {<<: *x, b: 2}", None),  # a merge is overwritten, as YAML has it
        ("", "must hold a mapping"),
        ("a: 2020-13-45", "month"),
        ("a: &x [*x]", "Circular reference"),
        ("a: " + "[" * 1000, "recursion"),
        ("a: !!python/object/apply:subprocess.check_call [[touch, '{marker}']]", "line 1"),
        ("a: !!python/object/new:os.system ['touch {marker}']", "line 1"),
    ],
)
def test_files_that_are_not_plain_are_refused_and_evaluate_nothing(tmp_path: Path, text: str, problem: str | None) -> None:
    path, marker = tmp_path / "file.yml", tmp_path / "evaluated"
    path.write_text(text.replace("{marker}", str(marker)))
    if problem is None:
        assert read_yaml(path)
        return
    for read in (read_yaml, catalog.resolve):
        with pytest.raises(ConfigError, match=f"file.yml: .*{problem}") as error:
            read(path)
    assert "\n" not in str(error.value)
    assert not marker.exists()


def test_rl_zoos_own_hyperparameters_of_sac() -> None:
    """All but texts that RL-Zoo evaluates, and what is not installed."""
    rl_zoo3 = pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    path = Path(rl_zoo3.__file__).parent / "hyperparams" / "sac.yml"
    refused = set()
    for name, entry in (entries := read_yaml(path)).items():
        try:
            load_hyperparameters(path, name)
        except ConfigError as error:
            keys = {line.removeprefix(f"{path}: ").partition(":")[0] for line in str(error).splitlines()}
            texts = {key for key, value in {**entries["default"], **entry}.items() if str(value).startswith(("dict(", "{"))}
            refused |= keys - texts
    assert refused == {"env_wrapper", "replay_buffer_class"}
    assert len(entries) == 26


def test_text_is_not_evaluated(tmp_path: Path) -> None:
    """As RL-Zoo does with its files."""
    code = f"__import__('pathlib').Path({str(tmp_path / 'evaluated')!r}).touch()"
    keys = (
        "learning_rate",
        "policy",
        "env_kwargs",
        "env_wrapper",
        "ent_coef",
        "tensorboard_log",
        "policy_kwargs",
        "normalize",
    )
    for key, value in [(key, code) for key in keys] + [(key, f"dict(gamma={code})") for key in keys]:
        try:
            check_hyperparameters({key: value}, "Pendulum-v1", "here")
        except ConfigError:
            assert key not in ("ent_coef", "tensorboard_log")  # which may be text
    assert not (tmp_path / "evaluated").exists()


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=10), inner, max_size=3),
    max_leaves=8,
)
keys = st.sampled_from([name for name in SearchConfig.model_fields if name not in ("path", "imports")]) | st.text(max_size=12)
hyper_keys = st.sampled_from(
    ["batch_size", "learning_rate", "policy", "env_kwargs", "policy_kwargs", "train_freq", "aux_loss", "normalize"]
)


@given(st.dictionaries(keys, plain, max_size=4), st.dictionaries(hyper_keys, plain, max_size=3))
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_plain_values_are_read_or_refused(tmp_path: Path, change: dict[str, Any], hyper: dict[str, Any]) -> None:
    path = write(tmp_path, CONFIG | change, {"default": HYPER["default"] | hyper})
    try:
        config = load_config(path)
    except ConfigError as error:
        assert str(tmp_path) in str(error)
    else:
        assert isinstance(config, SearchConfig)
