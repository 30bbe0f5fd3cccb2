# On the GPU machine, after start.sh, on four GPUs: setsid bash .ci/gpu/transfer.sh SURROGATE > /dev/shm/job.log 2>&1 < /dev/null &
# Policies of the nominal twin, of the twin mended of SURROGATE (sticky, heavy, late) and of SURROGATE itself, scored in it.
. /dev/shm/env.sh
name=$1
since() { echo "$1 $(($(date +%s) - $(cat /dev/shm/t0)))" >>/dev/shm/times; }
learn() { python3 -m pipelines.learn --task=assembly_1 --episodes=800 --scored=192 --train_options=[--steps=2500,--save_freq=2500] "$@"; }
robot=configs/surrogates/$name.yaml
mended=/dev/shm/learn/surrogates/$(python3 -c "from pathlib import Path; from pipelines.learn import _named; print(_named(Path('$robot')))")
mkdir -p "$mended" && cp ".ci/gpu/mended/mended_$name.yaml" "$mended/"
while sleep 2; do renice -n -15 -p $(pgrep -f lerobot_train); done >/dev/null 2>&1 &
since start
CUDA_VISIBLE_DEVICES=3 learn --workers=30 --seeds=[1000,2000,3000] --twins=[surrogate] --scored_in=["$robot"] --out=/dev/shm/learn_surrogate >/dev/shm/surrogate.log 2>&1 &
other=$!
CUDA_VISIBLE_DEVICES=0,1,2 learn --workers=34 --seeds=[1000,2000,3000] --twins=[nominal,mended] --scored_in=["$robot"] --out=/dev/shm/learn >/dev/shm/learn.log 2>&1
since "nominal and mended: $?"
wait $other
since "surrogate: $?"
touch /dev/shm/done
