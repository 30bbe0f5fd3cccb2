# On a GPU machine, after start.sh, with a carried policy's files in /dev/shm/start (next.sh brings them) and a build to compare with in
# /dev/shm/old (git archive COMMIT taccorl pipelines configs data_specs): bash .ci/gpu/by_c.sh [PAIRS [DEVICE [ENVS [DECISIONS]]]]
# Two iterations of PPO by MuJoCo C, ENVS × DECISIONS, by either build in turn; a line of progress.jsonl each.
. /dev/shm/env.sh
pairs=${1:-2} device=${2:-cuda} envs=${3:-128} decisions=${4:-36} task=${TASK:-puzzle}
threads=$(env -u OMP_NUM_THREADS nproc)
start=$(python3 .ci/gpu/carried.py)
python3 -c "
from dataclasses import replace
from pathlib import Path
from taccorl.sim.twin_file import TwinConfig, save_twin
nominal = TwinConfig()
save_twin(replace(nominal, physics=replace(nominal.physics, steps_per_control_step=20)), Path('/dev/shm/twin_of_20_steps.yaml'))"
for pair in $(seq "$pairs"); do
  for build in old repo; do
    out=/dev/shm/by_c/${build}_$pair
    mkdir -p /dev/shm/by_c
    cd "/dev/shm/$build" || exit 1
    PYTHONPATH=/dev/shm/$build:$PYTHONPATH timeout 110 python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml \
      --policy.path="$start" --policy.device="$device" --env.task="$task" --env.twin=/dev/shm/twin_of_20_steps.yaml --anchor.weight=0 --noise_check=false \
      --rerun=false --env.start_share=0 --ppo.critic_warmup=0 --ppo.epochs=1 --ppo.batch_size=512 --save_freq=100 --env.physics=c --env.num_envs="$envs" \
      --env.decisions="$decisions" --env.shards="$threads" --env.threads=1 --iterations=2 --out="$out" >"$out.log" 2>&1
    echo "$build $?"
    cat "$out/progress.jsonl"
  done
done
