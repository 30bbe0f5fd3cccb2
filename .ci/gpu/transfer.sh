# On the GPU machine, after start.sh, on four GPUs: setsid bash .ci/gpu/transfer.sh SURROGATE > /dev/shm/job.log 2>&1 < /dev/null &
# Three policies each of the nominal twin, of the twin mended of SURROGATE (sticky, heavy, late) and of SURROGATE itself, scored in it.
. /dev/shm/env.sh
name=$1 episodes=${2:-1200} scored=${3:-192} options=${4:---steps=2500,--save_freq=2500} threads=$(env -u OMP_NUM_THREADS nproc)
robot=configs/surrogates/$name.yaml
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
# TWIN, GPUS, PROCESSES that make demonstrations, CORES of the trainings and of the processes that score, a third for each policy.
learn() {
  words=(--task=assembly_1 --episodes="$episodes" --scored="$scored" --train_options=["$options"] --seeds=[1000,2000,3000]
    --twins=["$1"] --scored_in=["$robot"] --out="/dev/shm/learn_$1")
  python3 -c "import sys
from pipelines.learn import LearnConfig, _twins, demonstrations, parsed
config = parsed(LearnConfig, sys.argv[1:], 'learn')
[demonstrations(config, 'assembly_1', twin) for twin in _twins(config)]" "${words[@]}" --workers="$3" >"/dev/shm/made_$1.log" 2>&1
  since "$1 made: $?"
  touch "/dev/shm/made_$1"
  CUDA_VISIBLE_DEVICES=$2 taskset -c "$4" python3 -m pipelines.learn "${words[@]}" --workers=$((threads / 9)) --score_device=cuda >"/dev/shm/learn_$1.log" 2>&1
  since "$1 learnt and scored: $?"
}
mended=/dev/shm/learn_mended/surrogates/$(python3 -c "from pathlib import Path; from pipelines.learn import _named; print(_named(Path('$robot')))")
mkdir -p "$mended" && cp ".ci/gpu/mended/mended_$name.yaml" "$mended/"
while sleep 2; do renice -n -15 -p $(pgrep -f lerobot_train); done >/dev/null 2>&1 &
since start
third=$((threads / 3))
learn nominal 0,1,2 $((threads - 4)) 0-$((third - 1)) &
until [ -e /dev/shm/made_nominal ]; do sleep 1; done
learn surrogate 3,1,0 $((threads / 2)) $third-$((2 * third - 1)) &
learn mended 2,3,1 $((threads / 2)) $((2 * third))-$((3 * third - 1)) &
until [ -e /dev/shm/made_surrogate ] && [ -e /dev/shm/made_mended ]; do sleep 1; done
# While policies learn, the cores have nothing to do: docs/diagnosis.md.
python3 -m pipelines.diagnosis_study pack chirp pairs none outside removed touch touch_none touch_outside loop dropped --seeds=5 \
  --first_seed=60000 --workers=$((threads * 3 / 4)) --rows=/dev/shm/study.jsonl >/dev/shm/study.log 2>&1
since "diagnosis study: $?"
wait %2 %3 %4
touch /dev/shm/done
