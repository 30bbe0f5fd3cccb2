# Here: bash .ci/gpu/warp.sh SITE, a folder of `pip install --target SITE warp-lang mujoco-warp`: what three calls carry, into outputs/warp_*.
# There, each in a call of its own: `. .ci/gpu/start.sh` (carry .gl, outputs/gpu); `cp -r outputs/warp_a /dev/shm` (carry it); the
# same with warp_b; `bash .ci/gpu/warp.sh` (carry outputs/warp_c), which leaves WARP_CACHE_PATH and PYTHONPATH in warp_env.sh.
set -euo pipefail
if [ $# = 1 ]; then
  mkdir -p outputs/warp_{a,b,c,kernels}
  xz -3 -T0 -c "$1/warp/bin/warp.so" >outputs/warp_c/so
  split -n 2 -d outputs/warp_c/so outputs/warp_c/so.
  mv outputs/warp_c/so.00 outputs/warp_a/ && mv outputs/warp_c/so.01 outputs/warp_b/ && rm outputs/warp_c/so
  for task in ${TASKS:-assembly_1}; do PYTHONPATH=$1:. .venv/bin/python .ci/gpu/warp_kernels.py outputs/warp_kernels "$task"; done
  tar cJf outputs/warp_c/kernels.tar.xz -C outputs/warp_kernels --exclude='*.cu' --exclude='*.o' .
  tar cJf outputs/warp_c/rest.tar.xz -C "$1" --exclude='*.so' --exclude=__pycache__ warp mujoco_warp
  exit
fi
mkdir -p /dev/shm/warp_site /dev/shm/warp_kernels
tar xJf outputs/warp_c/rest.tar.xz -C /dev/shm/warp_site
tar xJf outputs/warp_c/kernels.tar.xz -C /dev/shm/warp_kernels
mkdir -p /dev/shm/warp_site/warp/bin
cat /dev/shm/warp_a/so.00 /dev/shm/warp_b/so.01 | xz -dc >/dev/shm/warp_site/warp/bin/warp.so
cat >/dev/shm/warp_env.sh <<'X'
. /dev/shm/env.sh
export PYTHONPATH=$PYTHONPATH:/dev/shm/warp_site WARP_CACHE_PATH=/dev/shm/warp_kernels
X
. /dev/shm/warp_env.sh
python3 -c "import warp; warp.init()"
touch /dev/shm/warp_ready
