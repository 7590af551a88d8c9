# A GPU machine for so many seconds: its packages, its clock and its sharing; sourced with BUDGET_S and OUT. Afterwards
# the working directory is the repository, `out` and `work` are absolute, and packages of WHEELS are installed.
set -uo pipefail

usage="usage: ${BASH_SOURCE[1]} BUDGET_S OUT"
budget=${1:?"$usage"} out=${2:?"$usage"}
work=${WORK:-/tmp/paper} device=${DEVICE:-cuda} size=${SIZE:-paper}
mkdir -p "$out" "$work"
out=$(cd "$out" && pwd) work=$(cd "$work" && pwd)
cd "$(dirname "$0")/../.."
export MUJOCO_GL=${MUJOCO_GL:-egl} PYTHONUNBUFFERED=1 PYTHONPATH="$work/site:$PWD"

left() { echo $((budget - SECONDS)); }

# Seconds that a training has to save its state when its time is over, so that the next call goes on there.
SAVING=40

# do_step NAME SHARE_S COMMAND...: run it, for its share of the time at most, and note how it ended.
do_step() {
  local name=$1 share=$2 start=$SECONDS code=0
  shift 2
  ((share > $(left))) && share=$(left)
  if ((share < 5)); then
    echo "$name: no time left" | tee -a "$out/times.txt"
    return 1
  fi
  timeout --signal=TERM --kill-after="$SAVING" "$share" "$@" >>"$out/log.txt" 2>&1 || code=$?
  echo "$name: $((SECONDS - start)) s, exit code $code" | tee -a "$out/times.txt"
  return "$code"
}

# Everything of a benchmark's folder that is small: tables, report, rows, curves, logs.
# Each process has a file of its own: the tar of one that was killed goes on writing.
pack() {
  local partial="$work/results.$BASHPID.partial"
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

# Programs that share the GPU run at once, not in turns, while NVIDIA's MPS does. It changes no setting.
mps() { [[ $device == cuda ]] && command -v nvidia-cuda-mps-control >/dev/null; }
share_gpu() {
  mps || return
  export CUDA_MPS_PIPE_DIRECTORY=$work/mps CUDA_MPS_LOG_DIRECTORY=$work/mps
  mkdir -p "$work/mps"
  nvidia-cuda-mps-control -d
  timeout --kill-after=1 30 python3 -c 'import torch; torch.ones(1, device="cuda").item()' && return
  echo "MPS does not work here: programs share the GPU in turns" | tee -a "$out/times.txt"
  end_sharing
}
end_sharing() {
  mps && [[ -n ${CUDA_MPS_PIPE_DIRECTORY:-} ]] && echo quit | nvidia-cuda-mps-control
  unset CUDA_MPS_PIPE_DIRECTORY CUDA_MPS_LOG_DIRECTORY
}
