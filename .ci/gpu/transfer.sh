# On the GPU machine, after start.sh: setsid bash .ci/gpu/transfer.sh SURROGATE [TWINS] > /dev/shm/job.log 2>&1 < /dev/null &
# Three policies of each of TWINS (of nominal, mended, surrogate, configs/randomised), scored in SURROGATE (sticky, heavy, late);
# those of twins that know of no surrogate in all three. While policies learn, all cores make the next twin's demonstrations.
. /dev/shm/env.sh
name=$1 twins=(${2:-configs/randomised mended surrogate})
episodes=${EPISODES:-1200} scored=${SCORED:-192} options=${TRAIN_OPTIONS:-'[--steps=2500,--save_freq=2500]'} more=(${MORE:-})
threads=$(env -u OMP_NUM_THREADS nproc) gpus=${GPUS:-$(nvidia-smi -L | wc -l)}
room=$((gpus * (${MEMORY_MB:-$(nvidia-smi --query-gpu=memory.total --format=csv,noheader,nounits | head -n 1)} / 31000))) # trainings: 19 GB of frames, 11 GB
robot=configs/surrogates/$name.yaml
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
scored_in() { case $twin in mended | surrogate) echo "$robot" ;; *) echo configs/surrogates/{sticky,late,heavy}.yaml | tr ' ' , ;; esac; }
trainings() { pgrep -fc '^[^ ]*python[^ ]* -m lerobot.scripts.lerobot_train'; }
begin() { # NUMBER: the twin's demonstrations, then its trainings and scores while others go on
  twin=${twins[$1]} label=$(basename "${twins[$1]}")
  words=(--task=assembly_1 --episodes="$episodes" --scored="$scored" --train_options="$options" --seeds=[1000,2000,3000]
    --twins=["$twin"] --scored_in=["$(scored_in)"] --out="/dev/shm/learn_$label" "${more[@]}")
  if [ "$twin" = mended ]; then # the twin that commands made of the surrogate, on a machine without a GPU
    found=/dev/shm/learn_mended/surrogates/$(python3 -c "from pathlib import Path; from pipelines.learn import _named; print(_named(Path('$robot')))")
    mkdir -p "$found" && cp ".ci/gpu/mended/mended_$name.yaml" "$found/"
  fi
  python3 -c "import sys
from pipelines.learn import LearnConfig, _twins, demonstrations, parsed
config = parsed(LearnConfig, sys.argv[1:], 'learn')
[demonstrations(config, 'assembly_1', twin) for twin in _twins(config)]" "${words[@]}" --workers="$threads" >"/dev/shm/made_$label.log" 2>&1
  since "$label made: $?"
  while [ "$(trainings)" -gt $((room > 3 ? room - 3 : 0)) ]; do sleep 1; done
  since "$label learns"
  (
    # The last one's scores have the GPUs for themselves.
    device=$([ $(($1 + 1)) = ${#twins[@]} ] && echo "${DEVICE:-cuda}" || echo cpu)
    CUDA_VISIBLE_DEVICES=$((3 * $1 % gpus)),$(((3 * $1 + 1) % gpus)),$(((3 * $1 + 2) % gpus)) \
      python3 -m pipelines.learn "${words[@]}" --workers=$((threads / 4 + 1)) --score_device="$device" >"/dev/shm/learn_$label.log" 2>&1
    since "$label learnt and scored: $?"
  ) &
  began+=($!)
}
while sleep 2; do renice -n -15 -p $(pgrep -f lerobot_train); done >/dev/null 2>&1 &
since start
for k in "${!twins[@]}"; do
  begin "$k"
  sleep 5 # so that its trainings are counted
done
wait "${began[@]}"
touch /dev/shm/done
