#!/usr/bin/env bash
# Wheels of what the GPU machine lacks, for x86-64 and Python 3.12, at the versions of requirements.lock, into outputs/gpu/wheels.
set -euo pipefail
cd "$(dirname "$0")/../.."
names="mujoco mujoco-core glfw pyopengl gymnasium farama-notifications draccus mergedeep typing-inspect mypy-extensions toml daqp mink
peft qpsolvers shapely zstandard lz4 mcap mcap-ros2-support lerobot termcolor einops jsonlines transformers tokenizers datasets dill multiprocess
pytz rosbags ruamel-yaml"
mkdir -p outputs/gpu/wheels
wanted=()
for name in $names; do wanted+=("$(grep -i "^$name==" requirements.lock || echo "$name")"); done
platforms=(manylinux_2_28_x86_64 manylinux_2_27_x86_64 manylinux_2_17_x86_64 manylinux2014_x86_64 manylinux1_x86_64)
python3 -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 --implementation cp "${platforms[@]/#/--platform=}" \
  -d outputs/gpu/wheels "${wanted[@]}"
# What importlib.metadata must find, and the module by which LeRobot finds the policy.
mkdir -p outputs/gpu/stubs
cp .ci/gpu/stubs/sitecustomize.py outputs/gpu/stubs/
cp -r .venv/lib/python3.12/site-packages/lerobot_policy_taccorl* outputs/gpu/stubs/
for name in av rerun-sdk; do
  version=$(grep "^$name==" requirements.lock | cut -d= -f3)
  info=outputs/gpu/stubs/${name//-/_}-$version.dist-info
  mkdir -p "$info"
  printf 'Metadata-Version: 2.1\nName: %s\nVersion: %s\n' "$name" "$version" >"$info/METADATA"
done
du -sh outputs/gpu
