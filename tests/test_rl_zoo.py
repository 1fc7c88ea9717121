"""RL-Zoo's own programs with SACAux and our files of hyper-parameters."""

import os
import re
import shutil
import subprocess
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
from sb3_aarl.rl_zoo import with_env_kwargs

ZOO = Path(__file__).parent.parent / "zoo_configs"
TASK = "dm_control/cheetah-run-v0"
SAC_AUX = ["--algo", "sac_aux", "--env", TASK]


def run(folder: Path, *command: str) -> str:
    """What a Python process prints."""
    done = subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def in_one_process(folder: Path, *programs: list[str], then: str = "") -> str:
    """What programs of RL-Zoo print, one after the other: importing takes longer than all they do."""
    lines = [f"sys.argv = {['', *program]}\nmain()" for program in programs]
    return run(folder, "-c", "\n".join(["import sys", "from sb3_aarl.rl_zoo import main", *lines, then]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder where RL-Zoo trained for 280 agent steps, 20 of them with gradient steps, and evaluated twice."""
    pytest.importorskip("rl_zoo3", reason="pip install 'sb3-aarl[zoo]'")
    folder = tmp_path_factory.mktemp("zoo")
    small = ["-params", "learning_starts:260", "batch_size:8", "buffer_size:500"]
    settings = ["-n", "280", "--eval-freq", "135", "--eval-episodes", "2", "--device", "cpu", "--seed", "3", *small]
    run(folder, "-m", "sb3_aarl.rl_zoo", "train", *SAC_AUX, "-conf", str(ZOO / "paper/aarl_state.yml"), *settings)
    return folder / "logs/sac_aux/dm_control-cheetah-run-v0_1"


@pytest.mark.slow
def test_trains_with_the_hyperparameters_of_the_file(trained: Path) -> None:
    model = SACAux.load(trained / "dm_control-cheetah-run-v0.zip", device="cpu")
    assert type(model) is SACAux and model.num_timesteps == 280 and model._n_updates == 20
    assert (model.batch_size, model.buffer_size, model.learning_starts, model.seed) == (8, 500, 260, 3)
    # Table 8.
    assert model.lr_schedule(1) == 2e-4  # Cheetah-Run's own
    assert (model.tau, model.encoder_tau, model.gamma, model.target_update_interval) == (0.01, 0.05, 0.99, 2)
    assert (model.ent_coef, model.ent_coef_learning_rate, list(model.ent_coef_betas)) == ("auto_0.1", 1e-4, [0.5, 0.999])
    assert model.aux_loss == catalog.load("aarl-state") and model.predictor_width == 256
    assert model.policy_kwargs["net_arch"] == [1024, 1024]
    assert type(model.critic.features_extractor) is DenseMLP and model.critic.features_extractor.features_dim == 40
    # The action repeat of 4 in training and evaluation.
    assert list(load_results(str(trained)).l) == [250]
    assert np.load(trained / "evaluations.npz")["ep_lengths"].tolist() == [[250, 250], [250, 250]]


@pytest.mark.slow
def test_enjoy_record_video_and_plots(trained: Path) -> None:
    folder = trained.parents[2]
    for i in (1, 2):  # plot_from_file needs two runs
        copy = folder / "two/sac_aux" / trained.name.replace("_1", f"_{i}")
        shutil.copytree(trained, copy, ignore=shutil.ignore_patterns("*.zip"))
    programs = [
        ["enjoy", *SAC_AUX, "-f", "logs", "-n", "260", "--no-render", "--device", "cpu", "--seed", "5"],
        ["record_video", *SAC_AUX, "-f", "logs", "-n", "3", "-o", "videos"],
        ["all_plots", "-a", "sac_aux", "-e", TASK, "-f", "two", "-o", "curves", "--no-display"],
        ["plot_from_file", "-i", "curves"],
        ["plot_train", "-a", "sac_aux", "-e", TASK, "-f", "logs", "-w", "1"],
    ]
    n_points = "from matplotlib import pyplot as plt; print([len(line.get_xdata()) for line in plt.gca().lines])"
    printed = in_one_process(folder, *programs, then=n_points)

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
    assert [path.suffix for path in (folder / "videos").iterdir()] == [".mp4"]
    rows = [line.split("|")[1:-1] for line in printed.splitlines() if line.startswith("|dm_control-cheetah-run-v0")]
    last = np.load(trained / "evaluations.npz")["results"][-1].mean()
    assert [row[1].split("+/-")[0].strip() for row in rows] == [f"{last:.0f}"] * 2  # all_plots, plot_from_file
    assert printed.endswith("[1]\n")  # one curve, of one episode


@pytest.mark.slow
def test_records_training(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install 'sb3-aarl[zoo]'").get_ffmpeg_exe()
    (tmp_path / "ffmpeg").symlink_to(ffmpeg)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    program = ["-m", "sb3_aarl.rl_zoo", "record_training", *SAC_AUX, "-n", "3"]
    run(tmp_path, *program, "-f", str(trained.parents[1]), "-o", str(tmp_path / "videos"))
    names = sorted(path.name.partition("-sac_aux")[0] for path in (tmp_path / "videos").iterdir())
    assert names == ["best-model", "final-model", "training.mp4"]


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
    in_one_process(
        tmp_path,
        ["train", *mine, "-conf", "small.yml", "--eval-freq", "-1", "--device", "cpu"],
        ["record_video", *mine, "-f", "logs", "-n", "3", "-o", "videos"],
    )
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
    run(tmp_path, "-m", "sb3_aarl.rl_zoo", "train", *SAC_AUX, "-conf", str(ZOO / "paper/aarl_state.yml"), *trials, *settings)
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


@pytest.mark.parametrize("key", ["action_repeat:__import__('os').system('touch executed')or 2#", "action repeat", ""])
def test_what_rl_zoo_would_evaluate_is_refused(key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.yml").write_text(f'default: {{env_kwargs: {{"{key}": 1}}}}')
    with pytest.raises(SystemExit):
        with_env_kwargs([*SAC_AUX, "-conf", str(tmp_path / "own.yml")])
    assert "env_kwargs must be a mapping from arguments of the environment to values, not" in capsys.readouterr().err


def test_plain_values_reach_rl_zoo_as_they_are(tmp_path: Path) -> None:
    values = "{a: 1, b: [1, -2.5, null], c: {d: true}, e: 'x: __import__(1)#', f: \"'quoted'\"}"
    (tmp_path / "own.yml").write_text(f"default: {{env_kwargs: {values}}}")
    arguments = with_env_kwargs([*SAC_AUX, "-conf", str(tmp_path / "own.yml")])
    assert added(arguments) == {"a": 1, "b": [1, -2.5, None], "c": {"d": True}, "e": "x: __import__(1)#", "f": "'quoted'"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read: No such file"),
        (b"[1, 2]", "must hold a mapping"),
        (b"", "must hold a mapping"),
        (b"{a: b", "line 1"),
        (b"!!python/object/apply:os.getcwd []", "line 1"),
        (b"# r\xe9glages\ndefault: {}", "utf-8"),
        (b"default: 3", "default must be a mapping, not 3"),
        (b"default: {env_kwargs: [g]}", "env_kwargs must be a mapping"),
        (b"default: {env_kwargs: 0}", "env_kwargs must be a mapping"),
        (b"default: {env_kwargs: 'dict(g=1)'}", "env_kwargs must be a mapping"),
        (b"default: {env_kwargs: {g: 1, g: 2}}", "line 1: 'g' is there twice"),
    ],
)
def test_one_error_for_a_file_that_cannot_be_used(
    content: bytes | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "own.yml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SystemExit):
        with_env_kwargs([*SAC_AUX, "-conf", str(path)])
    assert re.search(rf"error: {path}: .*{message}", capsys.readouterr().err)


@pytest.mark.parametrize(
    "text", ["default: {env_kwargs: }", f"{TASK}: {{env_kwargs: null}}", "default: {batch_size: 8}", "a: {}"]
)
def test_no_arguments_of_the_environment(text: str, tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text(text)
    arguments = [*SAC_AUX, "-conf", str(tmp_path / "own.yml")]
    assert with_env_kwargs(arguments) == arguments


def test_without_a_file_it_has_the_defaults() -> None:
    arguments = with_env_kwargs(SAC_AUX)
    assert Path(arguments[arguments.index("-conf") + 1]) == ZOO / "sac_aux.yml" and added(arguments) == {"action_repeat": 4}
    assert Path(with_env_kwargs(["--algo", "sac_aux", "--env", "Pendulum-v1"])[-1]) == ZOO / "sac_aux.yml"
