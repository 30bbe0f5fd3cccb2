#!/usr/bin/env bash
# Surprise: `normalized` of flexitac's frames divides each frame by the largest taxel
# of that frame, as soon as one is well pressed: the strongest is always 1, and
# another taxel reads less although its force has not changed.
# Hurts: who records or trains on `normalized` as a measure of force: a light and a
# firm press look alike, and a grip that closes on one side seems to open on the
# other. `raw` with the calibrated baseline keeps the size.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    flexitac==0.3.1 pyserial==3.5 numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import os
import pty
import sys
import threading
from importlib.metadata import version

import numpy as np
from flexitac import FlexiTacSensor
from flexitac.sensor import MARKER

ROWS, COLS, REST = 4, 4, 20


def frame(first, second):
    """Counts of a pad with two taxels pressed by so much above rest."""
    counts = np.full((ROWS, COLS), REST, np.uint8)
    counts[0, 0] += first
    counts[3, 3] += second
    return counts


PRESSES = [(60, 60), (60, 90), (60, 120), (120, 120)]
host, device = pty.openpty()  # stands for the serial port
os.set_blocking(host, True)


def send():
    """Frames at rest for the calibration, then the presses, as the board sends them."""
    for counts in [frame(0, 0)] * 3 + [frame(*press) for press in PRESSES]:
        os.write(host, bytes(MARKER) + counts.tobytes())


sensor = FlexiTacSensor(os.ttyname(device), rows=ROWS, cols=COLS, init_frames=3)
sensor.open()
threading.Thread(target=send, daemon=True).start()
sensor.calibrate()
seen = []
for press in PRESSES:
    got = sensor.read()
    assert got.raw[0, 0] == REST + press[0] and got.raw[3, 3] == REST + press[1]
    seen.append((float(got.normalized[0, 0]), float(got.normalized[3, 3])))
sensor.close()

print(f"flexitac {version('flexitac')}: two taxels, counts above rest -> normalized")
print("expected: equal presses give equal numbers, twice the press a larger one")
print("seen:")
for press, (first, second) in zip(PRESSES, seen):
    print(f"  {press[0]:3d} {press[1]:3d} -> {first:.2f} {second:.2f}")
same = np.allclose(
    seen, [(1, 1), (0.54, 1), (0.37, 1), (1, 1)], atol=0.01
)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
