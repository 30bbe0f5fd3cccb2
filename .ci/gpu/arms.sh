# PPO of one carried policy by several settings at once, on each GPU as many as fit. After start.sh and warp.sh, with the parts of its
# model.safetensors (bfloat16, zstd) and the archive of its other files, as next.sh brings them, in /dev/shm/start:
# setsid bash .ci/gpu/arms.sh SECOND "NAME OPTIONS" "NAME OPTIONS" … > /dev/shm/job.log 2>&1 < /dev/null &
# Each NAME is post-trained by configs/post_train/gpu.yaml and its OPTIONS until SECOND of the machine's clock; then start and results are
# scored on the same $SCORED scenes by MuJoCo C, and the first result in the resident mode, too.
. /dev/shm/env.sh
end=$1 task=${TASK:-assembly_1} scored=${SCORED:-256} seed=${SEED:-1000} first_scene=${FIRST_SCENE:-70000}
shift
threads=$(env -u OMP_NUM_THREADS nproc) gpus=$(nvidia-smi -L | wc -l)
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
trap 'touch ${DONE:-/dev/shm/done}' EXIT
since start
start=$(python3 .ci/gpu/carried.py)
twin=/dev/shm/twin_of_20_steps.yaml
python3 - "$twin" <<'P'
import sys
from dataclasses import replace
from pathlib import Path

from taccorl.sim.twin_file import TwinConfig, save_twin

nominal = TwinConfig()
physics = replace(nominal.physics, steps_per_control_step=20)
save_twin(replace(nominal, physics=physics), Path(sys.argv[1]))
P
since "policy: $start"
folder=/dev/shm/learn_ppo/$task
mkdir -p "$folder"
while [ ! -e /dev/shm/warp_ready ] && [ "$(now)" -lt 300 ]; do sleep 1; done
. /dev/shm/warp_env.sh
k=0
for arm in "$@"; do
  read -ra words <<<"$arm"
  out=$folder/policy_${words[0]}
  CUDA_VISIBLE_DEVICES=$((k % gpus)) timeout -s TERM $((end - $(now))) python3 -m taccorl.cli.main post-train --config_path=configs/post_train/gpu.yaml \
    --policy.path="$start" --env.task="$task" --env.twin="$twin" --env.threads=4 --rerun=false --keep_checkpoints=1 --seed="$seed" \
    "${words[@]:1}" --out="$out" >"$out.log" 2>&1 &
  k=$((k + 1))
done
wait
since "post-trained"
score() { # NAME OF OPTIONS
  local out=$folder/policy_$2_score_$1 policy=$start
  if [ "$2" != start ]; then policy=$folder/policy_$2/checkpoints/last/pretrained_model; fi
  OMP_NUM_THREADS=1 timeout 400 python3 -m taccorl.cli.main evaluate --policy.path="$policy" --policy.device=cuda --task="$task" \
    --policy.n_action_steps=8 --episodes="$scored" --seed="$first_scene" --failures=0 "${@:3}" --out="$out" >"$out.log" 2>&1
  since "$2 scored by $1: $?"
}
read -r best _ <<<"$1"
score resident "$best" --physics=warp:mode=resident --batch_size="$scored" &
resident=$!
for arm in "$@" start; do
  read -r name _ <<<"$arm"
  score c "$name" --workers="$((threads - 2))" --batch_size=14
done
wait $resident
