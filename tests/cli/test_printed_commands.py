"""Every command that a run prints, or that its page shows, is run as it stands.

Recordings of one mass by the equations of ``simulated_loop``: simulated, not a robot."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taccorl.sim.effects import effects
from tests.cli.printed import commands, facts, of_page
from tests.cli.simulated_loop import SWING, Loop, table

CONSIDERED = ("coulomb_friction", "viscous_friction", "command_delay", "armature")
FEW = f"--without=[{','.join(name for name in effects if name not in CONSIDERED)}]"
KP, KD = 24.1, 1.5
USES = "recordings:\n  held.csv: {use: validation}\n  test.csv: {use: test}\n"


def bench(folder: Path, file: str, friction: float = 0.0) -> None:
    """A robot of one joint in ``folder``, its file and four recordings, one repeated."""
    (folder / "bench").mkdir()
    (folder / "arm.xml").write_text(SWING)
    drive = f"kind: robot\nmodel: arm.xml\njoints:\n  swing: {{{file}, loop_hz: 2e4}}\n"
    (folder / "robot.yaml").write_text(drive)
    (folder / "bench" / "measurements.yaml").write_text(
        f"{USES}  again.csv: {{repeat_of: one.csv}}\n"
    )
    loop = Loop(0.05, KP, KD, friction, weight=1.962)
    recordings = {"one": 2.5, "again": 2.5, "held": 2.0, "test": 1.5}
    for seed, (name, hz) in enumerate(recordings.items()):
        time_s, target, q, _ = loop.recorded(0.4, hz, 200, 4.0)
        q = q + 1e-4 * np.random.default_rng(seed).standard_normal(len(q))
        rows = {"t": time_s, "swing.q": q, "swing.q_target": target}
        table(folder / "bench" / f"{name}.csv", rows)


GAINS_OFF = "kp: 39.4, kd: 2.73, gains: fitted"
RIGHT = f"kp: {KP}, kd: {KD}"
CASES = [
    (GAINS_OFF, 0.0, (), "numbers_off", ["add-effect"]),
    pytest.param(
        GAINS_OFF,
        0.0,
        ("--until=noise_floor",),
        "numbers_off",
        ["compare"],
        marks=pytest.mark.slow,
    ),
    pytest.param(
        GAINS_OFF,
        0.0,
        ("--out=my report",),
        "numbers_off",
        ["add-effect"],
        marks=pytest.mark.slow,
    ),
    pytest.param(RIGHT, 0.0, (), "nothing_missing", [], marks=pytest.mark.slow),
    pytest.param(RIGHT, 0.1, (), "effects", ["add-effect"], marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("file", "friction", "words", "kind", "verbs"), CASES)
def test_each_printed_command_does_what_it_says(
    said: Any, tmp_path: Path, file, friction, words, kind, verbs
):
    """Those that follow from a command are run, too: add-effect prints a comparison."""
    bench(tmp_path, file, friction)
    code, text = said("diagnose", "bench", "--twin=robot.yaml", FEW, *words)
    out = [word.removeprefix("--out=") for word in words if word.startswith("--out=")]
    folder = Path(*out or ["diagnosis"])
    own = facts(folder, "swing")
    assert (code, next(iter(own))) == (0, kind), text
    assert "replaced" not in text, "its own report of what was found so far"
    printed = commands(text)
    assert {*of_page(folder / "report.html")} == {*printed}
    assert [c.split()[1] for c in printed if c.split()[1] != "excite"] == verbs
    assert not words or not [c for c in printed if words[0] in c], "it was done"
    while printed:
        command = shlex.split(printed.pop(0))
        code, text = said(*command[1:])
        assert code == 0, (command, text)
        printed += commands(text) if command[1] == "add-effect" else []
    if verbs:  # the last command compared both files: nearly nothing is left
        after = next(iter(own["error"]))["after"]
        lines = [line for line in text.splitlines() if "swing position" in line]
        line = next(line for line in lines if "validation" in line)
        assert f"{after:.3g}" in line.split(), line
