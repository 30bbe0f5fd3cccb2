"""The paper's search for gains (App. B.1) by ``taccorl align --method=spsa``, on sweeps of the
surrogate robot, whose simulation is independent of the twin. ``make bench ONLY=spsa``.

Each of six joints moves by the paper's 10 s sweep (fit) and by another one (held out); the
robot has the paper's gains, the twin those of its reference simulator. Three seeds each.
The twin's gains are slower than the robot's, which looks like a clock that is off: that check
is accepted by name.
"""

import contextlib
import dataclasses
import io
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from pipelines.benchmarks.rows import Row, benchmark
from taccorl.alignment.checks.clock import SHIFTED
from taccorl.alignment.controller.identification import REFERENCE
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.measurements.folder import INDEX
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import DESIGNS, VALIDATION
from taccorl.cli.main import main
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import save_twin
from taccorl.surrogate.cases import case_of
from taccorl.surrogate.recordings import record

SEEDS = 3
SECRET = 1  # of the surrogate: pose and noise
_NOTE = "surrogate; six joints × three seeds"


class Found(NamedTuple):
    """Result of one run of the command."""

    joint: str
    seed: int
    before_mrad: float  # RMS error on the held-out sweep with the reference gains
    after_mrad: float  # The same with the fitted gains
    ratio_percent: float  # Error of K_d / K_p


def write_sweeps(folder: Path, signal: str) -> Path:
    """The two sweeps of one joint as tables, which do not state the robot's gains."""
    case = case_of(TwinConfig(), signal, SECRET, "chirp")
    case = dataclasses.replace(case, gains_known=False)
    folder.mkdir()
    uses = {}
    for use, motion in (("fit", DESIGNS["chirp"][0]), ("validation", VALIDATION[0])):
        _write_table(folder / f"{use}.csv", record(case, motion))
        uses[f"{use}.csv"] = {"use": use}
    (folder / INDEX).write_text(yaml.safe_dump({"recordings": uses}))
    return folder


def _write_table(path: Path, m: Measurement) -> None:
    names, columns = ["t"], [m.time_s]
    for k, signal in enumerate(m.signals):
        names += [f"{signal}.q_target", f"{signal}.q"]
        columns += [m.target[:, k], m.measured[:, k]]
    header = ",".join(names)
    values = np.column_stack(columns)
    np.savetxt(path, values, "%.9g", delimiter=",", header=header, comments="")


def align(sweeps: Path, twin: Path, signal: str, seed: int) -> Found:
    """Run ``taccorl align --method=spsa``. Raises TaccorlError: it wrote no twin."""
    out = sweeps.with_name(f"{signal}_{seed}")
    words = [str(sweeps), f"--twin={twin}", f"--joints=[{signal}]", "--method=spsa"]
    words.append(f"--accept={SHIFTED}")
    with contextlib.redirect_stdout(io.StringIO()) as text:
        code = main(["align", *words, f"--seed={seed}", f"--out={out}", "--workers=1"])
    if code or not (out / "twin.yaml").is_file():
        raise TaccorlError(
            f"taccorl align {' '.join(words)}: {code}: {text.getvalue()}"
        )
    [part] = json.loads((out / "report.json").read_text())["parts"]
    [ratio] = [n["value"] for n in part["numbers"] if n["name"] == "kd/kp"]
    truth = JointModel(TwinConfig(), signal).gains
    return Found(
        joint=signal,
        seed=seed,
        before_mrad=1e3 * part["before"],
        after_mrad=1e3 * part["after"],
        ratio_percent=100.0 * (ratio * truth.kp / truth.kd - 1.0),
    )


def runs() -> Iterator[Found]:
    """Run SPSA for every joint and seed; yield the results joint by joint."""
    controller = ControllerConfig(
        kp_nm_per_rad=[REFERENCE.kp] * ROBOT.num_joints,
        kd_nms_per_rad=[REFERENCE.kd] * ROBOT.num_joints,
        torque_ff_nm=[REFERENCE.torque_ff] * ROBOT.num_joints,
    )
    with tempfile.TemporaryDirectory() as folder:
        twin = Path(folder) / "reference.yaml"
        save_twin(TwinConfig(controller=controller), twin)
        for joint in ROBOT.joints:
            signal = f"left_{joint}"
            sweeps = write_sweeps(Path(folder) / signal, signal)
            for seed in range(SEEDS):
                yield align(sweeps, twin, signal, seed)


@benchmark("spsa")
def spsa() -> Iterator[Row]:
    """The paper's search by the command, and its errors on held-out sweeps."""
    found = []
    for one in runs():
        print(
            f"{one.joint} seed {one.seed}: {one.before_mrad:.2f} → {one.after_mrad:.2f} "
            f"mrad, K_d / K_p off by {one.ratio_percent:+.2f} %",
            flush=True,
        )
        found.append(one)
    yield Row.of(
        [one.after_mrad for one in found],
        by=max,
        name=f"held-out sweep, worst ({_NOTE})",
        unit="mrad",
        rival="reference gains, worst",
        rival_value=max(one.before_mrad for one in found),
    )
    yield Row.of(
        [abs(one.ratio_percent) for one in found],
        by=max,
        name=f"K_d / K_p off by, worst ({_NOTE})",
        unit="%",
        goal="≤ 2",
    )
