"""
RL-Zoo's own programs with SACAux, as ``sac_aux``, and with DeepMind Control as SACAux needs it.

    python -m sb3_aarl.rl_zoo train --algo sac_aux --env dm_control/cheetah-run-v0 -conf zoo_configs/paper/aarl_state.yml
    python -m sb3_aarl.rl_zoo enjoy --algo sac_aux --env dm_control/cheetah-run-v0 -f logs
    python -m sb3_aarl.rl_zoo record_video --algo sac_aux --env dm_control/cheetah-run-v0 -f logs -n 250
    python -m sb3_aarl.rl_zoo load_from_hub --algo sac_aux --env dm_control/cheetah-run-v0 -f logs -orga NAME

``--gym-packages my_envs`` imports modules that register environments, in every program that makes some.

``train -optimize`` samples what RL-Zoo samples for SAC, and ``policy_kwargs`` are RL-Zoo's own then, not the file's.

Everything after the program's name is RL-Zoo's: see ``python -m sb3_aarl.rl_zoo train --help``. RL-Zoo's programs for plots
read log files alone: ``python -m rl_zoo3.plots.plot_train -a sac_aux -e dm_control-cheetah-run-v0 -f logs``.
"""

import argparse
import functools
import importlib
import runpy
import sys
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import gymnasium as gym

from sb3_aarl.envs import env_ids, make_dmc_env  # first: it chooses the renderer
from sb3_aarl.files import ConfigError, read_yaml
from sb3_aarl.sac_aux import SACAux

# The first two are functions in modules of RL-Zoo, the others scripts. push_to_hub is missing: RL-Zoo 2.9.2's fails for all
# algorithms, as it imports a function that sb3-team-hf-integration 3.2 does not have.
FUNCTIONS = ("train", "enjoy")
PROGRAMS = (*FUNCTIONS, "record_video", "load_from_hub")


def register() -> None:
    """
    Make SACAux known to RL-Zoo as ``sac_aux``, and have it make DeepMind Control's tasks with ``make_dmc_env``.

    Their ``env_kwargs`` are then those of ``make_dmc_env``, as for ``aarl``; ``gymnasium.make`` stays what it is. Other
    environments are made as RL-Zoo makes them; the key ``env_wrapper`` can name ``sb3_aarl.envs.wrap_env`` for them.
    """
    from rl_zoo3 import ALGOS  # type: ignore[import-not-found]
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER  # type: ignore[import-not-found]

    # The one dictionary of each kind that all of RL-Zoo's modules have imported.
    ALGOS["sac_aux"] = SACAux
    HYPERPARAMS_SAMPLER["sac_aux"] = HYPERPARAMS_SAMPLER["sac"]
    HYPERPARAMS_CONVERTER["sac_aux"] = HYPERPARAMS_CONVERTER["sac"]
    for env_id in env_ids():
        # RL-Zoo makes environments with this method of their specification.
        gym.registry[env_id].make = functools.partial(_make_env, env_id)  # type: ignore[method-assign]


def _make_env(env_id: str, render_mode: str | None = None, **env_kwargs: Any) -> gym.Env:
    """``make_dmc_env`` for RL-Zoo, whose ``render_mode`` it does not need: SB3 shows its images in a window."""
    return make_dmc_env(env_id, **env_kwargs)


def with_env_kwargs(arguments: Sequence[str]) -> list[str]:
    """
    Arguments of ``train`` with the ``env_kwargs`` of its file of hyper-parameters as ``--env-kwargs``.

    RL-Zoo passes those of the file to the training environment only; those of the command line are stored with the model
    and reach evaluations, ``enjoy`` and ``record_video`` too. Values of the command line win. Without a file, ``sac_aux`` has
    ``zoo_configs/sac_aux.yml``.
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_aarl.rl_zoo train", add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("--env-kwargs", nargs="+", default=[])
    known, _ = parser.parse_known_args(arguments)
    path = known.conf_file
    if path is None and known.algo == "sac_aux":
        path = str(files("sb3_aarl.zoo_configs") / "sac_aux.yml")
        arguments = [*arguments, "-conf", path]
    if path is None or not path.endswith((".yml", ".yaml")):
        return list(arguments)
    try:
        entries = read_yaml(path)
        env_kwargs = entries.get(known.env, entries.get("default", {})).get("env_kwargs") or {}
        values = [f"{key}:{value!r}" for key, value in env_kwargs.items()]
    except ConfigError as error:
        parser.error(str(error))
    except AttributeError:
        parser.error(f"{path}: the entry of {known.env} and its env_kwargs must be mappings")
    return [*arguments, "--env-kwargs", *values, *known.env_kwargs] if values else list(arguments)


def main() -> None:
    """Run one of RL-Zoo's programs with the arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_aarl.rl_zoo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("program", choices=PROGRAMS)
    program = parser.parse_args(sys.argv[1:2]).program
    arguments = sys.argv[2:]
    if program == "record_video":
        # RL-Zoo has this option for train and enjoy.
        packages = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        packages.add_argument("--gym-packages", nargs="+", default=[])
        known, arguments = packages.parse_known_args(arguments)
        for name in known.gym_packages:
            importlib.import_module(name)
    try:
        register()
    except ModuleNotFoundError as error:
        parser.error(f"{error}: pip install 'sb3-aarl[zoo]'")
    if program == "train":
        arguments = with_env_kwargs(arguments)
    sys.argv = [f"{parser.prog} {program}", *arguments]
    if program in FUNCTIONS:
        getattr(importlib.import_module(f"rl_zoo3.{program}"), program)()
    else:
        runpy.run_module(f"rl_zoo3.{program}", run_name="__main__")


if __name__ == "__main__":
    main()
