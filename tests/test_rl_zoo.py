"""RL-Zoo's own programs with SACAux and our files of hyper-parameters."""

import re
import sys
from ast import literal_eval
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from stable_baselines3.common.monitor import load_results

from sb3_aarl import SACAux, catalog
from sb3_aarl.encoders import DenseMLP
from sb3_aarl.envs import make_dmc_env
from sb3_aarl.rl_zoo import main, with_env_kwargs

ZOO = Path(__file__).parent.parent / "zoo_configs"
TASK = "dm_control/cheetah-run-v0"
SAC_AUX = ["--algo", "sac_aux", "--env", TASK]


def run(folder: Path, *arguments: str) -> None:
    """A program of RL-Zoo, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        patch.setattr(sys, "argv", ["sb3_aarl.rl_zoo", *arguments])
        main()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder where RL-Zoo trained for 280 agent steps, 20 of them with gradient steps, and evaluated twice."""
    pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    folder = tmp_path_factory.mktemp("zoo")
    small = ["-params", "learning_starts:260", "batch_size:8", "buffer_size:500"]
    settings = ["-n", "280", "--eval-freq", "135", "--eval-episodes", "2", "--device", "cpu", "--seed", "3", *small]
    run(folder, "train", *SAC_AUX, "-conf", str(ZOO / "paper/aarl_state.yml"), *settings)
    return folder / "logs/sac_aux/dm_control-cheetah-run-v0_1"


@pytest.mark.slow
def test_trains_with_the_hyperparameters_of_the_file(trained: Path) -> None:
    model = SACAux.load(trained / "dm_control-cheetah-run-v0.zip", device="cpu")
    assert type(model) is SACAux and model.num_timesteps == 280 and model._n_updates == 20
    assert (model.batch_size, model.buffer_size, model.learning_starts, model.seed) == (8, 500, 260, 3)
    # Table 8.
    assert model.lr_schedule(1) == 2e-4  # Cheetah-Run's own
    assert (model.tau, model.aux_kwargs["tau"], model.gamma, model.target_update_interval) == (0.01, 0.05, 0.99, 2)
    assert (model.ent_coef, model.ent_coef_optimizer_kwargs) == ("auto_0.1", {"lr": 1e-4, "betas": [0.5, 0.999]})
    assert model.aux_loss == catalog.load("aarl-state") and model.aux_kwargs["predictor_width"] == 256
    assert model.policy_kwargs["net_arch"] == [1024, 1024]
    assert type(model.critic.features_extractor) is DenseMLP and model.critic.features_extractor.features_dim == 40
    # The action repeat of 4 in training and evaluation.
    assert list(load_results(str(trained)).l) == [250]
    assert np.load(trained / "evaluations.npz")["ep_lengths"].tolist() == [[250, 250], [250, 250]]


@pytest.mark.slow
def test_enjoy_and_record_video(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = trained.parents[2]
    run(folder, "enjoy", *SAC_AUX, "-f", "logs", "-n", "260", "--no-render", "--device", "cpu", "--seed", "5")
    printed = capsys.readouterr().out
    run(folder, "record_video", *SAC_AUX, "-f", "logs", "-n", "3", "-o", "videos")
    assert [path.suffix for path in (folder / "videos").iterdir()] == [".mp4"]

    model = SACAux.load(trained / "dm_control-cheetah-run-v0.zip", device="cpu")
    env = make_dmc_env(TASK, action_repeat=4)
    observation, _ = env.reset(seed=5)
    episode_reward = 0.0
    for _ in range(250):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, _, truncated, _ = env.step(action)
        episode_reward += float(reward)
    assert truncated
    assert f"Episode Reward: {episode_reward:.2f}\nEpisode Length 250\n" in printed


MY_ENVS = """
import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import PendulumEnv

class Mine(PendulumEnv):
    def render(self):
        return np.zeros((64, 64, 3), np.uint8)

gym.register("Mine-v0", Mine, max_episode_steps=20)
"""
SMALL = """
default: {n_timesteps: 60, policy: MlpPolicy, learning_rate: lin_1e-3, learning_starts: 40, batch_size: 8,
  normalize: "dict(norm_obs=True, norm_reward=False)", env_wrapper: [rl_zoo3.wrappers.HistoryWrapper: {horizon: 2}],
  policy_kwargs: "dict(net_arch=[8])"}
"""


@pytest.mark.slow
def test_an_environment_of_ones_own_needs_no_program(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    for name, text in (("my_envs.py", MY_ENVS), ("small.yml", SMALL)):
        (tmp_path / name).write_text(text)
    mine = ["--algo", "sac_aux", "--env", "Mine-v0", "--gym-packages", "my_envs"]
    run(tmp_path, "train", *mine, "-conf", "small.yml", "--eval-freq", "-1", "--device", "cpu")
    run(tmp_path, "record_video", *mine, "-f", "logs", "-n", "3", "-o", "videos")
    model = SACAux.load(tmp_path / "logs/sac_aux/Mine-v0_1/Mine-v0.zip", device="cpu")
    assert model.num_timesteps == 60 and model._n_updates == 20 and model.observation_space.shape == (2 * 3 + 2,)
    assert [model.lr_schedule(share) for share in (1, 0.5)] == [1e-3, 5e-4]
    assert [path.suffix for path in (tmp_path / "videos").iterdir()] == [".mp4"]


def added(arguments: list[str]) -> dict[str, object]:
    """What is behind the last --env-kwargs, as RL-Zoo reads it: values are Python, the last of a key counts."""
    values = arguments[len(arguments) - arguments[::-1].index("--env-kwargs") :]
    return {key: literal_eval(value) for key, _, value in (item.partition(":") for item in values)}


@pytest.mark.slow
def test_optimizes_what_rl_zoo_optimizes_of_sac(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    trials = ["-optimize", "--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1", "--sampler", "random"]
    trials += ["--pruner", "none"]  # RL-Zoo prunes failed trials; a pruner might prune the second trial
    settings = ["-n", "280", "--eval-episodes", "1", "--device", "cpu", "--seed", "3", "-params", "learning_starts:260"]
    run(tmp_path, "train", *SAC_AUX, "-conf", str(ZOO / "paper/aarl_state.yml"), *trials, *settings)
    (report,) = (tmp_path / "logs" / "sac_aux").glob("report_*.csv")
    rows = pd.read_csv(report)
    assert list(rows["state"]) == ["COMPLETE"] * 2 and rows["value"].notna().all()
    assert {"params_learning_rate", "params_tau", "params_net_arch", "params_one_minus_gamma"} <= set(rows)


def test_environment_arguments_of_the_file() -> None:
    walker = ["--algo", "sac_aux", "--env", "dm_control/walker-walk-v0", "-conf", str(ZOO / "paper/aarl_pixel.yml")]
    pixels = {"pixels": True, "image_size": 100, "frame_stack": 3, "action_repeat": 2}
    arguments = with_env_kwargs([*walker, "-n", "5"])
    assert arguments[:8] == [*walker, "-n", "5"] and added(arguments) == pixels
    # Given ones win; what is in no entry is the default's.
    arguments = with_env_kwargs(["--env-kwargs", "image_size:84", "fast_rendering:True", *walker])
    assert added(arguments) == {**pixels, "image_size": 84, "fast_rendering": True}
    other = [*walker[:3], "dm_control/fish-swim-v0", "--conf-file", walker[5]]
    assert added(with_env_kwargs(other)) == {**pixels, "action_repeat": 4}


@pytest.mark.parametrize("arguments", [["--algo", "ppo"], ["--algo", "sac_aux", "-conf", "my.module"], ["--help"]])
def test_what_is_not_ours_stays(arguments: list[str]) -> None:
    assert with_env_kwargs(arguments) == arguments


def test_plain_values_reach_rl_zoo_as_they_are(tmp_path: Path) -> None:
    values = "{a: 1, b: [1, -2.5, null], c: {d: true}, e: 'x: __import__(1)#', f: \"'quoted'\"}"
    (tmp_path / "own.yml").write_text(f"default: {{env_kwargs: {values}}}")
    arguments = with_env_kwargs([*SAC_AUX, "-conf", str(tmp_path / "own.yml")])
    assert added(arguments) == {"a": 1, "b": [1, -2.5, None], "c": {"d": True}, "e": "x: __import__(1)#", "f": "'quoted'"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read: No such file"),
        ("default: 3", "must be mappings"),
        ("default: {env_kwargs: 'dict(g=1)'}", "must be mappings"),
    ],
)
def test_one_error_for_a_file_that_cannot_be_used(
    content: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "own.yml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SystemExit):
        with_env_kwargs([*SAC_AUX, "-conf", str(path)])
    assert re.search(rf"error: {path}: .*{message}", capsys.readouterr().err)


@pytest.mark.parametrize("text", ["default: {env_kwargs: }", "default: {batch_size: 8}", "a: {}"])
def test_no_arguments_of_the_environment(text: str, tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text(text)
    arguments = [*SAC_AUX, "-conf", str(tmp_path / "own.yml")]
    assert with_env_kwargs(arguments) == arguments


def test_without_a_file_it_has_the_defaults() -> None:
    arguments = with_env_kwargs(SAC_AUX)
    assert Path(arguments[arguments.index("-conf") + 1]) == ZOO / "sac_aux.yml" and added(arguments) == {"action_repeat": 2}
