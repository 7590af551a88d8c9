#!/usr/bin/env bash
# The paper's three approaches and `residual` on one GPU, within so many seconds: both splits side by side, as
# many steps of each as there is time for. Results lie in OUT, small enough to carry away. The same call continues
# where an earlier one was stopped.
#
#   benchmarks/gpu/faces.sh BUDGET_S OUT
#
# Environment variables (defaults):
#   DATASET     folder made by build-dataset (face_dataset); --stride and --quality make one small enough to
#               carry
#   APPROACHES  of benchmarks/approaches.py ("image_only simple_fusion cross_attention residual")
#   WORK        folder of everything else (/tmp/paper)
#   WHEELS      folder of wheels to install first; see wheels.sh (none)
#   SIZE        "paper", or "tiny" for a try of some minutes (paper)
#   DEVICE      cuda or cpu (cuda)
source "$(dirname "$0")/machine.sh"
read -ra approaches <<<"${APPROACHES:-image_only simple_fusion cross_attention residual}"

# Steps by which a step is timed, and seconds for the evaluations and for starting again.
first=60 beside=90
command=(python3 benchmarks/approaches.py --dataset "${DATASET:-face_dataset}" --approaches "${approaches[@]}"
  --seeds 0 --preset paper --batch_size 16 --learning_rates 1e-4 --validate_every 250 --memory_gb 24
  --out "$work/results/approaches" --resamples 500)
[[ $size == tiny ]] && first=2 && command+=(--preset cpu --batch_size 2 --validate_every 2 --resamples 20)

# train STEPS: of each approach under both splits; a larger number extends what is there, and what was begun with
# more steps goes on to those.
train() {
  local split
  for split in sequence person; do
    do_step "$split, $1 steps" "$(($(left) - SAVING - 5))" "${command[@]}" --splits "$split" --steps "$1" &
  done
  wait $(jobs -p)
}

share_gpu
train "$first"
# Steps for which there is time: one of each approach takes as long as its last ones did.
number=$(python3 - "$work/results/approaches/runs" "$(($(left) - beside))" <<'PYTHON'
import json, pathlib, sys

seconds = {"sequence": 0.0, "person": 0.0}
for path in pathlib.Path(sys.argv[1]).glob("*/metrics.jsonl"):
    lines = [json.loads(line) for line in path.open() if '"train"' in line]
    timed = [line for line in lines if "seconds" in line]
    if timed:
        split = "person" if "_person_" in path.parent.name else "sequence"
        seconds[split] += timed[-1]["seconds"] / timed[-1]["step"]
longest = max(seconds.values())
print(int(float(sys.argv[2]) / longest) if longest else 0)
PYTHON
)
[[ $size == tiny ]] && number=4
echo "steps of each training: $number" | tee -a "$out/times.txt"
((number > first)) && train "$number"
pack
end_sharing
cp "$work/results/approaches/approaches.md" "$out/" 2>/dev/null
cat "$out/times.txt"
