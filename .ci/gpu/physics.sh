# On the GPU machine, two GPUs, after start.sh and warp.sh: setsid bash .ci/gpu/physics.sh SECOND [PART …] > /dev/shm/job.log 2>&1 < /dev/null &
# MuJoCo Warp against MuJoCo C: GPU 0 with the first half of the threads is C's, GPU 1 with the others Warp's. Parts, until SECOND of the
# machine's clock, all if none is given: adapters, of the full size on both GPUs; bench, control steps and pictures; scores, 512 scenes by
# both of each policy /dev/shm/policies/TASK of $TASKS; ppo of the policy of the first, from it.
# Results go to $RESULTS, /dev/shm/learn_physics if not given.
# Before it, with the parts of a policy that next.sh brought in FOLDER: bash .ci/gpu/physics.sh unpack TASK FOLDER.
if [ "$1" = unpack ]; then
  to=${POLICIES:-/dev/shm/policies}/$2
  mkdir -p "$to"
  tar xzf "$3"/learn*.tgz -C "$to" --strip-components=6
  cat "$3"/policy_* | PYTHONPATH=/dev/shm/site python3 -c "import sys, zstandard; zstandard.ZstdDecompressor().copy_stream(sys.stdin.buffer, sys.stdout.buffer)" >"$to/model.safetensors"
  exit
fi
if [ -e /dev/shm/warp_env.sh ]; then . /dev/shm/warp_env.sh; else . /dev/shm/env.sh; fi
export OMP_NUM_THREADS=4
tasks=(${TASKS:-assembly_1}) policies=${POLICIES:-/dev/shm/policies} out=${RESULTS:-/dev/shm/learn_physics}
end=$1 half=${HALF:-$(($(env -u OMP_NUM_THREADS nproc) / 2))} parts=${*:2}
parts=${parts:-adapters bench scores ppo}
mkdir -p $out
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
on() { # GPU command …
  local gpu=$1 && shift
  CUDA_VISIBLE_DEVICES=$gpu taskset -c $((gpu * half))-$((gpu * half + half - 1)) timeout -s TERM $((end > $(now) ? end - $(now) : 1)) "$@"
}
score() { # GPU TASK NAME OPTIONS
  on "$1" python3 -m taccorl.cli.main evaluate --policy.path="$policies/$2" --policy.device=cuda --task="$2" --policy.n_action_steps=8 \
    --episodes="${SCORED:-512}" --seed=70000 --failures=0 "${@:4}" --out="$out/score_$2_$3" >"$out/score_$2_$3.log" 2>&1
  since "$2 scored by $3: $?"
}
post_train() { # GPU NAME OPTIONS, with the physics steps of pipelines.learn's demonstrations
  printf 'physics:\n  steps_per_control_step: 20\n' >"$out/twin.yaml"
  on "$1" python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml --policy.path="$policies/${tasks[0]}" \
    --env.task="${tasks[0]}" --env.twin="$out/twin.yaml" --anchor.weight=0 --noise_check=false --rerun=false --save_freq=1 --keep_checkpoints=1 "${@:3}" \
    --out="$out/$2" >"$out/score_$2.log" 2>&1
  since "$2 ended: $?"
  cp "$out/$2/progress.jsonl" "$out/score_$2.jsonl"
}
bench() { # NAME SECONDS
  timeout "$2" ${cores:-} python3 -m pipelines.benchmarks --only="$1" >"$out/score_$1.log" 2>&1
  since "$1: $?"
  cp bench.json "$out/score_bench.json"
}
for part in $parts; do
  since "$part begins"
  case $part in
  adapters) bench full_adapters "${ADAPTERS_S:-200}" ;;
  bench) cores="taskset -c $half-$((2 * half - 1))" CUDA_VISIBLE_DEVICES=1 bench physics_on_gpu 130 ;;
  scores)
    for task in "${tasks[@]}"; do
      (OMP_NUM_THREADS=1 score 0 "$task" c --workers="$half" --batch_size=32) &
      score 1 "$task" warp --physics=warp
      wait
    done
    ;;
  ppo)
    post_train 0 c --env.shards="$half" --ppo.critic_warmup=2 &
    post_train 1 warp --env.physics=warp --env.shards="${WARP_SHARDS:-1}" --env.threads=$((half / ${WARP_SHARDS:-1})) --env.num_envs=2048 \
      --env.decisions=36 --ppo.critic_warmup=1 --ppo.epochs=1 --ppo.batch_size=2048
    wait
    ;;
  esac
done
touch "${DONE:-/dev/shm/done}"
