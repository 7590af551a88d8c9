#!/usr/bin/env bash
# The paper's study on one GPU, within so many seconds: tests, time of a step, demonstrations with three
# cameras, trainings side by side, evaluations. Results lie in OUT, small enough to carry away; the
# demonstrations and checkpoints stay in WORK. The same call continues where an earlier one was stopped.
#
#   benchmarks/gpu/run.sh BUDGET_S OUT
#
# Environment variables (defaults):
#   STEPS       which of "tests speed paper" to do, in this order (all)
#   CONDITIONS  of the paper's study (as many of "baseline current_pred_h2 current" as there is time
#               for, by the time of a step that is measured first)
#   WORK        folder of everything else (/tmp/paper)
#   WHEELS      folder of wheels to install first; see wheels.sh (none)
#   SIZE        "paper", or "tiny" for a try of a minute (paper)
#   DEVICE      cuda or cpu (cuda)
source "$(dirname "$0")/machine.sh"
steps=${STEPS:-tests speed paper} conditions=${CONDITIONS:-}

timing=(python3 benchmarks/act_step.py --device "$device" --threads 4 --no_public)
[[ $size == tiny ]] && timing+=(--image_size 48 64 --batch_size 1 --steps 1)
[[ $device == cpu ]] && timing+=(--precision fp32)
graph=() && [[ $device == cuda ]] && graph=(--cuda_graph)

# ms of a training step of each where three are trained at once; nothing if that fails.
time_together() {
  local steps=150 number
  [[ $size == tiny ]] && steps=1
  for number in 1 2 3; do
    timeout --kill-after=1 60 "${timing[@]}" --steps "$steps" --predictions 0 "${graph[@]}" \
      >"$work/together-$number.txt" 2>&1 &
  done
  wait
  cat "$work"/together-*.txt >>"$out/log.txt"
  awk -F '|' '/^\| ours/ { sum += $(NF - 1); found++ } END { if (found == 3) printf "%.1f", sum / 3 }' \
    "$work"/together-*.txt
}

if [[ $steps == *tests* ]]; then
  do_step tests 90 python3 -m pytest -m cuda -p no:cacheprovider \
    -W default ${TESTS:-tests/policy tests/training}
  code=$?
  grep -E "^(FAILED|ERROR|E  )|passed|failed|skipped" "$out/log.txt" | tail -20
  ((code == 0)) || exit 1
fi

if [[ $steps == *speed* ]]; then
  do_step "bf16" 40 "${timing[@]}" --predictions 50
  [[ $device == cuda ]] && do_step "bf16, CUDA graph" 60 "${timing[@]}" --cuda_graph --profile --predictions 50
  [[ $size == tiny ]] || do_step "fp32, CUDA graph" 60 "${timing[@]}" --precision fp32 "${graph[@]}"
  sed -n '/, torch /,$p' "$out/log.txt"
fi

# Seconds for what is beside training: demonstrations, their images, the end; and for each evaluation.
beside=105 evaluation=25

if [[ $steps == *paper* ]]; then
  share_gpu
  if [[ -z $conditions ]]; then
    together=$(time_together)
    echo "three trainings at once: ${together:-failed} ms a step of each" | tee -a "$out/times.txt"
    # So many, one at least, as 12 500 steps of each leave time for.
    number=$(awk -v ms="${together:-60}" -v left=$(($(left) - beside)) -v each=$evaluation 'BEGIN {
      n = int(left / (12.5 * ms / 3 + each)); print n < 1 ? 1 : n }')
    conditions=$(printf '%s\n' baseline current_pred_h2 current | head -n "$number" | tr '\n' ' ')
  fi
  echo "conditions: $conditions" | tee -a "$out/times.txt"
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
  do_step paper "$(($(left) - 10))" "${command[@]}"
  kill $monitor $packer 2>/dev/null
  pack
  end_sharing
  tail -25 "$out/log.txt"
fi
cat "$out/times.txt"
