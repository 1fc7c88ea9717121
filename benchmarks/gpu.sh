#!/usr/bin/env bash
# What SACAux does on a GPU, in at most nine minutes, the most important first; each part writes its result before the next begins.
#
#     benchmarks/gpu.sh OUT              on a machine with a GPU: OUT/*.json, OUT/*.csv, OUT/*.txt
#     benchmarks/gpu.sh OUT --rehearse   the same in miniature on the CPU, in about five minutes
#
# Needs PyTorch with CUDA, the extras dmc and search, pytest, and a renderer: MUJOCO_GL=egl on the GPU. Where there is no network,
# bring wheels of mujoco<4, dm-control, dm-env, dm-tree, labmaze, glfw, pyopengl, gymnasium, farama-notifications, shimmy,
# stable-baselines3, optuna, alembic, sqlalchemy, Mako, colorlog, cloudpickle, absl-py, pydantic, pydantic-core, annotated-types,
# typing-inspection, filelock>=4, rich, typer, shellingham, tqdm and tenacity. sb3_aarl has to be installed (pip install --no-deps
# --no-build-isolation .), as each run stores its version. Nothing else may use the machine: the only try so far, on an H100 whose
# cores trained twelve agents, gave no figure at all, as each part of 70 seconds was cut off before its first result.
set -u
cd "$(dirname "$0")/.."
out=$(mkdir -p "$1" && cd "$1" && pwd)
device=cuda steps=30 rounds=5 every=5k settings="small state pixels pixels-512"
if [ "${2:-}" = --rehearse ]; then device=cpu steps=1 rounds=1 every=2k settings="small"; fi
python=${PYTHON:-python3}
export MUJOCO_GL=${MUJOCO_GL:-egl} PYTHONUNBUFFERED=1

step() {  # NAME SECONDS COMMAND...: one part, its output in NAME.txt, and how it ended in parts.txt
    local name=$1 seconds=$2 started=$SECONDS
    shift 2
    timeout -k 5 "$seconds" "$@" > "$out/$name.txt" 2>&1
    echo "$name: exit $?, $((SECONDS - started)) s, until $SECONDS s" | tee -a "$out/parts.txt"
}

{ nvidia-smi || lscpu; } > "$out/machine.txt" 2>&1
# A gradient step with the GPU to itself.
for setting in $settings; do
    step "eager_$setting" 70 "$python" benchmarks/train_step.py --device $device --settings "$setting" --compiled no \
        --rounds $rounds --steps $steps --out "$out/eager_$setting.json"
done
# From pixels to the end: six runs at once on the one GPU. They go on until they are done or the machine is taken away.
setsid nohup "$python" -m sb3_aarl.search.cli.main benchmark results/pixels/cheetah_run/variants.yml \
    --envs cheetah-run --seeds 0,1 --checkpoints 100k --every $every --episodes 3 --workers 6 --folder "$out/pixels" \
    > "$out/pixels.txt" 2>&1 < /dev/null &
# The tests that need CUDA.
step tests 100 "$python" -m pytest -q -p no:cacheprovider --noconftest tests/test_train_modes.py -k "gpu or cuda"
# Compiled, beside the six runs: only the ratios mean something.
for setting in ${settings%% pixels*}; do
    for way in only graphs; do
        [ "$device $way" = "cpu graphs" ] && continue
        step "${way}_$setting" 100 "$python" benchmarks/train_step.py --device $device --settings "$setting" --compiled $way \
            --rounds $rounds --steps $steps --out "$out/${way}_$setting.json"
    done
done
benchmarks/gpu_curves.sh "$out"
