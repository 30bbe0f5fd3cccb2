"""Whether the 95 % interval of a fitted command delay holds the true delay if rows come at 30 Hz. The recordings are of a joint
that this file integrates itself, in steps of 1/6000 s.

A joint of 0.0435 kg·m² follows targets of 30 Hz that arrive 1.5 to 2.1 rows late: 0.0435 q̈ = 17.8 (q*(t − d) − q) − 0.6 q̇ −
0.052 sign q̇. Its positions and targets are in steps of an encoder of 4096 counts a turn.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from simulated_slide import robot_machine

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import fit, moved_by, over_own_scale
from taccorl.diagnosis.search.identifiable import absolute_numbers

ROW_HZ, STEPS, ROWS, RECORDINGS, SEEDS = 30, 200, 480, 5, 10
STEP_S = 1.0 / (ROW_HZ * STEPS)
INERTIA, KP, DAMPING, FRICTION = 0.0435, 17.8, 0.6, 0.052
COUNT = 2 * np.pi / 4096
ROBOT = f"""kind: robot
model: arm.xml
joints:
  swing: {{kp: {KP}, kd: 0.0, effects: [{{effect: viscous_friction, damping_nms_per_rad: {DAMPING}}},
    {{effect: coulomb_friction, torque_nm: {FRICTION}}}]}}
"""
MODEL = f"""<mujoco><compiler angle="radian"/><worldbody><body><joint name="swing" axis="0 0 1" range="-3 3"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.03 0.03 {INERTIA}"/></body></worldbody></mujoco>"""


def targets(rng: np.random.Generator) -> np.ndarray:
    """(ROWS,) rad: motions between points at up to 1.9 rad/s and pauses, as somebody who demonstrates makes them."""
    q, rows = 0.0, []
    while len(rows) < ROWS:
        count = int(rng.uniform(0.7, 2.2) * ROW_HZ)
        goal = np.clip(rng.uniform(-1, 1), q - count / ROW_HZ, q + count / ROW_HZ)
        s = np.arange(1, count + 1) / count
        rows += [
            *(q + (goal - q) * s**3 * (10 - 15 * s + 6 * s * s)),
            *[goal] * int(rng.uniform(0, 1.5) * ROW_HZ),
        ]
        q = goal
    return np.round(np.array(rows[:ROWS]) / COUNT) * COUNT


def simulated(sent: np.ndarray, late: np.ndarray, row_steps: int) -> np.ndarray:
    """(n, ROWS) positions [rad] of joints that get ``sent`` (n, ROWS) ``late`` (n,) steps late; row k is before its command.
    A row lasts ``row_steps`` steps."""
    q, v, every = sent[:, 0].copy(), np.zeros(len(sent)), np.arange(len(sent))
    seen = np.empty_like(sent)
    for step in range(ROWS * row_steps):
        if step % row_steps == 0:
            seen[:, step // row_steps] = q
        goal = sent[every, np.maximum(step - late, 0) // row_steps]
        free = v + STEP_S * (KP * (goal - q) - DAMPING * v) / INERTIA
        after = np.sign(free) * np.maximum(
            np.abs(free) - STEP_S * FRICTION / INERTIA, 0.0
        )
        q += 0.5 * STEP_S * (v + after)
        v = after
    return seen


def fitted_delays(folder: Path, row_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """(SEEDS,) true delays and (SEEDS, 3) fitted ones with the ends of their intervals [s], by the recordings' own clock. Rows
    are stamped as if each lasted STEPS steps."""
    robot, rng = robot_machine(folder, MODEL, ROBOT).robot, np.random.default_rng(14)
    late = rng.integers(300, 420, SEEDS)
    sent = np.stack([targets(rng) for _ in range(SEEDS * RECORDINGS)])
    seen = simulated(sent, np.repeat(late, RECORDINGS), row_steps)
    seen = np.round((seen + 0.3 * COUNT * rng.normal(size=seen.shape)) / COUNT) * COUNT
    delays = []
    for k in range(SEEDS):
        every = [
            of_signal(f"row {n}", ROW_HZ, sent[n], seen[n], "swing")
            for n in range(k * RECORDINGS, (k + 1) * RECORDINGS)
        ]
        problem = JointProblem(
            robot, "swing", Measurements(tuple(every[:3]), tuple(every[3:]))
        )
        names = (*problem.present, "command_delay")
        starts = {f.name: f.start for f in problem.candidates["command_delay"].frees}
        found, steps = over_own_scale(
            problem,
            fit(problem, problem.fit, names, problem.start | starts, 60),
            problem.fit,
        )
        found = dataclasses.replace(
            found,
            moved=moved_by(problem, found, problem.fit, problem.validation, steps),
        )
        stated = {
            n.name: n
            for n in absolute_numbers(
                found, inertia_kgm2=problem.inertia_kgm2, pinned=True, kd=0.0
            )
        }
        delay = stated["command_delay.delay_s"]
        delays.append((delay.value, delay.low, delay.high))
    return late * STEP_S * STEPS / row_steps, np.array(delays)


@pytest.mark.slow
def test_the_interval_of_a_delay_at_30_hz_holds_the_truth(tmp_path: Path) -> None:
    """Nine of ten: of ten intervals of 95 % fewer hold the truth in 9 % of tries. The upper half, which no unknown age of the
    positions widens, is below 1.2 ms on average, 4 % of a row (times of the loop that may move are in it): an interval that
    holds everything says nothing."""
    truth_s, delays = fitted_delays(tmp_path, STEPS)
    value, low, high = delays.T
    print(summary(truth_s, delays))
    assert (
        sum((low <= truth_s) & (truth_s <= high)) >= 9
        and np.mean(high - value) < 1.2e-3
    )


@pytest.mark.slow
def test_rows_that_last_longer_than_their_stamps_say_make_a_delay_too_short(
    tmp_path: Path,
) -> None:
    """A limit, not a promise (docs/limits.md): rows of 33.5 ms that are stamped 33.33 ms. The motion then looks faster than the
    known inertia allows, and a shorter delay takes up a part of that."""
    truth_s, delays = fitted_delays(tmp_path, STEPS + 1)
    print(summary(truth_s, delays))
    assert -1.5e-3 < np.mean(delays[:, 0] - truth_s) < -0.3e-3


def summary(truth_s: np.ndarray, delays: np.ndarray) -> str:
    """The figures of docs/limits.md (``pytest -s``)."""
    error, (_, low, high) = 1e3 * (delays[:, 0] - truth_s), delays.T
    held = sum((low <= truth_s) & (truth_s <= high))
    return f"{held} of {SEEDS} intervals hold the truth; error {error.mean():.2f} ms, s.d. {error.std(ddof=1):.2f} ms"
