# On the GPU machine, two GPUs, after start.sh and warp.sh: setsid bash .ci/gpu/physics.sh SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# MuJoCo Warp against MuJoCo C, of the policy /dev/shm/policies/TASK. GPU 0 with the first half of the threads is C's, GPU 1 with the others
# Warp's: control steps and pictures (pipelines.benchmarks); until SECOND of the machine's clock PPO of the policy; 512 scenes with what it
# made; then adapters of the full size on both.
# Before it, with the parts of a policy that next.sh brought in FOLDER: bash .ci/gpu/physics.sh unpack TASK FOLDER.
if [ "$1" = unpack ]; then
  to=${POLICIES:-/dev/shm/policies}/$2
  mkdir -p "$to"
  tar xzf "$3"/learn*.tgz -C "$to" --strip-components=6
  cat "$3"/policy_* | PYTHONPATH=/dev/shm/site python3 -c "import sys, zstandard; zstandard.ZstdDecompressor().copy_stream(sys.stdin.buffer, sys.stdout.buffer)" >"$to/model.safetensors"
  exit
fi
. /dev/shm/warp_env.sh
export OMP_NUM_THREADS=4
task=${TASK:-assembly_1} policy=/dev/shm/policies/${TASK:-assembly_1} out=/dev/shm/learn_physics
end=$1 half=$(($(env -u OMP_NUM_THREADS nproc) / 2))
mkdir -p $out
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
on() { # GPU command …
  local gpu=$1 && shift
  CUDA_VISIBLE_DEVICES=$gpu taskset -c $((gpu * half))-$((gpu * half + half - 1)) ${limit:-} "$@"
}
score() { # GPU NAME POLICY OPTIONS
  on "$1" python3 -m taccorl.cli.main evaluate --policy.path="$3" --policy.device=cuda --task="$task" --policy.n_action_steps=8 --episodes=512 \
    --seed=70000 --failures=0 "${@:4}" --out="$out/score_$2" >"$out/score_$2.log" 2>&1
  since "$2 scored: $?"
}
post_train() { # GPU NAME OPTIONS
  on "$1" python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml --policy.path="$policy" --env.task="$task" \
    --anchor.weight=0 --noise_check=false --rerun=false --save_freq=1 --keep_checkpoints=1 "${@:3}" --out="$out/$2" >"$out/score_$2.log" 2>&1
  since "$2 ended: $?"
  cp "$out/$2/progress.jsonl" "$out/score_$2.jsonl"
}
bench() { # NAME
  python3 -m pipelines.benchmarks --only="$1" >"$out/score_$1.log" 2>&1
  since "$1: $?"
  cp bench.json "$out/score_bench.json"
}
export -f bench since now
export out
since "physics begins"
short=(--env.num_envs=128 --env.decisions=36 --ppo.critic_warmup=0 --iterations=3)
warp=(--env.physics=warp --env.shards=1 --env.threads="$half")
(
  post_train 0 c_128_36 --env.shards="$half" "${short[@]}"
  limit="timeout -s TERM $((end - $(now)))"
  post_train 0 c_128_72 --env.shards="$half" --ppo.critic_warmup=2
) &
limit="timeout 130"
on 1 bash -c "bench physics_on_gpu"
limit=
post_train 1 warp_128_36 "${warp[@]}" "${short[@]}"
limit="timeout -s TERM $((end - $(now)))"
post_train 1 warp_2048_36 "${warp[@]}" --env.num_envs=2048 --env.decisions=36 --ppo.critic_warmup=1 --ppo.epochs=1 --ppo.batch_size=2048
wait
limit="timeout 150"
for stage in c_128_72 warp_2048_36; do
  of=$out/$stage/checkpoints/last/pretrained_model
  (OMP_NUM_THREADS=1 score 0 ${stage}_by_c "$of" --workers="$half" --batch_size=32) &
  score 1 ${stage}_by_warp "$of" --physics=warp
  wait
done
timeout 120 bash -c "bench full_adapters"
touch /dev/shm/done
