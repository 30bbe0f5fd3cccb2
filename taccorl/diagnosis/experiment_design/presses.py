"""Choose the press to record next: a library of presses of an arm's pads, scored by how well each separates rivals.

    press_hold_release   a ball to three depths at two speeds: k_n, k_d, the law
    deep_presses         to 1.6 mm: saturation, nonlinear law
    slow_ramp            up and down with inner loops: hysteresis
    long_hold            8 s, and 5 s of nothing after its release: creep
    quick_taps           a dozen of 0.06 s: delay, lag
    light_touches        0.05 to 0.3 mm: thresholds, position of the pad's surface
    rod_across           a line over all columns: gains, crosstalk, a shifted pad
    rests                10 s of nothing before and after one press: a drifting zero

The object is a ball or a rod of known size at a known pose in the hand. A press is an opening over time; the commanded opening
is smaller, because the gripper yields to the pads' springs. Limits: the gripper's range, the fingers' speed, the pads' travel.

Letters in shapes: T rows or frames, P pads, R × C taxels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement, Touch
from taccorl.alignment.measurements.motions import RATE_HZ, REST_POSE
from taccorl.alignment.measurements.presses import AWAY_M, FRAME_S, Press, pad_presses
from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import TouchMotion, touch_motion
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.replays import matched_contact
from taccorl.diagnosis.experiment_design.plan import Explanation, Part, Planned, Scene
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.pads import part_of, presses
from taccorl.diagnosis.problems.touch_problem import FRAMES_A_ROW, TouchProblem
from taccorl.diagnosis.search.problem import Problem, Recording, Values
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect, TouchEffect
from taccorl.sim.effects.pads import TaxelGainMap
from taccorl.sim.robot import RobotConfig
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig

FINGER_SPEED_M_PER_S = 0.05
"""Highest speed of each finger [m/s]: a choice, no rating is published."""
GAIN_SPREAD = 0.1
"""Standard deviation of the taxels' gains for a gain map that is not known: a choice."""

_LOOPS = (
    (2.5, AWAY_M),
    (6.0, 9e-4),
    (7.5, 4.5e-4),
    (9.0, 1e-3),
    (11.0, 2e-4),
    (13.0, 7e-4),
    (15.0, AWAY_M),
)
LIBRARY = (
    Press(
        name="press_hold_release",
        knots=pad_presses((3e-4, 6e-4, 1e-3), (0.12, 0.6), 0.8),
    ),
    Press(name="deep_presses", knots=pad_presses((4e-4, 1e-3, 1.6e-3), (0.4,), 0.6)),
    Press(name="slow_ramp", knots=((0.0, AWAY_M), *_LOOPS, (17.5, AWAY_M))),
    Press(name="long_hold", knots=pad_presses((8e-4,), (0.3,), 8.0, after_s=5.0)),
    Press(
        name="quick_taps", knots=pad_presses((1e-3,) * 12, (0.06,), 0.08, between_s=0.3)
    ),
    Press(
        name="light_touches", knots=pad_presses((5e-5, 1e-4, 2e-4, 3e-4), (0.8,), 0.5)
    ),
    Press(
        name="rod_across",
        knots=pad_presses((3e-4, 7e-4), (0.15, 0.6), 0.6),
        shape="rod",
        x_m=0.0,
        z_m=0.012,
    ),
    Press(
        name="rests",
        knots=pad_presses((6e-4,), (0.3,), 0.8, before_s=10.0, after_s=10.0),
    ),
)
"""Presses from which ``taccorl excite --pads`` chooses."""


class PadsPart(Part):
    """The pads of one arm.

    Args:
        measurements: existing recordings; those that state what these pads pressed are used, and their noise is the floor.
            Without any, the floor is the twin's own sensor noise.

    Raises:
        TaccorlError: there is no such arm, no recording states what these pads pressed, or the sensor is not FlexiTac.
    """

    rate_hz = RATE_HZ

    def __init__(
        self, config: TwinConfig, arm: str, measurements: Measurements | None = None
    ) -> None:
        if arm not in ROBOT.arms:
            raise TaccorlError(f"no pads of an arm {arm!r}; {nearest(arm, ROBOT.arms)}")
        self.machine, self.name, self.library = PiperTwin(config), part_of(arm), LIBRARY
        self._config, self.arm, self._known = (
            config,
            arm,
            _known(config, arm, measurements),
        )
        self._floors = (
            TouchProblem(self._known, config).floor_count
            if self._known
            else _sensor_floor(config)
        )
        self.floor = float(np.median(self._floors))

    def offer(self, item: Press, suspected: Mapping[str, Explanation]) -> Planned:
        force, target = grip(self._config.robot, item)
        if refusal := _refusal(self._config.robot, item, target):
            raise TaccorlError(refusal)
        names = f"{self.arm}_gripper.q_target", f"{self.arm}_gripper.opening"
        columns = dict(zip(names, (target, item.opening_m()), strict=True))
        made = imagined_press(self._config, self.arm, item)
        return Planned(
            part=self, item=item, columns=columns, peak=float(force.max()), made=made
        )

    def scene(self, p: Planned) -> Scene:
        problem = TouchProblem([*self._known, p.made], self._config)
        problem.floor_count = np.broadcast_to(self._floors, problem.floor_count.shape)
        return PressScene(problem, self._known, p.made, TouchModel(self._config))


class PressScene(Scene):
    """A press that could be made, beside existing ones. Taxels count that would read something if either of two rivals were true:
    those beside the object, too."""

    problem: TouchProblem

    def __init__(
        self,
        problem: TouchProblem,
        known: Sequence[TouchMotion],
        plain: TouchMotion,
        model: TouchModel,
    ) -> None:
        super().__init__(problem, [problem.recording(m) for m in known])
        self._plain, self._model, self._still = plain, model, _said(model, plain)

    def told(
        self, rivals: Sequence[str], fitted: Mapping[str, Values]
    ) -> dict[str, Explanation]:
        """As of any scene; a gain map has no typical one: some gains are drawn."""
        for name in rivals:
            if not issubclass(registry.get(name), TouchEffect):
                raise TaccorlError(
                    f"{name} is not an effect of pads: their readings of a known object would not show it"
                )
            if name not in self.problem.candidates:
                raise TaccorlError(
                    f"{name} has no parameters that can be fitted to readings of pads; these effects have: "
                    f"{', '.join(self.problem.candidates)}"
                )
        found = super().told(rivals, fitted)
        for name, e in found.items():
            if isinstance(e.effect, TaxelGainMap):
                spread = np.random.default_rng(0).standard_normal(
                    (len(self.problem.pads), *ROBOT.pad.shape)
                )
                drawn = TaxelGainMap.of(
                    np.clip(1.0 + GAIN_SPREAD * spread, 0.0, None), self.problem.pads
                )
                found[name] = e._replace(effect=drawn)
        return found

    def said(
        self, truth: Explanation, other: Explanation, effects: Sequence[Effect]
    ) -> tuple[Problem, Sequence[Recording]]:
        louder = [
            np.abs(_said(self._model, self._plain, [e.effect], e.values) - self._still)
            for e in (truth, other)
        ]
        seen = dataclasses.replace(
            self._plain, measured=self._plain.measured + np.maximum(*louder)
        )
        recordings = [*self.recordings, self.problem.recording(seen)]
        return self.problem, [
            dataclasses.replace(
                r, measured=self.problem.simulate(truth.values, effects, r)
            )
            for r in recordings
        ]


def grip(robot: RobotConfig, press: Press) -> tuple[np.ndarray, np.ndarray]:
    """Force (T,) on each pad [N] and opening (T,) to command [m] at 200 Hz for a press: u = o − F / k_grip with F = K δ, at rest.

    For rigid pads the force is not known: it is 0, and commands equal openings.
    """
    stiffness = robot.pad_stiffness_n_per_m if robot.pads == "sprung" else 0.0
    force = stiffness * np.maximum(press.penetration_m(), 0.0)
    return force, press.opening_m() - force / robot.grip_stiffness_n_per_m


def travel_m(robot: RobotConfig) -> float:
    """Largest depth to which a pad can be pressed [m], limited by the gripper's force and the rubber's thickness."""
    return min(
        ROBOT.pad_thickness_m,
        robot.grip_force_max_n / robot.pad_stiffness_n_per_m
        if robot.pads == "sprung"
        else np.inf,
    )


def _refusal(robot: RobotConfig, press: Press, target_m: np.ndarray) -> str:
    """Why it must not be recorded; empty if it may."""
    deepest, opening = float(press.penetration_m().max()), press.opening_m()
    fastest = float(np.abs(np.diff(opening)).max()) * RATE_HZ / 2
    if deepest > travel_m(robot) + 1e-9:
        return f"goes {1e3 * deepest:.2f} mm deep, the pads' travel is {1e3 * travel_m(robot):.2f} mm"
    if min(target_m.min(), opening.min()) < 0 or opening.max() > ROBOT.opening_max_m:
        return (
            f"needs commands of {1e3 * target_m.min():.1f} … {1e3 * target_m.max():.1f} mm, the gripper takes "
            f"0 … {1e3 * ROBOT.opening_max_m:g} mm"
        )
    if fastest > FINGER_SPEED_M_PER_S:
        return f"moves each finger at {1e3 * fastest:.0f} mm/s of {1e3 * FINGER_SPEED_M_PER_S:g}"
    return ""


def imagined_press(config: TwinConfig, arm: str, press: Press) -> TouchMotion:
    """Matched contact replay of a press with counts that the twin gives, with noise, in place of a recording that does not
    exist yet."""
    opening = press.opening_m()
    time_s = np.arange(len(opening)) / RATE_HZ
    target = np.tile(
        [*REST_POSE, ROBOT.opening_max_m] * len(ROBOT.arms), (len(opening), 1)
    )
    target[:, ROBOT.gripper_index(arm)] = opening
    stamps = np.arange(2 * FRAME_S, time_s[-1], FRAME_S)
    num_taxels = ROBOT.num_taxels
    sensor = _flexitac(config)
    touch = Touch(
        time_s=np.tile(stamps[:, None], (1, len(ROBOT.pads))),
        counts=np.zeros((len(stamps), num_taxels), np.int16),
        baseline=np.full(num_taxels, np.mean(sensor.resting_count)),
    )
    pressed = press.pressed(arm).made()
    m = Measurement(
        name=press.name,
        time_s=time_s,
        target=target,
        measured=target.copy(),
        touch=touch,
        pressed=pressed,
        origin=Origin("twin", "imagined: the twin's own answer"),
    )
    motion = touch_motion(m, config, pressed)
    counts = _said(TouchModel(config), motion)
    counts += sensor.noise_std_count * np.random.default_rng(0).standard_normal(
        counts.shape
    )
    return dataclasses.replace(motion, measured=np.round(counts).astype(np.int16))


def _said(
    model: TouchModel,
    motion: TouchMotion,
    effects: Sequence[Effect] = (),
    base: Values | None = None,
) -> np.ndarray:
    """(T, P, R, C) counts above baseline without noise, of the twin's own k_n and k_d where ``base`` has none."""
    sensor, base = model.sensor, base or {}
    k_n, k_d = (
        base.get("k_n", sensor.normal_stiffness_per_m),
        base.get("k_d", sensor.normal_damping_s_per_m),
    )
    return model.counts(motion, model.simulate(motion, k_n, k_d, effects))


def _known(
    config: TwinConfig, arm: str, measurements: Measurements | None
) -> list[TouchMotion]:
    """Matched contact replays of the recordings that say what these pads pressed."""
    if measurements is None:
        return []
    found = [
        matched_contact(m, config, m.pressed)
        for m in measurements.fit
        if presses(m, arm, config) and m.pressed is not None
    ]
    if not found:
        raise TaccorlError(
            f"{part_of(arm)}: no fit recording states what the pads pressed; state `pressed` in measurements.yaml, or remove "
            "--measurements"
        )
    return found


def _sensor_floor(config: TwinConfig) -> np.ndarray:
    """Counts of a row: the twin's noise and the converter's step, in the mean over its frames; at least rounding."""
    rounding = 1 / math.sqrt(12)
    return np.array(
        max(
            math.hypot(_flexitac(config).noise_std_count, rounding)
            / math.sqrt(FRAMES_A_ROW),
            rounding,
        )
    )


def _flexitac(config: TwinConfig) -> FlexiTacConfig:
    return TouchModel(config).sensor
