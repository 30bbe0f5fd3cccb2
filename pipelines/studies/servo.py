"""A simulated hobby servo that swings a pendulum: five loads at three gains, as a script on a bench would log them.

    J(m, l) q̈ = k_t (V d − k_e q̇) / R − m g l sin q − friction

The servo samples its encoder at 1 kHz (4096 ticks a turn), multiplies the error by the register of its gain, cuts the duty off to
a whole step of 885 and holds it. Its supply sags with the current. A script writes a goal and reads position, voltage and time a
hundred times or more a second, never quite evenly. What is computed here shares nothing with the one-joint model of the search:
explicit steps of 50 µs with a set-valued friction, and the load on a mass of its own behind the play. **Simulated: no recording
here is of a real servo.**

``python -m pipelines.studies.servo my_servo`` writes the example of docs/your_robot.md.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numba
import numpy as np

from taccorl.errors import TaccorlError

ORIGIN = "simulated servo (pipelines.studies.servo)"
STEP_S, LOOP_STEPS = 5e-5, 20
"""Physics step [s], and number of steps per cycle of the servo's loop (1 ms)."""
TICK_RAD, MIDDLE_TICK = 2 * math.pi / 4096, 2048
"""Step of the encoder [rad], and its reading at angle 0."""
DUTY_STEPS = 885
"""Number of steps of the duty from 0 to 1."""
KP_FACTOR = 4096 / (2 * math.pi) / (128 * DUTY_STEPS)
"""Duty per rad for one step of the gain's register: a register of 128 is one step of duty per tick."""
SUPPLY_V, SOURCE_OHM = 7.4, 0.25
"""Voltage of the supply without load [V], and its resistance [Ω]."""
LOADS = ((0.05, 0.10), (0.10, 0.10), (0.10, 0.15), (0.22, 0.10), (0.20, 0.15))
"""Mass [kg] and lever [m] of each load, from light to heavy: 0.05 to 0.29 N·m."""
GAINS = (200, 400, 800)
"""Values of the gain's register."""
USES = ("fit", "validation", "fit", "test", "fit")
"""Uses of the loads' recordings."""
GRAVITY = 9.81
DISTURBANCE_SHARE = 2e-3
"""RMS of a random torque (correlated over 50 ms), as a share of the torque through the gear. It is in no model of the search."""
KINDS: Mapping[str, tuple[float, float]] = {
    "load_friction": (0.05, 0.2),
    "coulomb_friction": (0.01, 0.05),
    "stribeck_friction": (0.01, 0.03),
    "backlash": (0.015, 0.05),
    "motor": (1.3, 1.8),
}
"""Name of a hidden fault → range of its strength. load_friction: share of the load; coulomb_friction [N·m]; stribeck_friction:
N·m while moving, twice that at rest; backlash: play [rad]; motor: factor by which the servo file's k_t and k_e are too large or
too small. The last is not an effect, because every fit adjusts these numbers."""


@dataclass(frozen=True, kw_only=True)
class Servo:
    """The simulated servo of a case, as it is: its user knows only ``sheet``."""

    seed: int
    """Seed of everything that is drawn."""
    hidden: str
    """Key of ``KINDS``; empty: nothing is hidden."""
    strength: float = field(init=False)
    """Strength of the hidden fault, in the units of ``KINDS``."""
    inertia: float = field(init=False)
    """Inertia of rotor and gear at the output shaft [kg·m²]."""
    resistance_ohm: float = field(init=False)
    """R of the motor's winding [Ω]."""
    torque_nm_per_a: float = field(init=False)
    """k_t at the output shaft [N·m/A]."""
    emf_v_s_per_rad: float = field(init=False)
    """k_e at the output shaft [V·s/rad]."""
    dry_nm: float = field(init=False)
    """Dry friction that the servo's own file states as well [N·m]; 0 for servos whose hidden fault is another friction."""
    arm_kg_per_m: float = field(init=False)
    """Mass of the arm that holds the load, per length [kg/m]."""
    rate_hz: int = field(init=False)
    """Rate at which the script is meant to run [Hz]."""

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 91])
        low, high = KINDS.get(self.hidden, (1.0, 1.0))
        drawn = {
            "strength": math.exp(rng.uniform(math.log(low), math.log(high))),
            "inertia": rng.uniform(0.002, 0.006),
            "resistance_ohm": rng.uniform(3.0, 5.0),
            "torque_nm_per_a": rng.uniform(0.4, 0.55),
            "dry_nm": rng.uniform(0.01, 0.02),
            "arm_kg_per_m": rng.uniform(0.1, 0.25),
            "rate_hz": int(rng.choice([100, 200, 400])),
        }
        drawn["emf_v_s_per_rad"] = drawn["torque_nm_per_a"] * rng.uniform(0.95, 1.05)
        drawn["dry_nm"] *= self.hidden not in ("coulomb_friction", "stribeck_friction")
        for name, value in drawn.items():
            object.__setattr__(self, name, value)

    def numbers(self) -> dict[str, float]:
        """Parameters of the hidden fault for the simulation: ``share`` of the load, ``coulomb`` and ``stick`` [N·m], or ``play``
        [rad]; empty if nothing but the motor's numbers is hidden."""
        return {
            "load_friction": {"share": self.strength},
            "coulomb_friction": {"coulomb": self.strength},
            "stribeck_friction": {"coulomb": self.strength, "stick": self.strength},
            "backlash": {"play": self.strength},
        }.get(self.hidden, {})

    def sheet(self) -> dict[str, float]:
        """Values in the data sheet of the motor: 10 % wrong, and far more if they are the hidden fault.

        Returns:
            ``inertia`` [kg·m²], ``resistance_ohm``, ``torque_nm_per_a``, ``emf_v_s_per_rad``, and dry friction ``dry_nm``.
        """
        rng = np.random.default_rng([self.seed, 92])
        wrong = self.strength if self.hidden == "motor" else 1.0
        factors = wrong ** rng.choice([-1.0, 1.0], 2) * rng.uniform(0.9, 1.1, 2)
        return {
            "inertia": 0.004,
            "resistance_ohm": round(self.resistance_ohm, 2),
            "torque_nm_per_a": round(self.torque_nm_per_a * factors[0], 3),
            "emf_v_s_per_rad": round(self.emf_v_s_per_rad * factors[1], 3),
            "dry_nm": round(self.dry_nm * rng.uniform(0.8, 1.2), 4),
        }


def write(servo: Servo, folder: Path) -> None:
    """Write the files of its user: ``servo.yaml`` and ``swings/`` with tables, ``columns.yaml`` and ``measurements.yaml``.

    Raises:
        TaccorlError: the folder exists.
    """
    if (folder / "swings").exists():
        raise TaccorlError(f"{folder}/swings: already exists; name a new folder")
    swings = folder / "swings"
    swings.mkdir(parents=True)
    (folder / "SIMULATED.txt").write_text(
        f"Everything here is simulated: {ORIGIN}. No servo was near.\n",
        encoding="utf-8",
    )
    (folder / "servo.yaml").write_text(_servo_file(servo), encoding="utf-8")
    (swings / "columns.yaml").write_text(COLUMNS, encoding="utf-8")
    lines = ["columns: columns.yaml", "recordings:"]
    for k, (mass, lever) in enumerate(LOADS):
        for j, gain in enumerate(GAINS):
            name = f"load{k + 1}_p{gain}"
            motion = list(MOTIONS)[(k + j) % len(MOTIONS)]
            held = f"payload_kg: {{servo: {mass}}}, lever_m: {{servo: {lever}}}, arm_kg: {{servo: {_arm_kg(servo, lever):.4f}}}"
            _record(servo, swings / f"{name}.csv", motion, k, gain, 100 * k + j)
            lines.append(
                f"  {name}.csv: {{use: {USES[k]}, {held}, kp: {{servo: {gain}}}}}"
            )
            if (k, j) in REPEATED:
                _record(
                    servo,
                    swings / f"{name}_again.csv",
                    motion,
                    k,
                    gain,
                    100 * k + j + 50,
                )
                lines.append(
                    f"  {name}_again.csv: {{use: {USES[k]}, repeat_of: {name}.csv, {held}, kp: {{servo: {gain}}}}}"
                )
    (swings / "measurements.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


REPEATED = ((2, 0), (4, 1))
"""Load and gain of the recordings that are made twice."""
COLUMNS = """\
time: {column: ms, unit: ms}
domain: surrogate
origin: simulated servo (pipelines.studies.servo)
signals:
  servo:
    q: {column: position, unit: rad, factor: 0.001533980788}      # ticks of 2π / 4096
    q_target: {column: goal, unit: rad, factor: 0.001533980788}
    supply: {column: volts, unit: V, factor: 0.1}
    enabled: {column: torque_enable, unit: "1"}
"""
"""Text of the columns file."""


def _servo_file(servo: Servo) -> str:
    """YAML text of the axis file that the user of the servo would write from the motor's data sheet."""
    sheet = servo.sheet()
    return f"""\
kind: axis
name: servo
unit: rad
law: pwm
inertia: {sheet["inertia"]}              # kg·m² of rotor and gear at the output shaft: a guess, it is fitted
rotor_inertia: {sheet["inertia"]}        # all of it is on the motor's side of the gear
kp: {GAINS[1]}                     # the register, and
kp_factor: {KP_FACTOR:.5f}          # duty per rad of one step of it: 4096 / 2π ticks, / 128 / 885 steps of duty
supply_v: {SUPPLY_V}
resistance_ohm: {sheet["resistance_ohm"]}
torque_nm_per_a: {sheet["torque_nm_per_a"]}     # stall torque over stall current
emf_v_s_per_rad: {sheet["emf_v_s_per_rad"]}     # voltage over no-load speed
hangs_at_rad: 3.14159265    # tick 2048
loop_hz: 1000.0
force_unit_n: 0.1           # about a tenth of the stall torque
""" + (
        f"effects:\n- {{effect: coulomb_friction, torque_nm: {sheet['dry_nm']}}}    # by hand, with the motor off\n"
        if servo.dry_nm
        else ""
    )


def _arm_kg(servo: Servo, lever_m: float) -> float:
    return round(servo.arm_kg_per_m * lever_m, 4)


# the script ------------------------------------------------------------------------------------------------------------


def _chirp(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    active = np.clip(t - 0.3, 0.0, None)
    fade = np.clip(active / 0.4, 0.0, 1.0) * np.clip((5.0 - t) / 0.4, 0.0, 1.0)
    return 0.7 * np.sin(2 * np.pi * (0.2 * active + 0.13 * active**2)) * fade, np.ones(
        len(t)
    )


def _up_and_down(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.interp(
        t, [0.3, 1.9, 2.3, 4.0, 4.4, 5.2], [0.0, 1.5, 1.5, -0.9, -0.9, 0.0]
    ), np.ones(len(t))


def _lift_and_drop(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    goal = np.interp(t, [0.3, 1.3], [0.0, 1.4])
    on = np.where((t > 1.8) & (t < 4.3), 0.0, 1.0)
    return np.where(t > 1.8, np.where(t > 4.8, -0.8, 0.0), goal), on


def _steps(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    levels = np.array([0.0, 0.6, 1.3, 0.9, -0.4, -1.1, -0.5, 0.2])
    return levels[np.clip((t / 0.7).astype(int), 0, len(levels) - 1)], np.ones(len(t))


MOTIONS = {
    "chirp": _chirp,
    "up_and_down": _up_and_down,
    "lift_and_drop": _lift_and_drop,
    "steps": _steps,
}
"""Motions: goal [rad] and whether the torque is enabled, at times [s]; at angle 0 the load hangs down."""
DURATION_S = 5.5
"""Duration of a recording [s]."""


def _record(
    servo: Servo, path: Path, motion: str, load: int, gain: int, seed: int
) -> None:
    rng = np.random.default_rng([servo.seed, 93, seed])
    nominal = np.arange(round(DURATION_S * servo.rate_hz)) / servo.rate_hz
    # A script that sleeps wakes late, now and then by a third of a period.
    times = (
        nominal
        + np.abs(rng.normal(0.0, 0.1, len(nominal))).clip(0.0, 0.35) / servo.rate_hz
    )
    goal, on = MOTIONS[motion](nominal)
    goal_tick = MIDDLE_TICK + np.round(goal / TICK_RAD)
    cycles = np.floor(times / (STEP_S * LOOP_STEPS)).astype(np.int64)
    length = int(cycles[-1]) + 2
    kicks = (
        rng.normal(size=length)
        * DISTURBANCE_SHARE
        * math.sqrt(1 - math.exp(-2 * 1e-3 / 0.05))
    )
    mass, lever = LOADS[load]
    arm = _arm_kg(servo, lever)
    h = servo.numbers()
    tick, volts = _swing(
        cycles,
        goal_tick,
        on,
        kicks,
        np.array(
            [
                servo.inertia,
                servo.torque_nm_per_a,
                servo.emf_v_s_per_rad,
                servo.resistance_ohm,
            ]
        ),
        np.array(
            [mass * lever**2 + arm * lever**2 / 3, (mass + arm / 2) * lever * GRAVITY]
        ),
        np.array(
            [
                h.get("coulomb", servo.dry_nm),
                *(h.get(key, 0.0) for key in ("stick", "share", "play")),
            ]
        ),
        float(gain),
    )
    lines = [
        "# domain: surrogate",
        f"# origin: {ORIGIN}",
        "ms,goal,position,volts,torque_enable",
    ]
    for t, goal_k, position, volt, enabled in zip(
        times, goal_tick, tick, volts, on, strict=True
    ):
        lines.append(
            f"{1e3 * t:.2f},{goal_k:.0f},{position:.0f},{10 * volt:.0f},{enabled:.0f}"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


STICK_RAD_PER_S, PLAY_NM_PER_RAD, PLAY_DAMPING_S = 0.1, 300.0, 2e-4
"""Speed of Stribeck's curve; stiffness of the ends of the play, and its damping over that."""


@numba.njit(cache=True)
def _swing(
    cycles: np.ndarray,
    goals: np.ndarray,
    on: np.ndarray,
    kicks: np.ndarray,
    motor: np.ndarray,
    load: np.ndarray,
    hidden: np.ndarray,
    gain: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Readings of position [ticks] and supply [V] in the loop's cycles in which the script reads, before its goal is in force."""
    inertia, k_t, k_e, ohm = motor
    mounted, weight = load
    coulomb, stick, share, play = hidden
    ticks, volts = np.empty(len(cycles)), np.empty(len(cycles))
    q, v, link, link_v = 0.0, 0.0, 0.0, 0.0
    duty, current, noise, row, goal, enabled = 0.0, 0.0, 0.0, 0, goals[0], on[0]
    for cycle in range(cycles[-1] + 1):
        noise = math.exp(-1e-3 / 0.05) * noise + kicks[cycle]
        supply = SUPPLY_V - SOURCE_OHM * abs(current * duty)
        seen = MIDDLE_TICK + math.floor(q / TICK_RAD + 0.5)
        if row > 0:  # what the script wrote is in force from the next cycle on
            goal, enabled = goals[row - 1], on[row - 1]
        while row < len(cycles) and cycles[row] == cycle:
            ticks[row], volts[row] = seen, supply
            row += 1
        steps = gain * (goal - seen) / 128.0
        duty = (
            math.copysign(min(math.floor(abs(steps)), DUTY_STEPS), steps) / DUTY_STEPS
        )
        for _ in range(LOOP_STEPS):
            current = (supply * duty - k_e * v) / ohm if enabled > 0.0 else 0.0
            torque = k_t * current
            if play > 0.0:
                deep = link - q
                deep -= min(max(deep, -0.5 * play), 0.5 * play)
                passed = 0.0
                if deep != 0.0:
                    passed = PLAY_NM_PER_RAD * (deep + PLAY_DAMPING_S * (link_v - v))
                    if passed * deep < 0.0:
                        passed = 0.0
                link_v += STEP_S * (-weight * math.sin(link) - passed) / mounted
                link += STEP_S * link_v
                outer, moved = passed, inertia
            else:
                outer, moved = -weight * math.sin(q), inertia + mounted
            limit = (
                coulomb
                + stick * math.exp(-((v / STICK_RAD_PER_S) ** 2))
                + share * abs(torque - outer)
            )
            free = (
                v
                + STEP_S * (torque + outer + noise * (abs(torque) + abs(outer))) / moved
            )
            stops = STEP_S * limit / moved
            v = 0.0 if abs(free) <= stops else free - math.copysign(stops, free)
            q += STEP_S * v
    return ticks, volts


def main(argv: Sequence[str]) -> int:
    """Command line ``python -m pipelines.studies.servo my_servo``: write the example, whose hidden fault is load-dependent
    friction. Returns the exit status 0."""
    servo = Servo(seed=3, hidden="load_friction")
    write(servo, Path(argv[0]))
    print(
        f"wrote {argv[0]}: servo.yaml and swings/ of a pendulum; simulated, not measured on a servo. Hidden: load_friction of "
        f"{servo.strength:.3f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
