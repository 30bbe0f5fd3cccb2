# On the GPU machine, after start.sh, on four GPUs: setsid bash .ci/gpu/transfer.sh SURROGATE [TWINS] > /dev/shm/job.log 2>&1 < /dev/null &
# Three policies of each of three TWINS (of nominal, mended, surrogate, configs/randomised), scored in SURROGATE (sticky, heavy, late);
# those of twins that know of no surrogate in all three.
. /dev/shm/env.sh
name=$1 twins=(${2:-configs/randomised mended surrogate})
episodes=1200 scored=192 options=--steps=2500,--save_freq=2500 threads=$(env -u OMP_NUM_THREADS nproc)
robot=configs/surrogates/$name.yaml third=$((threads / 3))
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
scored_in() { case $twin in mended | surrogate) echo "$robot" ;; *) echo configs/surrogates/{sticky,late,heavy}.yaml | tr ' ' , ;; esac; }
# Of a twin: its demonstrations, then trainings, and scores, on a third of the cores.
learn() { # NUMBER GPUS
  twin=${twins[$1]} label=$(basename "${twins[$1]}")
  words=(--task=assembly_1 --episodes=$episodes --scored=$scored --train_options=[$options] --seeds=[1000,2000,3000]
    --twins=["$twin"] --scored_in=["$(scored_in)"] --out="/dev/shm/learn_$label")
  if [ "$twin" = mended ]; then # the twin that commands made of the surrogate, on a machine without a GPU
    found=/dev/shm/learn_mended/surrogates/$(python3 -c "from pathlib import Path; from pipelines.learn import _named; print(_named(Path('$robot')))")
    mkdir -p "$found" && cp ".ci/gpu/mended/mended_$name.yaml" "$found/"
  fi
  python3 -c "import sys
from pipelines.learn import LearnConfig, _twins, demonstrations, parsed
config = parsed(LearnConfig, sys.argv[1:], 'learn')
[demonstrations(config, 'assembly_1', twin) for twin in _twins(config)]" "${words[@]}" --workers=$third >"/dev/shm/made_$label.log" 2>&1
  since "$label made: $?"
  touch "/dev/shm/made_$1"
  CUDA_VISIBLE_DEVICES=$2 taskset -c $(($1 * third))-$(($1 * third + third - 1)) \
    python3 -m pipelines.learn "${words[@]}" --workers=$((threads / 9)) --score_device=cuda >"/dev/shm/learn_$label.log" 2>&1
  since "$label learnt and scored: $?"
}
while sleep 2; do renice -n -15 -p $(pgrep -f lerobot_train); done >/dev/null 2>&1 &
since start
learn 0 0,1,2 &
learn 1 3,1,0 &
learn 2 2,3,1 &
wait %2 %3 %4
touch /dev/shm/done
