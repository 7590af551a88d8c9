#!/usr/bin/env bash
# Fetch what a machine with Python 3.12, PyTorch and h5py lacks to run benchmarks/gpu/run.sh, as wheels.
# Videos (PyAV) and the face detector (MediaPipe) are left out.
#
#   benchmarks/gpu/wheels.sh FOLDER
set -euo pipefail

folder=${1:?"usage: benchmarks/gpu/wheels.sh FOLDER"}
cd "$(dirname "$0")/../.."
packages=(
  mujoco glfw pyopengl                                                  # physics and images
  mink qpsolvers daqp                                                   # inverse kinematics
  gymnasium farama-notifications                                        # environments
  tyro docstring-parser typeguard                                       # options
  pydantic pydantic-core annotated-types typing-inspection              # documents
)
platforms=()
for platform in manylinux_2_28 manylinux_2_27 manylinux_2_17 manylinux2014 manylinux1; do
  platforms+=(--platform "${platform}_x86_64")
done
pinned=()
for package in "${packages[@]}"; do
  pinned+=("$(grep -m 1 "^${package}==" constraints.txt | cut -d " " -f 1)")
done
mkdir -p "$folder"
python3 -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 \
  --implementation cp "${platforms[@]}" --dest "$folder" "${pinned[@]}"
du -ch "$folder"/*.whl | tail -1
