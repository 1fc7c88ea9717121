#!/usr/bin/env bash
# What SACAux does on a GPU, in two calls of at most nine minutes each, the most important first:
#
#     benchmarks/gpu.sh OUT             gradient steps, the tests that need CUDA, several runs at once, compiled losses
#     benchmarks/gpu.sh OUT --curves    Cheetah-Run from pixels, six runs at once; a further call on the machine continues them
#     REHEARSAL=1 benchmarks/gpu.sh ... the same in miniature on the CPU
#
# Each part has a limit of time and writes its result before the next begins; one that fails stops no other. OUT/parts.txt says
# how each ended, OUT/log.txt what it printed; OUT/*.json and OUT/pixels.csv grow row by row. Nothing else may use the machine.
#
# Needs Python 3.11 or newer with pip, setuptools, pytest, PyTorch with CUDA, and what stable-baselines3, optuna and the extra
# dmc need. Where there is no network, bring wheels, unpacked into one folder that PYTHONPATH names:
#     pip download --no-deps --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 \
#         --platform manylinux_2_27_x86_64 --platform manylinux2014_x86_64 -d wheels PACKAGE...
#     for wheel in wheels/*.whl; do unzip -qo "$wheel" -d bundle; done
# If absl-py, attrs, cloudpickle, etils, imageio, jinja2, lxml, matplotlib, numpy, packaging, pandas, protobuf, pyparsing,
# pyyaml, requests, rich, scikit-learn, scipy, threadpoolctl, tqdm, typer and wrapt are there, the rest is: alembic
# annotated-types colorlog dm-control dm-env dm-tree farama-notifications filelock>=4 glfw gymnasium labmaze mako mujoco<4
# optuna psycopg psycopg-binary pydantic pydantic-core pyopengl shimmy sqlalchemy stable-baselines3 tenacity typing-extensions
# typing-inspection (psycopg for the tests). bundle/dm_control/locomotion and bundle/mujoco/experimental, half of it, can go.
# The renderer is the NVIDIA driver's EGL, loaded by the debs libegl1 libglvnd0 libopengl0 libgl1 libglx0 libgles2.
set -u
cd "$(dirname "$0")/.."
out=$(mkdir -p "$1" && cd "$1" && pwd)
python=${PYTHON:-python3}
device=cuda limit=530 slower=1 settings="small state pixels pixels-512" compiled="small state pixels" rounds=5 seconds=0.2
processes="1 4 16" at_once=4 batch= seeds=0,1 runs=build/gpu_runs variants=results/pixels/cheetah_run/variants.yml
checkpoints=100k every=5k episodes=3
if [ "${REHEARSAL:-}" ]; then
    device=cpu limit=1800 slower=5 settings="small state pixels" compiled=small rounds=2 seconds=0
    processes="1 2" at_once=1 batch="--batch-size 16" seeds=0 runs=$(mktemp -d) small=$(mktemp --suffix .yml)
    sed 's/n_timesteps:/batch_size: 4\n    aux_kwargs: {batch_size: 4}\n    &/' $variants > "$small"
    variants=$small checkpoints=800 every=400 episodes=1
    export OMP_NUM_THREADS=1
fi
export MUJOCO_GL=${MUJOCO_GL:-egl} PYTHONUNBUFFERED=1 PYTHONSAFEPATH=1

part() {  # NAME SECONDS COMMAND...
    local name=$1 most=$(($2 * slower)) left=$((limit - SECONDS)) started=$SECONDS
    shift 2
    [ $left -ge $most ] || most=$left
    [ $most -gt 0 ] || { echo "$name: no time left" | tee -a "$out/parts.txt"; return; }
    echo "== $name" >> "$out/log.txt"
    timeout -k 5 "$most" "$@" >> "$out/log.txt" 2>&1
    echo "$name: exit $?, $((SECONDS - started)) of $most s, until $SECONDS s" | tee -a "$out/parts.txt"
}

# sb3_aarl is installed, from a copy, for its version belongs to each run.
site=$(mktemp -d) source=$(mktemp -d)
cp -r sb3_aarl search zoo_configs setup.cfg pyproject.toml MANIFEST.in README.md LICENSE "$source"
part install 60 "$python" -m pip install -q --no-index --no-deps --no-build-isolation --target "$site" "$source"
export PYTHONPATH="$site:$PWD/benchmarks:${PYTHONPATH:-}"
{ nvidia-smi -L || lscpu | grep "Model name"; git rev-parse HEAD; } >> "$out/parts.txt" 2> /dev/null
part needs 60 "$python" -c "
import mujoco, optuna, psycopg, pytest, rich, stable_baselines3, torch, sb3_aarl.search.cli.main
from sb3_aarl.envs import make_dmc_env
print('PyTorch', torch.__version__, 'CUDA', torch.cuda.is_available())
print('a picture:', make_dmc_env('dm_control/cheetah-run-v0', pixels=True).reset(seed=0)[0].mean())"

if [ "${2:-}" = --curves ]; then
    curves() {
        echo run,environment_steps,mean,std,episodes,seconds
        find "$runs" -name curve.csv | sort | while read -r file; do sed "1d;s|^|${file#"$runs"/},|" "$file"; done
    }
    part pixels 500 "$python" -m sb3_aarl.search.cli.main benchmark $variants \
        --envs cheetah-run --seeds $seeds --checkpoints $checkpoints --every $every --episodes $episodes \
        --workers 6 --folder "$runs" &
    while sleep 5 && kill -0 $! 2> /dev/null; do curves > "$out/pixels.csv"; done
    curves > "$out/pixels.csv"
    find "$runs" -name output.log | sort | xargs tail -n 3 >> "$out/log.txt"
    exit
fi

step=("$python" benchmarks/train_step.py --device $device --rounds $rounds --seconds $seconds $batch)
part eager 130 "${step[@]}" --settings $settings --out "$out/eager.json" \
    --rows fp32 bf16 "simba, fp32" "simba, bf16" "no auxiliary loss"
part tests 60 "$python" -m pytest -q -p no:cacheprovider tests/test_train_modes.py -k "gpu or cuda"
part at_once 120 "$python" benchmarks/throughput.py --device $device --settings small pixels --modes bf16 \
    --processes $processes --seconds $at_once --out "$out/at_once.json"
# The compiler keeps its results on disk (on a busy CPU a row took 147 s, then 19): all settings side by side, then each alone.
rows=("bf16, CUDA graphs" "fp32, CUDA graphs" "bf16, compiled" "fp32, compiled")
part compile 150 bash -c 'settings=$1; shift; for setting in $settings; do "$@" --settings $setting & done; wait' - \
    "$compiled" "${step[@]}" --rounds 1 --seconds 0 --rows "${rows[@]}"
for setting in $compiled; do
    part "compiled_$setting" 100 "${step[@]}" --settings "$setting" --out "$out/compiled_$setting.json" --rows "${rows[@]}"
done
