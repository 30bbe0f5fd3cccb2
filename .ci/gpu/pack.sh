#!/usr/bin/env bash
# Here, once, before a GPU machine is asked for: everything that its calls carry, about ten minutes of two cores. OpenGL's loaders into
# .gl (name it in .git/info/exclude), wheels into outputs/gpu, MuJoCo Warp and its kernels of $TASKS into outputs/warp_{a,b,c}.
set -euo pipefail
cd "$(dirname "$0")/../.."
mkdir -p .gl /tmp/amd64/partial
apt=(-oAPT::Architecture=amd64 -oAPT::Architectures=amd64 -oDir::State::Lists=/tmp/amd64)
apt-get "${apt[@]}" update -qq
(cd .gl && apt-get "${apt[@]}" download -qq libvulkan1 libegl1 libglvnd0 libopengl0 libgl1 libglx0 libgles2)
bash .ci/gpu/fetch.sh
pinned() { sed -nE "s/^($1==[^ ;]+).*/\1/p" requirements.lock | head -1; }
warp=$(pinned warp-lang) mjw=$(pinned mujoco-warp)
python3 -m pip install -q --no-deps --target /tmp/warpsite "${warp:-warp-lang}" "${mjw:-mujoco-warp}"
bash .ci/gpu/warp.sh /tmp/warpsite
du -sh .gl outputs/gpu outputs/warp_a outputs/warp_b outputs/warp_c
