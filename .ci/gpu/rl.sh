# On a GPU machine, after start.sh, with the build to compare with in /dev/shm/old:
# setsid bash .ci/gpu/rl.sh SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# A policy of $EPISODES demonstrations of $TASK learns; then, when warp.sh has run, an iteration of post-training by each build is
# timed (settings below); then PPO of the policy by .ci/gpu/post_train.yaml, until SECOND of the machine's clock; then its start
# and its result are scored on the same scenes. One GPU, all cores, one thing after the other.
. /dev/shm/env.sh
end=$1 task=${TASK:-assembly_1} episodes=${EPISODES:-300} steps=${STEPS:-2500} scored=${SCORED:-192} seed=${SEED:-1000}
threads=$(env -u OMP_NUM_THREADS nproc)
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
trap 'touch ${DONE:-/dev/shm/done}' EXIT
since start
python3 -m pipelines.learn --task="$task" --episodes="$episodes" "--train_options=[--steps=$steps,--save_freq=$steps]" --seeds="[$seed]" --scored=2 \
  --score_device=cuda --workers="$threads" --out=/dev/shm/learn_1 >/dev/shm/learn.log 2>&1
since "learnt: $?"
start=$(ls -d /dev/shm/learn_1/"$task"/policy_*/checkpoints/last/pretrained_model)
twin=/dev/shm/learn_1/$task/twin_of_20_steps.yaml
while [ ! -e /dev/shm/warp_ready ] && [ "$(now)" -lt "$end" ]; do sleep 1; done
. /dev/shm/warp_env.sh

speed() { # BUILD NAME SECONDS OPTIONS: an iteration of PPO
  local out=/dev/shm/learn_speed/$2 path=/dev/shm/$1:$PYTHONPATH
  mkdir -p /dev/shm/learn_speed
  (cd "/dev/shm/$1" && PYTHONPATH=$path timeout "$3" python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml \
    --policy.path="$start" --env.task="$task" --env.twin="$twin" --anchor.weight=0 --noise_check=false --rerun=false --env.start_share=0 --ppo.critic_warmup=0 \
    --ppo.epochs=1 --ppo.batch_size=2048 --env.shards=1 --env.threads="$threads" --iterations=1 --save_freq=100 "${@:4}" --out="$out" >"$out.log" 2>&1)
  since "$2 timed: $?"
}
speed repo new_2048 150 --env.physics=warp:mode=resident --env.num_envs=2048 --env.decisions=36
speed old old_2048 260 --env.physics=warp --env.num_envs=2048 --env.decisions=36
speed repo new_8192_fast 150 --env.physics=warp:mode=resident,iterations=8,contacts=32,constraints=288 --env.num_envs=8192 --env.decisions=12 \
  --policy.tf32=true --ppo.micro_batch=2048
out=/dev/shm/learn_ppo/$task/policy_$seed
mkdir -p "$(dirname "$out")"
timeout -s TERM $((end > $(now) ? end - $(now) : 1)) python3 -m taccorl.cli.main post-train --config_path=.ci/gpu/post_train.yaml --policy.path="$start" --env.task="$task" \
  --env.twin="$twin" --env.threads="$threads" --rerun=false --keep_checkpoints=1 --save_freq=2 --seed="$seed" ${OPTIONS:-} --out="$out" >"$out.log" 2>&1
since "post-trained: $?"
score() { # NAME POLICY OPTIONS
  local score=$out/score_$1
  OMP_NUM_THREADS=1 python3 -m taccorl.cli.main evaluate --policy.path="$2" --policy.device=cuda --task="$task" --policy.n_action_steps=8 \
    --episodes="$scored" --seed=70000 --failures=0 "${@:3}" --out="$score" >"$score.log" 2>&1
  since "$1 scored: $?"
}
by_c=(--workers="$threads" --batch_size=12)
score result_c "$out/checkpoints/last/pretrained_model" "${by_c[@]}"
score start_c "$start" "${by_c[@]}"
score result_warp "$out/checkpoints/last/pretrained_model" --physics=warp:mode=resident
