# Here: bash .ci/gpu/ppo.sh pack NOMINAL MENDED, two folders pretrained_model, one that learnt in the nominal twin and one in the twin
# mended of a surrogate: what three calls carry, into outputs/ppo_1 … 3. There, after start.sh, on two or four GPUs: in a call each, with
# outputs/ppo_K carried, `mkdir -p /dev/shm/ppo && cp outputs/ppo_K/* /dev/shm/ppo`; then
# setsid bash .ci/gpu/ppo.sh SURROGATE SECOND > /dev/shm/job.log 2>&1 < /dev/null &
# PPO of either policy in its twin, without and with an anchor on 50 demonstrations of the surrogate, until SECOND of the machine's
# clock; then start and result are scored in the surrogate. `TASK=assembly_2 bash .ci/gpu/ppo.sh nominal SECOND`: of $POLICIES/nominal,
# in the nominal twin alone. RUNS="nominal_1000 ppo_anchored,nominal_2000 ppo_anchored 5": other policies of $POLICIES, whose names begin
# with that of their twin, 5: weight of the anchor; of a policy with "untrained" in its name, or if START=false, the start is not scored.
# FIRST, THREADS, DONE: first core, number of cores, file of the end, beside another such job; SCORE_WORKERS: processes that score a policy.
if [ "$1" = pack ]; then
  mkdir -p outputs/ppo_{1,2,3}
  ln -sfn "$(realpath "$2")" outputs/ppo_1/nominal && ln -sfn "$(realpath "$3")" outputs/ppo_1/mended
  tar ch -C outputs/ppo_1 nominal mended | zstd -qT0 >outputs/ppo_2/all && rm outputs/ppo_1/{nominal,mended}
  split -n 3 -d -a 1 outputs/ppo_2/all outputs/ppo_2/part_ && rm outputs/ppo_2/all
  mv outputs/ppo_2/part_0 outputs/ppo_1/ && mv outputs/ppo_2/part_2 outputs/ppo_3/
  exit
fi
. /dev/shm/env.sh
name=$1 end=$2 task=${TASK:-assembly_1} policies=${POLICIES:-/dev/shm/policies}
if [ "$name" = nominal ]; then
  robot='' scored_in=() runs=("nominal ppo")
else
  robot=configs/surrogates/$name.yaml
  scored_in=(--twin="$robot") runs=("nominal ppo" "nominal ppo_anchored" "mended ppo" "mended ppo_anchored")
fi
if [ -n "${RUNS:-}" ]; then IFS=, read -ra runs <<<"$RUNS"; fi
threads=${THREADS:-$(env -u OMP_NUM_THREADS nproc)} gpus=${GPUS:-$(nvidia-smi -L | wc -l)}
scored=${SCORED:-192} demonstrations=${DEMONSTRATIONS:-50} options=(${OPTIONS:-})
each=$((threads / (${#runs[@]} > gpus ? ${#runs[@]} : gpus)))
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
since start
if [ -e /dev/shm/ppo ]; then mkdir -p "$policies" && cat /dev/shm/ppo/* | python3 -c "import sys, tarfile, zstandard
tarfile.open(fileobj=zstandard.ZstdDecompressor().stream_reader(sys.stdin.buffer), mode='r|').extractall('$policies', filter='data')"; fi
if [ -n "$robot" ]; then
  python3 -c "import sys
from pathlib import Path
from pipelines.learn import LearnConfig, demonstrations, parsed
demonstrations(parsed(LearnConfig, sys.argv[1:], 'learn'), '$task', Path('$robot'), domain='surrogate')" --task="$task" --episodes="$demonstrations" \
    --scored_in=["$robot"] --out=/dev/shm/anchor --workers="$threads" >/dev/shm/made_anchor.log 2>&1
  since "anchor made: $?"
fi
improve() { # NUMBER TWIN STAGE [BETA]
  local beta=${4:-1} first=$((${FIRST:-0} + $1 * each))
  local cores=$first-$((first + each - 1))
  out=/dev/shm/learn_ppo/$task/policy_$2_$3${4:+_$4} twin=() more=()
  if [[ "$2" = mended* ]]; then twin=(--env.twin=.ci/gpu/mended/mended_"$name".yaml); fi
  if [ "$3" = ppo_anchored ]; then
    anchor=(--anchor.dataset="$(echo /dev/shm/anchor/$task/train_*/)" --anchor.allow_simulated=true --anchor.cache_store=/dev/shm/anchor/store --anchor.weight="$beta")
  else
    beta=0 anchor=(--anchor.weight=0)
  fi
  if [ "$3" = noise ]; then more=(--iterations=1); fi
  export CUDA_VISIBLE_DEVICES=$((${GPU:-0} + $1 % gpus))
  mkdir -p "$(dirname "$out")"
  taskset -c "$cores" timeout -s TERM $((end - $(date +%s) + $(cat /dev/shm/t0))) python3 -m taccorl.cli.main post-train \
    --config_path=configs/post_train/small.yaml --policy.path="$policies/$2" --env.task="$task" --env.shards="$each" \
    --save_freq=5 --keep_checkpoints=1 --rerun=false "${twin[@]}" "${anchor[@]}" "${options[@]}" "${more[@]}" --out="$out" >"$out.log" 2>&1
  since "$2 $3 ${4:-} ended: $?"
  for scored_of in "$policies/$2" "$out/checkpoints/last/pretrained_model"; do
    stage=$([ "$scored_of" = "$policies/$2" ] && echo start || echo "$3")
    score=$out/score_${scored}_train_8_clear_nothing_$stage
    if [[ "$3" = ppo && "$2" != *untrained* && ${START:-true} = true ]] || [ "$scored_of" != "$policies/$2" ]; then
      OMP_NUM_THREADS=1 taskset -c "$cores" python3 -m taccorl.cli.main evaluate --policy.path="$scored_of" --policy.device=${DEVICE:-cuda} --task="$task" \
        --policy.n_action_steps=8 --episodes="$scored" --seed=60000 "${scored_in[@]}" --batch_size=64 --workers=${SCORE_WORKERS:-$(((each + 1) / 2))} --failures=0 \
        --out="$score" >"$score.log" 2>&1
      since "$2 $3 ${4:-} scored: $?"
      python3 - "$policies/$2/train_config.json" "$robot" "$score" "$stage" "$beta" "$out.log" <<'P'
import json, re, sys
from pathlib import Path

from pipelines.learn import named

learnt, robot, score, stage, beta, log = json.loads(Path(sys.argv[1]).read_text()), *sys.argv[2:]
name = Path(learnt["dataset"]["root"]).name
of, twin, real = re.fullmatch(r"train_(\d+)_20_steps(?:_(?!and_)(.*?))?(?:_and_train_(\d+)_20_steps_.*)?", name).groups()
sensors = "touch" if learnt["policy"]["tactile"] else "cameras"
about = {"sensors": sensors, "demonstrations": int(of) * (learnt["steps"] > 1), "seed": learnt["seed"], "twin": twin or "", "scored_in": named(Path(robot)) if robot else "", "steps": learnt["steps"]}
about |= {"real": int(real), "sim_weight": learnt["policy"]["sim_weight"]} if real else {}
about |= {} if stage == "start" else {"beta": float(beta)}
noise = re.search(r"over (\d+) episodes: ([\d.]+)% without noise, ([\d.]+)% with", Path(log).read_text())
about |= {"noise": dict(zip(("n", "without", "with"), map(float, noise.groups())))} if noise and stage != "start" else {}
if stage != "start":
    progress = (Path(log).with_suffix("") / "progress.jsonl").read_text().splitlines()
    about["updates"] = sum(json.loads(line)["actor_steps"] > 0 for line in progress)  # iterations that changed the policy
(Path(score) / "settings.json").write_text(json.dumps(about | {"stage": stage}))
P
    fi
  done
}
for k in "${!runs[@]}"; do
  improve "$k" ${runs[k]} &
done
wait
if [ -n "$robot" ]; then touch "${DONE:-/dev/shm/done}"; fi # the nominal one runs beside learn.sh
