#!/usr/bin/env bash
# The paper's study on one GPU, within so many seconds: tests, time of a step, demonstrations with three
# cameras, trainings side by side, evaluations. Results lie in OUT, small enough to carry away; the
# demonstrations and checkpoints stay in WORK. The same call continues where an earlier one was stopped.
#
#   benchmarks/gpu/run.sh BUDGET_S OUT
#
# Environment variables (defaults):
#   STEPS       which of "tests speed paper" to do, in this order (all)
#   CONDITIONS  of the paper's study ("baseline current current_pred_h2")
#   WORK        folder of everything else (/tmp/paper)
#   WHEELS      folder of wheels to install first; see wheels.sh (none)
#   SIZE        "paper", or "tiny" for a try of a minute (paper)
#   DEVICE      cuda or cpu (cuda)
set -uo pipefail

budget=${1:?"usage: benchmarks/gpu/run.sh BUDGET_S OUT"} out=${2:?"usage: benchmarks/gpu/run.sh BUDGET_S OUT"}
steps=${STEPS:-tests speed paper} conditions=${CONDITIONS:-baseline current current_pred_h2}
work=${WORK:-/tmp/paper} device=${DEVICE:-cuda} size=${SIZE:-paper}
mkdir -p "$out" "$work"
out=$(cd "$out" && pwd) work=$(cd "$work" && pwd)
cd "$(dirname "$0")/../.."
export MUJOCO_GL=${MUJOCO_GL:-egl} PYTHONUNBUFFERED=1 PYTHONPATH="$work/site:$PWD"

left() { echo $((budget - SECONDS)); }

# do_step NAME SHARE_S COMMAND...: run it, for its share of the time at most, and note how it ended.
do_step() {
  local name=$1 share=$2 start=$SECONDS code=0
  shift 2
  ((share > $(left))) && share=$(left)
  if ((share < 5)); then
    echo "$name: no time left" | tee -a "$out/times.txt"
    return 1
  fi
  timeout --signal=TERM --kill-after=30 "$share" "$@" >>"$out/log.txt" 2>&1 || code=$?
  echo "$name: $((SECONDS - start)) s, exit code $code" | tee -a "$out/times.txt"
  return "$code"
}

# Everything of a benchmark's folder that is small: tables, report, rows, curves, logs.
pack() {
  local partial="$work/results.partial"
  tar --create --gzip --file "$partial" --directory "$work" --exclude '*.safetensors' --exclude '*.hdf5' \
    --exclude '*.partial' --exclude tensorboard results 2>/dev/null && mv "$partial" "$out/results.tar.gz"
}

if [[ -n ${WHEELS:-} && ! -d $work/site ]]; then
  do_step wheels 90 python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir \
    --target "$work/site" "$WHEELS"/*.whl || exit 1
fi
[[ -d robo_manip_baselines.egg-info ]] || python3 setup.py --quiet egg_info >>"$out/log.txt" 2>&1

{
  date --utc
  nproc
  nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv,noheader 2>/dev/null
  python3 -c 'import sys, torch, mujoco, numpy; print(sys.version, torch.__version__, torch.version.cuda,
mujoco.__version__, numpy.__version__, sep="\n")'
  git rev-parse HEAD 2>/dev/null
} >"$out/versions.txt" 2>&1
cat "$out/versions.txt"

if [[ $steps == *tests* ]]; then
  do_step tests 90 python3 -m pytest -m cuda -n 4 --dist loadfile -p no:cacheprovider \
    -W default tests/policy tests/training
  grep -E "^(FAILED|ERROR|E  )|passed|failed|skipped" "$out/log.txt" | tail -20
fi

if [[ $steps == *speed* ]]; then
  timing=(python3 benchmarks/act_step.py --device "$device" --threads 4 --steps 30 --predictions 50 --no_public)
  [[ $size == tiny ]] && timing+=(--image_size 48 64 --batch_size 1 --steps 1 --predictions 1)
  [[ $device == cpu ]] && timing+=(--precision fp32)
  graph=() && [[ $device == cuda ]] && graph=(--cuda_graph)
  do_step "bf16" 40 "${timing[@]}"
  [[ $device == cuda ]] && do_step "bf16, CUDA graph" 40 "${timing[@]}" --cuda_graph --profile
  [[ $size == tiny ]] || do_step "fp32, CUDA graph" 40 "${timing[@]}" --precision fp32 "${graph[@]}"
  [[ $size == tiny ]] || do_step "bf16, compiled, CUDA graph" 100 "${timing[@]}" --compile "${graph[@]}"
  sed -n '/, torch /,$p' "$out/log.txt"
fi

if [[ $steps == *paper* ]]; then
  command=(python3 bin/Benchmark.py feeding --preset paper --device "$device" --conditions $conditions
    --num_workers "$(nproc)" --no_videos --out "$work/results/feeding_$size")
  if [[ $size == tiny ]]; then
    command+=(--demonstrations 3 --num_episodes 2
      --train_settings steps=30 checkpoint_every=20 log_every=10)
    [[ $device == cpu ]] && command+=(image_size=48x64 hidden_size=32 feedforward_size=32)
  fi
  nvidia-smi --query-gpu=timestamp,utilization.gpu,memory.used --format=csv,noheader -l 2 \
    >>"$out/gpu.csv" 2>/dev/null &
  monitor=$!
  (while sleep 45; do pack; done) &
  packer=$!
  do_step paper "$(($(left) - 15))" "${command[@]}"
  kill $monitor $packer 2>/dev/null
  pack
  tail -25 "$out/log.txt"
fi
cat "$out/times.txt"
