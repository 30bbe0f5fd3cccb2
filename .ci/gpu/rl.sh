# On a GPU machine, after start.sh and warp.sh: setsid bash .ci/gpu/rl.sh SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# A policy of $EPISODES demonstrations of $TASK learns; meanwhile modes.py compares the modes of MuJoCo Warp (of $MODES_TASK). It is post-trained by
# configs/post_train/gpu.yaml and $OPTIONS until SECOND of the machine's clock (by MuJoCo C, 128 environments, if the modes differ);
# with $ARMS, a line "NAME OPTIONS" each, so many times side by side. Beside it, replayed.py compares what the policy does in $REPLAYED
# scenes (none: 0) by MuJoCo C and by Warp, and the start is scored by either. Then the results are scored, and, with a build to compare with in /dev/shm/old, an iteration of either build is timed. One GPU, all cores.
. /dev/shm/env.sh
end=$1 task=${TASK:-assembly_1} episodes=${EPISODES:-300} steps=${STEPS:-1500} scored=${SCORED:-192} seed=${SEED:-1000}
threads=$(env -u OMP_NUM_THREADS nproc)
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
trap 'touch ${DONE:-/dev/shm/done}' EXIT
mkdir -p /dev/shm/learn_speed
since start
modes() {
  while [ ! -e /dev/shm/warp_ready ]; do sleep 1; done
  . /dev/shm/warp_env.sh
  timeout 240 python3 .ci/gpu/modes.py cuda:0 64 12 "${MODES_TASK:-$task}" >/dev/shm/modes.log 2>&1
  echo $? >/dev/shm/modes_rc
  since "modes compared: $(cat /dev/shm/modes_rc)"
}
modes &
python3 -m pipelines.learn --task="$task" --episodes="$episodes" "--train_options=[--steps=$steps,--save_freq=$steps]" --seeds="[$seed]" --scored=2 \
  --score_device=cuda --workers="$threads" --out=/dev/shm/learn_1 >/dev/shm/learn.log 2>&1
since "learnt: $?"
wait
start=$(ls -d /dev/shm/learn_1/"$task"/policy_*/checkpoints/last/pretrained_model)
twin=/dev/shm/learn_1/$task/twin_of_20_steps.yaml
. /dev/shm/warp_env.sh
out=/dev/shm/learn_ppo/$task/policy_$seed
mkdir -p "$(dirname "$out")"
score() { # NAME POLICY OPTIONS
  OMP_NUM_THREADS=1 timeout 400 python3 -m taccorl.cli.main evaluate --policy.path="$2" --policy.device=cuda --task="$task" --policy.n_action_steps=8 \
    --episodes="$scored" --seed=70000 --failures=0 "${@:3}" --out="${out}_score_$1" >"${out}_score_$1.log" 2>&1
  since "$1 scored: $?"
}
(
  if [ "${REPLAYED:-24}" -gt 0 ]; then
    python3 .ci/gpu/replayed.py "$start" cuda:0 "${REPLAYED:-24}" 24 "$task" >/dev/shm/replayed.log 2>&1
    since "replayed: $?"
  fi
  score start_c "$start" --workers="$((threads - 4))" --batch_size="$((threads - 4))"
  score start_warp "$start" --physics=warp:mode=resident --batch_size="$scored"
) &
scores=$!
options=()
if [ "$(cat /dev/shm/modes_rc)" != 0 ]; then options=(--env.physics=c --env.num_envs=128 --ppo.batch_size=512); fi
arms=() runs=()
while IFS= read -r arm; do
  if [ -n "$arm" ]; then arms+=("$arm"); fi
done <<<"${ARMS:-ppo ${OPTIONS:-}}"
for arm in "${arms[@]}"; do
  read -ra words <<<"$arm"
  run=${out}_${words[0]}
  timeout -s TERM $((end > $(now) ? end - $(now) : 1)) python3 -m taccorl.cli.main post-train --config_path=configs/post_train/gpu.yaml --policy.path="$start" \
    --env.task="$task" --env.twin="$twin" --env.threads=4 --rerun=false --keep_checkpoints=1 --save_freq=5 --seed="$seed" "${options[@]}" "${words[@]:1}" \
    --out="$run" >"$run.log" 2>&1 &
  runs+=($!)
done
wait "${runs[@]}"
since "post-trained: $?"
wait $scores
result() { echo "${out}_${1%% *}/checkpoints/last/pretrained_model"; }
for arm in "${arms[@]}"; do
  score "${arm%% *}_warp" "$(result "$arm")" --physics=warp:mode=resident --batch_size="$scored" &
done
for arm in "${arms[@]}"; do
  score "${arm%% *}_c" "$(result "$arm")" --workers="$((threads - 2))" --batch_size="$((threads - 2))"
done
wait
if [ ! -e /dev/shm/old ]; then exit; fi

speed() { # BUILD NAME SECONDS OPTIONS: an iteration of PPO
  local out=/dev/shm/learn_speed/$2 path=/dev/shm/$1:$PYTHONPATH
  (cd "/dev/shm/$1" && PYTHONPATH=$path timeout "$3" python3 ${profile:+-m cProfile -o "$out.prof"} -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml \
    --policy.path="$start" --env.task="$task" --env.twin="$twin" --anchor.weight=0 --noise_check=false --rerun=false --env.start_share=0 --ppo.critic_warmup=0 \
    --ppo.epochs=1 --ppo.batch_size=2048 --save_freq=100 "${@:4}" --out="$out" >"$out.log" 2>&1)
  since "$2 timed: $?"
}
one=(--env.shards=1 --env.threads="$threads")
speed old old_2048 230 "${one[@]}" --env.physics=warp --env.num_envs=2048 --env.decisions=36 --iterations=1
speed repo new_8192_fast 150 "${one[@]}" --env.physics=warp:mode=resident,iterations=8,contacts=32,constraints=288 --env.num_envs=8192 --env.decisions=12 \
  --policy.tf32=true --ppo.micro_batch=2048 --iterations=1
profile=yes speed repo compiled_8192 170 "${one[@]}" --env.physics=warp:mode=resident,iterations=8,contacts=32,constraints=288 --env.num_envs=8192 --env.decisions=12 \
  --policy.tf32=true --policy.compile=true --ppo.micro_batch=2048 --iterations=2
for build in old repo; do
  speed $build c_of_$build 80 --env.physics=c --env.num_envs=128 --env.decisions=36 --env.shards="$threads" --env.threads=1 --iterations=1
done
