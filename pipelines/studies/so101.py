"""A simulated arm like an SO-101, whose elbow has friction that its published numbers lack.

MuJoCo moves the arm with steps of 0.2 ms and ``implicitfast``. Each servo sets its duty by
the position error. The script logs positions and targets at 100 Hz, one joint moving at a
time; the links are those of a similar arm, not of the SO-101's CAD files. **Simulated: no
recording here is of a real arm.**

``python -m pipelines.studies.so101 my_so101`` writes the example of README.md.

Letters in shapes: T rows at 100 Hz.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from taccorl.alignment.machines.robot_draft import servo_of
from taccorl.alignment.measurements.table_files import origin_lines
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError

ORIGIN = "simulated SO-101 (pipelines.studies.so101)"
LINKS = (
    # joint, axis, place on the link before [m], mass [kg], limits [rad], rest angle [rad]
    ("shoulder_pan", "0 0 1", "0 0 0.06", 0.15, "-1.92 1.92", 0.0),
    ("shoulder_lift", "0 1 0", "0 0 0.05", 0.10, "-1.75 1.75", -0.3),
    ("elbow_flex", "0 1 0", "0 0 0.11", 0.10, "-1.69 1.69", 0.3),
    ("wrist_flex", "0 1 0", "0.13 0 0", 0.08, "-1.66 1.66", 0.2),
    ("wrist_roll", "1 0 0", "0.06 0 0", 0.09, "-2.74 2.84", 0.0),
    ("gripper", "0 0 1", "0.03 0 0", 0.02, "-0.174 1.745", 0.3),
)
JOINT, SHARE = 2, 0.3
"""Joint that moves, and the share of its motor's torque that its gear loses: hidden."""
ROW_S, STEP_S, NOISE_RAD = 0.01, 2e-4, 3e-4
"""Time between rows [s], physics step [s], noise of the logged positions [rad]."""


def mjcf() -> str:
    """Text of the arm's MJCF file: links and limits, without friction or armature."""
    inner = ""
    for joint, axis, place, mass, limits, _ in reversed(LINKS):
        inner = (
            f'<body name="{joint}_link" pos="{place}">'
            f'<joint name="{joint}" axis="{axis}" range="{limits}"/>'
            f'<inertial pos="0.04 0 0.01" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>'
            f"{inner}</body>\n"
        )
    return (
        '<mujoco model="so101"><compiler angle="radian"/>'
        f"<worldbody>\n{inner}</worldbody></mujoco>\n"
    )


def record(motion: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Simulate a recording from rest.

    Args:
        motion: (T,) offset of the elbow's target from its rest angle [rad].
        rng: noise of the positions.

    Returns:
        (T, 13): time [s], then position and target of each joint [rad].
    """
    servo = {key: value for key, (value, _) in servo_of("so101").items()}
    model = mujoco.MjModel.from_xml_string(mjcf())
    model.opt.timestep = STEP_S
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.dof_armature[:] = servo["rotor_inertia"]
    model.dof_damping[:] = servo["viscous_friction"]
    model.dof_solref[:], model.dof_solimp[:, :2] = (0.001, 1.0), 0.9999
    data = mujoco.MjData(model)
    rest = np.array([link[-1] for link in LINKS])
    data.qpos[:] = rest
    moves = np.arange(len(LINKS)) == JOINT
    k_t, ohm, volt = (
        servo[key] for key in ("torque_nm_per_a", "resistance_ohm", "supply_v")
    )
    gain = servo["kp"] * servo["kp_factor"]
    steps_of_row = round(ROW_S / STEP_S)
    rows = []
    for k in range(-100, len(motion)):  # a second at rest before the first row
        target = rest + moves * motion[max(k, 0)]
        if k >= 0:
            position = data.qpos + NOISE_RAD * rng.normal(size=len(rest))
            rows.append([k * ROW_S, *np.column_stack([position, target]).ravel()])
        for _ in range(steps_of_row):
            duty = np.clip(gain * (target - data.qpos), -1.0, 1.0)
            torque = k_t * (volt * duty - k_t * data.qvel) / ohm
            data.qfrc_applied[:] = torque
            lost = SHARE * moves * np.abs(torque)
            model.dof_frictionloss[:] = servo["coulomb_friction"] + lost
            mujoco.mj_step(model, data)
    return np.array(rows)


def motions() -> dict[str, tuple[str, np.ndarray]]:
    """File name → its entry of measurements.yaml, and (T,) offsets of the target [rad]."""
    t = np.arange(1000) * ROW_S

    def sweep(size: float, low_hz: float, high_hz: float) -> np.ndarray:
        turns = low_hz * t + (high_hz - low_hz) * t**2 / (2 * t[-1])
        return size * np.sin(2 * np.pi * turns)

    def triangle(size: float, period_s: float) -> np.ndarray:
        return size * (4 * np.abs((t / period_s + 0.25) % 1 - 0.5) - 1)

    def steps(size: float, period_s: float) -> np.ndarray:
        return size * np.sign(np.sin(2 * np.pi * t / period_s))

    return {
        "sweep.csv": ("use: fit", sweep(0.5, 0.1, 2.0)),
        "sweep_again.csv": ("use: fit, repeat_of: sweep.csv", sweep(0.5, 0.1, 2.0)),
        "triangle.csv": ("use: fit", triangle(0.8, 5.0)),
        "steps.csv": ("use: fit", steps(0.3, 2.5)),
        "held_sweep.csv": ("use: validation", sweep(0.4, 0.2, 1.5)),
        "held_steps.csv": ("use: validation", steps(0.2, 3.0)),
        "last.csv": ("use: test", sweep(0.45, 2.0, 0.2)),
    }


def write(folder: Path) -> None:
    """Write what an SO-101's user has: ``so101.xml``, and ``sweeps/`` with tables.

    Raises:
        TaccorlError: the folder exists.
    """
    if folder.exists():
        raise TaccorlError(f"{folder}: already exists; name a new folder")
    (folder / "sweeps").mkdir(parents=True)
    text = f"Everything here is simulated: {ORIGIN}. No robot was near.\n"
    (folder / "SIMULATED.txt").write_text(text, encoding="utf-8")
    (folder / "so101.xml").write_text(mjcf(), encoding="utf-8")
    columns = [f"{link[0]}.{key}" for link in LINKS for key in ("q", "q_target")]
    header = origin_lines(Origin("surrogate", ORIGIN)) + ",".join(["t", *columns])
    lines = ["recordings:"]
    for seed, (name, (use, motion)) in enumerate(motions().items()):
        rows = record(motion, np.random.default_rng(seed))
        path = folder / "sweeps" / name
        np.savetxt(path, rows, "%.7g", ",", header=header, comments="")
        lines.append(f"  {name}: {{{use}}}")
    text = "\n".join(lines) + "\n"
    (folder / "sweeps" / "measurements.yaml").write_text(text, encoding="utf-8")


def main(argv: Sequence[str]) -> int:
    """Write the example into the folder ``argv[0]``. Returns the exit status 0."""
    write(Path(argv[0]))
    print(f"wrote {argv[0]}: so101.xml and sweeps/; simulated, not of a real arm")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
