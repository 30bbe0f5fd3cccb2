# On the GPU machine, two GPUs, after start.sh and warp.sh: setsid bash .ci/gpu/physics.sh SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# MuJoCo Warp against MuJoCo C. GPU 0 with the first half of the threads is C's, GPU 1 with the others Warp's: control steps and pictures
# (pipelines.benchmarks), policies of /dev/shm/policies/TASK in 512 scenes, and, until SECOND of the machine's clock, PPO of the first
# policy of learn.sh, which runs beside it.
# Before it, for each TASK, with the parts of a policy that next.sh brought in FOLDER: bash .ci/gpu/physics.sh unpack TASK FOLDER.
if [ "$1" = unpack ]; then
  to=${POLICIES:-/dev/shm/policies}/$2
  mkdir -p "$to"
  tar xzf "$3"/learn*.tgz -C "$to" --strip-components=6
  cat "$3"/policy_* | PYTHONPATH=/dev/shm/site python3 -c "import sys, zstandard; zstandard.ZstdDecompressor().copy_stream(sys.stdin.buffer, sys.stdout.buffer)" >"$to/model.safetensors"
  exit
fi
. /dev/shm/warp_env.sh
export OMP_NUM_THREADS=4
end=$1 half=$(($(env -u OMP_NUM_THREADS nproc) / 2)) out=/dev/shm/learn_physics
mkdir -p $out
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
since() { echo "$1 $(now)" >>/dev/shm/times; }
on() { # GPU command …
  local gpu=$1 && shift
  CUDA_VISIBLE_DEVICES=$gpu taskset -c $((gpu * half))-$((gpu * half + half - 1)) ${limit:-} "$@"
}
score() { # GPU NAME POLICY TASK OPTIONS
  on "$1" python3 -m taccorl.cli.main evaluate --policy.path="$3" --policy.device=cuda --task="$4" --policy.n_action_steps=8 --episodes=512 \
    --seed=70000 --failures=0 "${@:5}" --out="$out/score_$2" >"$out/score_$2.log" 2>&1
  since "$2 scored: $?"
}
post_train() { # GPU NAME OPTIONS
  on "$1" python3 -m taccorl.cli.main post-train --config_path=configs/post_train/small.yaml --policy.path="$policy" --env.task=assembly_1 \
    --anchor.weight=0 --noise_check=false --rerun=false --save_freq=2 --keep_checkpoints=1 "${@:3}" --out="$out/$2" >"$out/score_$2.log" 2>&1
  since "$2 ended: $?"
  cp "$out/$2/progress.jsonl" "$out/score_$2.jsonl"
}
warp=(--env.physics=warp --env.shards=1 --env.threads="$half")
until grep -qs '^1 made' /dev/shm/times; do sleep 1; done
since "physics begins"
(
  for task in test_tube assembly_2; do OMP_NUM_THREADS=1 score 0 "${task}_c" /dev/shm/policies/$task $task --workers="$half" --batch_size=32; done
) &
scored=$!
on 1 python3 - >"$out/score_drawing.log" 2>&1 <<'P'
import time

from taccorl.sim.vector_env import TaccorlVectorEnv

envs = TaccorlVectorEnv("assembly_1", 512, num_threads=16, images="on_request")
envs.reset(seed=0)
for threads in (1, 2, 4, 8, 16, 1, 2, 4, 8, 16):
    envs.sim.blocks.close()
    envs.sim.blocks.num_threads = threads
    for _ in range(3):
        before = time.perf_counter()
        envs.sim.render(size=(112, 112))
        print(threads, "threads:", 1e3 * (time.perf_counter() - before) / 512, "ms for three pictures", flush=True)
P
bench() { # NAME, before which `on GPU` or nothing stands
  python3 -m pipelines.benchmarks --only="$1" >"$out/score_$1.log" 2>&1
  since "$1: $?"
  cp bench.json "$out/score_bench.json"
}
export -f bench since now
export out
on 1 timeout 240 bash -c "bench physics_on_gpu"
on 1 timeout 270 bash -c "bench full_post_training"
for task in test_tube assembly_2; do score 1 "${task}_warp" /dev/shm/policies/$task $task --physics=warp; done
until policy=$(ls -d /dev/shm/learn_1/assembly_1/policy_*/checkpoints/last/pretrained_model 2>/dev/null | head -n 1) && [ -n "$policy" ]; do sleep 1; done
wait $scored
short=(--env.num_envs=128 --env.decisions=36 --ppo.critic_warmup=0 --iterations=3)
post_train 0 c_128_36 --env.shards="$half" "${short[@]}" &
post_train 1 warp_128_36 "${warp[@]}" "${short[@]}"
wait $!
limit="timeout -s TERM $((end - $(now)))"
post_train 0 c_128_72 --env.shards="$half" --ppo.critic_warmup=2 &
post_train 1 warp_2048_36 "${warp[@]}" --env.num_envs=2048 --env.decisions=36 --ppo.critic_warmup=1 --ppo.epochs=1 --ppo.batch_size=2048
wait
limit="timeout 200"
for stage in c_128_72 warp_2048_36; do
  of=$out/$stage/checkpoints/last/pretrained_model
  (OMP_NUM_THREADS=1 score 0 ${stage}_by_c "$of" assembly_1 --workers="$half" --batch_size=32) &
  score 1 ${stage}_by_warp "$of" assembly_1 --physics=warp
  wait
done
unset CUDA_VISIBLE_DEVICES
timeout 150 bash -c "bench full_adapters"
touch /dev/shm/done
