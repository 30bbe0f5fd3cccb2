# bash .ci/gpu/next.sh SECOND, in every call after the one that began learn.sh or ppo.sh: waits until SECOND of the machine's clock or the
# end of the job; into $OUT come scores, logs, and, but for WEIGHTS=false, those of one more policy (bfloat16, zstd, in parts).
[ -e /dev/shm/t0 ] || { echo "another machine: nothing of the job is here"; exit 1; }
. /dev/shm/env.sh
now() { echo $(($(date +%s) - $(cat /dev/shm/t0))); }
echo "from $(now) s"
while [ "$(now)" -lt "$1" ] && [ ! -e /dev/shm/done ]; do sleep 1; done
cd /dev/shm || exit 1
for policy in learn_*/*/policy_*/checkpoints/last/pretrained_model; do
  policy=$(realpath --relative-to=. "$policy") # last is a link
  if [ "${WEIGHTS:-true}" = false ]; then break; fi
  if [ -e "$policy/model.safetensors" ] && ! grep -qs "$policy" fetched && [ $(($(date +%s) - $(stat -c %Y "$policy/model.safetensors"))) -gt 10 ]; then
    echo "$policy" >>fetched
    python3 - "$policy" "$OUT" <<'P'
import sys
from pathlib import Path

import zstandard
from safetensors.torch import load_file, save

policy, out = Path(sys.argv[1]), Path(sys.argv[2])
weights = {k: v.bfloat16() if v.is_floating_point() else v for k, v in load_file(policy / "model.safetensors").items()}
data = zstandard.ZstdCompressor(threads=8).compress(save(weights))
for k in range(0, len(data), 16_700_000):
    (out / f"{policy.parts[2]}.{k // 16_700_000}").write_bytes(data[k : k + 16_700_000])
P
    tar czf "$OUT/${policy//\//_}.tgz" --exclude=model.safetensors --exclude=manifest.json "$policy"
    break
  fi
done
tar czf "$OUT/scores.tgz" --ignore-failed-read $(find learn_* -path '*score_*' \( -name '*.json' -o -name '*.jsonl' -o -name '*.log' \) ! -path '*failures*') \
  $(find learn_* -name scores.md -o -name progress.jsonl) $(ls learn_ppo/*/policy_*.log learn_speed/*.{log,prof}) ./*.log times study*.jsonl
cat times
tail -qn 1 made_*.log
for log in learn_*/*/policy_*.log; do echo "$log $(tail -c 120 "$log" | tr '\r' '\n' | tail -n 1)"; done
tail -qn 1 learn_*/*/policy_*/score*.log
grep -hE '^\| (assembly|test_tube|puzzle)' learn_*.log
tail -n 1 study.log
uptime
nvidia-smi --query-gpu=memory.used,utilization.gpu --format=csv,noheader
echo "until $(now) s"
