# On a GPU machine of two GPUs, after start.sh and warp.sh, with the build to compare with in /dev/shm/old:
# setsid bash .ci/gpu/rl.sh SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# Two policies of $EPISODES demonstrations of $TASK learn on GPU 0; beside them, on GPU 1 and half of the cores, iterations of
# post-training by both builds are timed (settings in speed below). Then PPO of each policy on a GPU of its own by
# configs/post_train/gpu.yaml, until SECOND of the machine's clock, and scores of starts and results on the same scenes.
. /dev/shm/env.sh
end=$1 task=${TASK:-assembly_1} episodes=${EPISODES:-300} steps=${STEPS:-2500} scored=${SCORED:-192}
threads=$(env -u OMP_NUM_THREADS nproc) half=$((threads / 2))
seeds=(1000 2000)
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
on() { # GPU FIRST_CORE CORES command …
  CUDA_VISIBLE_DEVICES=$1 taskset -c "$2-$(($2 + $3 - 1))" "${@:4}"
}
learnt=(--task="$task" --episodes="$episodes" "--train_options=[--steps=$steps,--save_freq=500]" --scored="$scored" --out=/dev/shm/learn_1)
policy() { # SEED STEP: the folder of its weights, when they are there
  for found in /dev/shm/learn_1/"$task"/policy_*/checkpoints/"$2"/pretrained_model; do
    if [ -e "$found/model.safetensors" ] && grep -q "\"seed\": $1," "$found/train_config.json"; then echo "$found" && return; fi
  done
}
since start
python3 -c "import sys
from pipelines.learn import LearnConfig, datasets, parsed
print(len(list(datasets(parsed(LearnConfig, sys.argv[1:], 'learn')))))" "${learnt[@]}" --workers="$threads" >/dev/shm/made.log 2>&1
since "demonstrations: $?"
CUDA_VISIBLE_DEVICES=0,0 taskset -c 0-$((half - 1)) python3 -m pipelines.learn "${learnt[@]}" "--seeds=[$(IFS=, && echo "${seeds[*]}")]" \
  --score_device=cuda --workers=5 >/dev/shm/learn.log 2>&1 &
learning=$!

speed() { # BUILD NAME SECONDS OPTIONS: two iterations of PPO
  local out=/dev/shm/learn_speed/$2 path
  mkdir -p /dev/shm/learn_speed
  path=${PYTHONPATH//\/dev\/shm\/repo/\/dev\/shm\/$1}
  (cd "/dev/shm/$1" && PYTHONPATH=$path on 1 "$half" "$half" timeout "$3" python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml \
    --policy.path="$start" --env.task="$task" --env.twin="$twin" --anchor.weight=0 --noise_check=false --rerun=false --env.start_share=0 --ppo.critic_warmup=0 \
    --ppo.epochs=1 --iterations="${ITERATIONS:-2}" --save_freq=100 "${@:4}" --out="$out" >"$out.log" 2>&1)
  since "$2 timed: $?"
}
twin=/dev/shm/learn_1/$task/twin_of_20_steps.yaml
while [ ! -e /dev/shm/warp_ready ]; do sleep 1; done
. /dev/shm/warp_env.sh
while [ -z "$(policy 1000 000500)" ] && [ "$(now)" -lt "$end" ] && kill -0 $learning; do sleep 1; done
sleep 3 # until it is written
start=$(policy 1000 000500)
big=(--env.shards=1 --env.threads="$half" --ppo.batch_size=2048)
fast=(--policy.tf32=true --ppo.micro_batch=2048)
few=contacts=32,constraints=288
speed repo new_2048 150 "${big[@]}" --env.physics=warp --env.num_envs=2048 --env.decisions=36
ITERATIONS=1 speed old old_2048 260 "${big[@]}" --env.physics=warp --env.num_envs=2048 --env.decisions=36
speed repo new_2048_fast 120 "${big[@]}" "${fast[@]}" --env.physics=warp:iterations=8,$few --env.num_envs=2048 --env.decisions=36
speed repo new_8192_fast 150 "${big[@]}" "${fast[@]}" --env.physics=warp:iterations=8,$few --env.num_envs=8192 --env.decisions=12

improve() { # NUMBER SEED
  local out=/dev/shm/learn_ppo/$task/policy_$2 log
  log=$out.log
  mkdir -p "$(dirname "$out")"
  while [ -z "$(policy "$2" "$(printf %06d "$steps")")" ] && [ "$(now)" -lt "$end" ]; do sleep 1; done
  on "$1" $(($1 * half + 6)) $((half - 6)) timeout -s TERM $((end - $(now))) python3 -m taccorl.cli.main post-train --config_path=configs/post_train/gpu.yaml \
    --policy.path="$(policy "$2" "$(printf %06d "$steps")")" --env.task="$task" --env.twin="$twin" --env.threads=$((half - 6)) --rerun=false \
    --keep_checkpoints=1 --seed="$2" ${OPTIONS:-} --out="$out" >"$log" 2>&1
  since "$2 post-trained: $?"
  for physics in c warp; do
    local score=$out/score_$physics workers=(--workers=$half --batch_size=16)
    if [ $physics = warp ]; then workers=(); fi
    OMP_NUM_THREADS=1 on "$1" $(($1 * half)) "$half" python3 -m taccorl.cli.main evaluate --policy.path="$out/checkpoints/last/pretrained_model" \
      --policy.device=cuda --task="$task" --policy.n_action_steps=8 --episodes="$scored" --seed=70000 --failures=0 --physics=$physics "${workers[@]}" \
      --out="$score" >"$score.log" 2>&1
    since "$2 scored by $physics: $?"
  done
}
improve 0 1000 &
improve 1 2000 &
wait
touch "${DONE:-/dev/shm/done}"
