# Sourced on the GPU machine, in the root of the tree, with outputs/gpu and .gl (Debian's loaders of OpenGL) carried.
date +%s >/dev/shm/t0
for package in .gl/*.deb; do dpkg -x "$package" /; done
ldconfig
mkdir -p /dev/shm/site /dev/shm/repo
python3 -m pip install -q --no-deps --no-index --target /dev/shm/site outputs/gpu/wheels/*.whl 2>&1 | grep -v WARN
# Codecs are asked for when LeRobot's settings are read, though no video is written.
sed -i 's/if self.detect_available_encoders(self.vcodec):/if True:/; s/^        if self.video_backend == "pyav":$/        if False:/' \
  /dev/shm/site/lerobot/configs/video.py
cp -r .ci taccorl pipelines configs data_specs docs pyproject.toml outputs /dev/shm/repo/
cat >/dev/shm/env.sh <<'X'
cd /dev/shm/repo
export PYTHONPATH=/dev/shm/repo/outputs/gpu/stubs:/dev/shm/site:/dev/shm/repo HF_HUB_OFFLINE=1 MUJOCO_GL=egl PYTHONDONTWRITEBYTECODE=
export PYTHONUNBUFFERED=1 NUMBA_CACHE_DIR=/dev/shm/numba TOKENIZERS_PARALLELISM=false OMP_NUM_THREADS=4
vendor=/usr/local/nvidia/share/glvnd/egl_vendor.d/10_nvidia.json
if [ -e $vendor ]; then export __EGL_VENDOR_LIBRARY_FILENAMES=$vendor; fi
X
. /dev/shm/env.sh
modules=(lerobot.scripts.lerobot_train taccorl.lerobot_plugin taccorl.cli.{collect,evaluate,correct,surrogate,diagnose,post_train} pipelines.{learn,diagnosis_study})
for module in "${modules[@]}"; do python3 -c "import $module" || echo "$module cannot be imported"; done
nvidia-smi -L
