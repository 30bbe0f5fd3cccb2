# On the GPU machine, after start.sh: setsid bash .ci/gpu/learn.sh OPTIONS [OPTIONS …] > /dev/shm/job.log 2>&1 < /dev/null &
# Each of OPTIONS: words of pipelines.learn, such as "--sources=[10] --episodes=[100,1000] --out=/dev/shm/learn_ten". All trainings
# of one begin together. While policies learn and are scored, all cores make the demonstrations of the next.
. /dev/shm/env.sh
threads=$(env -u OMP_NUM_THREADS nproc) gpus=${GPUS:-$(nvidia-smi -L | wc -l)}
room=$((gpus * (${MEMORY_MB:-$(nvidia-smi --query-gpu=memory.total --format=csv,noheader,nounits | head -n 1)} / ${TRAINING_MB:-31000})))
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
trainings() { pgrep -fc '^[^ ]*python[^ ]* -m lerobot.scripts.lerobot_train'; }
trap 'touch ${DONE:-/dev/shm/done}; kill $renicing' EXIT
while sleep 2; do renice -n -15 -p $(pgrep -f lerobot_train); done >/dev/null 2>&1 &
renicing=$!
since start
begun=0
for ((k = 1; k <= $#; k++)); do
  words=(--out=/dev/shm/learn_$k ${!k})
  # The demonstrations, then how many policies learn from them. Twins that commands made of a surrogate come from mended/.
  python3 -c "import shutil, sys
from pathlib import Path

from pipelines.learn import LearnConfig, datasets, named, parsed

config = parsed(LearnConfig, sys.argv[1:], 'learn')
for robot in config.scored_in:
    found = config.out / 'surrogates' / named(robot)
    found.mkdir(parents=True, exist_ok=True)
    shutil.copy(f'.ci/gpu/mended/mended_{robot.stem}.yaml', found)
print(len(list(datasets(config))) * len(config.seeds) * len(config.episodes) * len(config.pictures) * len(config.sensors))" "${words[@]}" --workers="$threads" >"/dev/shm/made_$k.log" 2>&1
  since "$k made: $?"
  n=$(tail -n 1 "/dev/shm/made_$k.log")
  [[ "$n" =~ ^[0-9]+$ ]] || continue
  while [ "$(trainings)" -gt $((room > n ? room - n : 0)) ]; do sleep 1; done
  since "$k learns: $n"
  (
    CUDA_VISIBLE_DEVICES=$(for ((j = begun; j < begun + n; j++)); do echo $((j % gpus)); done | paste -sd ,) \
      python3 -m pipelines.learn --workers="${SCORE_WORKERS:-$((threads / 4 + 1))}" --score_device="${DEVICE:-cuda}" "${words[@]}" >"/dev/shm/learn_$k.log" 2>&1
    since "$k learnt and scored: $?"
  ) &
  pids+=($!)
  begun=$((begun + n))
  sleep 5 # so that its trainings are counted
done
wait "${pids[@]}"
