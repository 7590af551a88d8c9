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
source "$(dirname "$0")/machine.sh"
steps=${STEPS:-tests speed paper} conditions=${CONDITIONS:-baseline current current_pred_h2}

timing=(python3 benchmarks/act_step.py --device "$device" --threads 4 --no_public --steps 30)
[[ $size == tiny ]] && timing+=(--image_size 48 64 --batch_size 1 --steps 1)
[[ $device == cpu ]] && timing+=(--precision fp32)
graph=() && [[ $device == cuda ]] && graph=(--cuda_graph)

if [[ $steps == *tests* ]]; then
  do_step tests 90 python3 -m pytest -m cuda -n 4 --dist loadfile -p no:cacheprovider \
    -W default tests/policy tests/training
  code=$?
  grep -E "^(FAILED|ERROR|E  )|passed|failed|skipped" "$out/log.txt" | tail -20
  ((code == 0)) || exit 1
fi

if [[ $steps == *speed* ]]; then
  do_step "bf16" 40 "${timing[@]}" --predictions 50
  [[ $device == cuda ]] && do_step "bf16, CUDA graph" 60 "${timing[@]}" --cuda_graph --profile --predictions 50
  [[ $size == tiny ]] || do_step "fp32, CUDA graph" 60 "${timing[@]}" --precision fp32 "${graph[@]}"
  [[ $size == tiny ]] || do_step "bf16, compiled, CUDA graph" 240 "${timing[@]}" --compile "${graph[@]}"
  sed -n '/, torch /,$p' "$out/log.txt"
fi

if [[ $steps == *paper* ]]; then
  share_gpu
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
  do_step paper "$(($(left) - SAVING - 5))" "${command[@]}"
  kill $monitor $packer 2>/dev/null
  pack
  rm --force "$work/results.$packer.partial"
  end_sharing
  tail -25 "$out/log.txt"
fi
cat "$out/times.txt"
