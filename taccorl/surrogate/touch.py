"""Surrogate pads: a known object between the fingers is pressed, held and released; hidden effects act at 1 kHz.

    f = [k_n δ + k_d δ̇]₊ where δ > 0 → material → scan → wires → gains → counts, noise, converter

Depths come from the indenter's geometry in closed form, with an unreported error of the opening of some 8 µm.
The protocol is a press–hold–release pack: three depths at two speeds with 10 s of nothing before and after, a slow ramp with
inner loops and a hold of 4 s, a rod across the pads, on several places. Nothing slides: in the hand a known object keeps its
place, and on the bench 0.2 mrad of the joints would be 0.1 mm.

Letters in shapes: M milliseconds, T frames, K taxels near the object, P = 2 pads, R × C taxels.
"""

import dataclasses
import math
import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement, Touch
from taccorl.alignment.measurements.motions import RATE_HZ, REST_POSE
from taccorl.alignment.measurements.presses import (
    AWAY_M,
    FRAME_S,
    RADIUS_M,
    Knots,
    Press,
    pad_presses,
)
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate.cases import find_severity
from taccorl.surrogate.hidden import Hidden, hidden_in, within_bounds
from taccorl.surrogate.recordings import ORIGIN
from taccorl.surrogate.touch_hidden import (
    EXACT_TOUCH,
    MILLISECOND,
    board,
    material,
    spread,
    touch_kind,
)

NOISE_COUNT, MAX_COUNT, RESTING_COUNT = 1.3, 255, (10, 40)
"""Noise of a taxel, upper end of the converter, and range of the resting counts [counts]."""
ROOM_ERROR_M, ROOM_ERROR_S = 8e-6, 0.5
"""Standard deviation of the true depth from that of the reported opening [m], and the time constant of its change [s]."""
OPENING_NOISE_M, OPENING_QUANTUM_M = (
    2e-6,
    1e-6,
)  # Noise and step of the reported opening [m]
K_N_PER_M, K_D_S = (
    (600.0, 2000.0),
    (0.002, 0.02),
)  # Range of k_n [reading per m], and of k_d / k_n [s]
SEVERITY_FLOORS = (
    1.5,
    15.0,
)  # Range from which the strength of a hidden effect is drawn [floors]
COUNTS = 75.0  # per reading of 1
FRAMES_A_ROW = (
    5  # of the problem that judges: its floor is counted in means over so many
)
_NEAR_M = 1.2e-3  # taxels that stay further off take no part


def _ramp(peaks_m: tuple[float, float, float], hold_s: float) -> Knots:
    """Up and down with inner loops, then a hold."""
    one, two, three = peaks_m
    way = [
        (0.0, AWAY_M),
        (2.5, AWAY_M),
        (6.0, one),
        (7.5, 0.5 * one),
        (9.0, two),
        (11.0, 0.2 * two),
        (13.0, 0.7 * two),
    ]
    way += [
        (15.0, AWAY_M),
        (16.0, AWAY_M),
        (16.5, three),
        (16.5 + hold_s, three),
        (17.0 + hold_s, AWAY_M),
    ]
    return (*way, (19.5 + hold_s, AWAY_M))


_TASK = (
    (0, AWAY_M),
    (2.5, AWAY_M),
    (2.9, 6.5e-4),
    (7, 7e-4),
    (7.2, AWAY_M),
    (8.5, AWAY_M),
    (8.8, 9.5e-4),
)
_TASK_END = ((14.0, 5e-4), (14.3, AWAY_M), (16.5, AWAY_M))
_PRESS = Press(
    name="press",
    knots=pad_presses(
        (3e-4, 6e-4, 1e-3), (0.12, 0.6), 0.8, before_s=10.0, after_s=10.0
    ),
)
FIT = (
    _PRESS,
    dataclasses.replace(_PRESS, name="press_again", repeat_of="press"),
    Press(
        name="ramp_and_hold",
        knots=_ramp((9e-4, 1e-3, 8e-4), 4.0),
        x_m=-0.004,
        z_m=-0.010,
    ),
    Press(
        name="rod",
        knots=pad_presses((3e-4, 7e-4), (0.15, 0.6), 0.6),
        shape="rod",
        x_m=0.0,
        z_m=0.012,
    ),
)
# Near to places that were fitted to: what is known of a taxel counts, and not how many of them were never pressed.
VALIDATION = (
    Press(
        name="held_press",
        knots=pad_presses((9e-4, 4e-4, 7e-4), (0.1, 0.5), 0.6),
        x_m=0.0,
        z_m=0.002,
    ),
    Press(
        name="held_ramp", knots=_ramp((7e-4, 9e-4, 6e-4), 3.0), x_m=-0.0035, z_m=-0.0095
    ),
)
TEST = (
    Press(
        name="test_task",
        knots=(*_TASK, *_TASK_END),
        x_m=0.0015,
        z_m=0.0035,
        wiggle_m=5e-5,
    ),
)


@dataclass(frozen=True)
class TouchCase:
    """Surrogate pads of one arm with their hidden effects."""

    seed: int  # Seed of everything that is drawn
    arm: str  # Name of the arm
    k_n: float  # True k_n [reading per m]
    k_d: float  # True k_d [reading per m/s]
    hidden: tuple[Hidden, ...]  # The hidden effects; empty if there are none
    twin: TwinConfig  # Twin of the user, with wrong k_n and k_d
    left_floors: float = 0.0  # Error on press and ramp after a refit of k_n, k_d and zero, in floors of a 50 ms row

    @property
    def name(self) -> str:
        """Text for tables: hidden effects, arm and seed."""
        return f"{'+'.join(h.name for h in self.hidden) or 'none'} on the {self.arm} pads, seed {self.seed}"

    @property
    def pads(self) -> list[str]:
        """Names of the arm's two pads."""
        return [f"{self.arm}_{finger}" for finger in ROBOT.fingers]

    def truth(self) -> dict[str, object]:
        """The true values as JSON values, for the sealed file: ``hidden`` (a dict per effect), ``k_n_per_m``, ``k_d_s_per_m``,
        …"""
        return {
            "seed": self.seed,
            "arm": self.arm,
            "hidden": [dataclasses.asdict(h) for h in self.hidden],
            "k_n_per_m": self.k_n,
            "k_d_s_per_m": self.k_d,
            "left_floors": self.left_floors,
        }

    @cached_property
    def resting(self) -> np.ndarray:
        """(4, R, C) resting counts of all pads, in the order of ``ROBOT.pads``."""
        low, high = RESTING_COUNT
        return np.random.default_rng([self.seed, 77]).uniform(
            low, high, (len(ROBOT.pads), *ROBOT.pad.shape)
        )


def draw_touch_case(
    effect_names: tuple[str, ...] | list[str],
    seed: int,
    *,
    arm: str | None = None,
    strength: float | None = None,
) -> TouchCase:
    """Draw pads with these hidden effects.

    Args:
        effect_names: names in ``touch_hidden.TOUCH_KINDS``.
        arm: left or right; drawn if not given.
        strength: error that each causes on the press [floors]; drawn from 1.5 to 15 if not given.

    Raises TaccorlError: there is no hidden effect of that name."""
    kinds = [touch_kind(name) for name in effect_names]
    rng = np.random.default_rng([seed, zlib.crc32("+".join(effect_names).encode()), 3])
    arm = str(rng.choice(ROBOT.arms)) if arm is None else arm
    k_n = float(np.exp(rng.uniform(*np.log(K_N_PER_M))))
    k_d = k_n * float(rng.uniform(*K_D_S))
    wrong = np.exp(rng.uniform(-1, 1, 2) * np.log([2.0, 3.0]))
    sensor = FlexiTacConfig(
        normal_stiffness_per_m=k_n * float(wrong[0]),
        normal_damping_s_per_m=k_d * float(wrong[1]),
    )
    case = TouchCase(
        seed=seed, arm=arm, k_n=k_n, k_d=k_d, hidden=(), twin=TwinConfig(sensor=sensor)
    )
    hidden: list[Hidden] = []
    for name, k in zip(effect_names, kinds, strict=True):
        low, high = np.log(SEVERITY_FLOORS)
        wanted = math.exp(rng.uniform(low, high)) if strength is None else strength
        dice = int(rng.integers(2**32))

        def of(severity: float, name=name, k=k, dice=dice) -> Hidden:
            values = k.values(severity, np.random.default_rng(dice))
            values = within_bounds(name, values) if k.registered else values
            where = {"pads": case.pads} if k.registered else {}
            return Hidden(
                name=name,
                values=values,
                severity=severity,
                registered=k.registered,
                selectors=where,
            )

        def left(severity: float, of=of) -> float:
            return _left_floors(dataclasses.replace(case, hidden=(of(severity),)))

        hidden.append(of(find_severity(wanted, k.severity, left)))
    case = dataclasses.replace(case, hidden=tuple(hidden))
    return dataclasses.replace(case, left_floors=_left_floors(case) if hidden else 0.0)


def touch_case_of(config: TwinConfig, seed: int, arm: str | None = None) -> TouchCase:
    """The pads of an arm of the robot that ``config`` describes, with its k_n, k_d and effects. Their user starts from the
    nominal twin. Raises TaccorlError: another kind of sensor, or as ``hidden_in``."""
    plain, sensor = draw_touch_case((), seed, arm=arm), config.sensor
    if not isinstance(sensor, FlexiTacConfig):
        raise TaccorlError(
            f"sensor: {type(sensor).__name__}; surrogate pads are those of FlexiTac"
        )
    gain, hidden = (
        sensor.gain_count / COUNTS,
        hidden_in(config, plain.pads, EXACT_TOUCH),
    )
    k_n, k_d = (
        gain * sensor.normal_stiffness_per_m,
        gain * sensor.normal_damping_s_per_m,
    )
    return dataclasses.replace(
        plain, k_n=k_n, k_d=k_d, hidden=hidden, twin=TwinConfig()
    )


def touch_recordings(case: TouchCase) -> Measurements:
    """Simulate all recordings of these pads. The same case gives the same numbers, bit for bit."""
    fit, validation, test = (
        tuple(record_touch(case, press) for press in presses)
        for presses in _USES.values()
    )
    return Measurements(fit, validation, test)


def pressed_notes(case: TouchCase) -> dict[str, dict[str, Any]]:
    """Name of a recording → its entry ``pressed`` of measurements.yaml."""
    return {
        press.name: press.pressed(case.arm).entry()
        for presses in _USES.values()
        for press in presses
    }


_USES = {"fit": FIT, "validation": VALIDATION, "test": TEST}


def record_touch(case: TouchCase, press: Press) -> Measurement:
    """Simulate one recording of the press: joints and openings at 200 Hz, frames of the pads at 100 Hz."""
    rng = np.random.default_rng(
        [case.seed, zlib.crc32(case.name.encode()), zlib.crc32(press.name.encode())]
    )
    time_s, depth_m = _penetration(press)
    knots = np.arange(-ROOM_ERROR_S, time_s[-1] + 2 * ROOM_ERROR_S, ROOM_ERROR_S)
    error_m = ROOM_ERROR_M * np.interp(time_s, knots, rng.standard_normal(len(knots)))
    stamps = np.arange(0.02, time_s[-1] - 0.02, FRAME_S)
    reading = _readings(case, press, time_s, depth_m + error_m, stamps)
    counts = (
        COUNTS * reading
        + case.resting
        + NOISE_COUNT * rng.standard_normal(reading.shape)
    )
    wire = np.clip(np.floor(counts), 0, MAX_COUNT)
    baseline = np.floor(np.median(wire[: round(1.0 / FRAME_S)], axis=0))
    rows = time_s[:: round(1e3 / RATE_HZ)]
    opening = 2 * (RADIUS_M[press.shape] - depth_m[:: round(1e3 / RATE_HZ)])
    target = np.tile([*REST_POSE, 0.05] * len(ROBOT.arms), (len(rows), 1))
    gripper = ROBOT.gripper_index(case.arm)
    target[:, gripper] = opening
    measured = target.copy()
    noisy = opening + OPENING_NOISE_M * rng.standard_normal(len(rows))
    measured[:, gripper] = np.round(noisy / OPENING_QUANTUM_M) * OPENING_QUANTUM_M
    return Measurement(
        name=press.name,
        time_s=rows,
        target=target,
        measured=measured,
        touch=Touch(
            time_s=np.tile(stamps[:, None], (1, len(ROBOT.pads))),
            counts=(wire - baseline).reshape(len(stamps), -1).astype(np.int16),
            baseline=baseline.ravel(),
        ),
        origin=Origin("surrogate", f"{ORIGIN}; {case.arm} pads"),
        instruction=f"press a {press.shape}: {press.name}",
        repeat_of=press.repeat_of,
        pressed=press.pressed(case.arm).made(),
    )


def _penetration(press: Press) -> tuple[np.ndarray, np.ndarray]:
    """(M,) s and m; corners rounded over 60 ms, as a finger of some inertia does."""
    depth = press.penetration_m(1 / MILLISECOND, 61)
    return np.arange(len(depth)) * MILLISECOND, depth


def _depth(
    case: TouchCase, press: Press, side: float, penetration_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Signed depths (M, K) of a pad's taxels that come near, and their flat numbers (K,)."""
    place = {
        k: v
        for h in case.hidden
        if touch_kind(h.name).stage == "place"
        for k, v in h.values.items()
    }
    radius = RADIUS_M[press.shape]
    x, y = ROBOT.pad.taxel_axes_m()
    y = y + place.get("along_m", 0.0)
    # A pad's x runs along the TCP's on finger a and against it on finger b; its y runs to the tips.
    across = (side * x + place.get("across_m", 0.0) - press.x_m) * (
        press.shape == "sphere"
    )
    beside = (across[None, :] ** 2 + (y[:, None] - press.z_m) ** 2).ravel()
    out = radius - penetration_m - place.get("offset_m", 0.0)
    near = np.flatnonzero(radius - np.sqrt(beside + out.min() ** 2) > -_NEAR_M)
    return radius - np.sqrt(beside[near] + out[:, None] ** 2), near


def _readings(
    case: TouchCase,
    press: Press,
    time_s: np.ndarray,
    penetration_m: np.ndarray,
    stamps: np.ndarray,
) -> np.ndarray:
    """(T, 4, R, C) before gain and noise."""
    rows, columns = ROBOT.pad.shape
    frames = np.zeros((len(stamps), len(ROBOT.pads), rows, columns))
    for finger, side in zip(ROBOT.fingers, (1.0, -1.0), strict=True):
        depth, near = _depth(case, press, side, penetration_m)
        rate = np.gradient(depth, MILLISECOND, axis=0)
        reading = np.where(
            depth > 0, np.maximum(case.k_n * depth + case.k_d * rate, 0.0), 0.0
        )
        for h in case.hidden:
            if touch_kind(h.name).stage == "material":
                reading = material(h.name, h.values, reading, rate)
        # A column of the pad is a row of the wire: it is read at its own share of the scan, before the stamp.
        read_s = stamps[:, None] + ((near % columns + 0.5) / columns - 1) * FRAME_S
        at = read_s / MILLISECOND
        before = np.clip(np.floor(at).astype(int), 0, len(time_s) - 2)
        taxel, share = np.arange(len(near)), at - before
        pad = np.zeros((len(stamps), rows * columns))
        pad[:, near] = (
            reading[before, taxel] * (1 - share) + reading[before + 1, taxel] * share
        )
        wired = _wired(case, finger, pad.reshape(-1, rows, columns), stamps)
        frames[:, ROBOT.pads.index(f"{case.arm}_{finger}")] = wired
    return frames


def _wired(
    case: TouchCase, finger: str, frames: np.ndarray, stamps: np.ndarray
) -> np.ndarray:
    """Frames (T, R, C) of one pad after its wires, its taxels' gains and its zero."""
    for h in case.hidden:
        stage = touch_kind(h.name).stage
        rng = np.random.default_rng(
            [case.seed, zlib.crc32(f"{h.name} {finger}".encode())]
        )
        if stage == "spread":
            frames = spread(h.name, h.values, frames)
        elif stage == "board":
            frames = frames * board(h.name, h.values, rng, ROBOT.pad.shape)
        elif h.name == "warming_gain":
            frames = (
                frames
                * np.exp(-h.values["fall_per_min"] / 60.0 * stamps)[:, None, None]
            )
        elif h.name == "baseline_drift":
            own = 1.0 + 0.05 * rng.standard_normal(
                ROBOT.pad.shape
            )  # taxels do not drift alike
            frames = (
                frames + h.values["rate_per_min"] / 60.0 * stamps[:, None, None] * own
            )
    return frames


def _left_floors(case: TouchCase) -> float:
    """What is left of the press and the ramp after k_n, k_d and zero have been refitted, linearly."""
    plain = dataclasses.replace(case, hidden=())
    own = [ROBOT.pads.index(pad) for pad in case.pads]
    seen, model = [], []
    for press in (FIT[0], FIT[2]):
        time_s, depth = _penetration(press)
        stamps = np.arange(0.02, time_s[-1] - 0.02, FRAME_S)
        with_it = _readings(case, press, time_s, depth, stamps)[:, own]
        parts = [
            _readings(
                dataclasses.replace(plain, k_n=k_n, k_d=k_d),
                press,
                time_s,
                depth,
                stamps,
            )[:, own]
            for k_n, k_d in ((case.k_n, case.k_d), (case.k_n, 0.5 * case.k_d))
        ]
        touched = (parts[0].max(axis=0) > 0.1) | (np.abs(with_it).max(axis=0) > 0.1)
        touched &= parts[0].max(axis=0) > 0
        # As the problem does: while something touches and for a second after, and one row in five of the others.
        touching = _means(parts[0])[:, touched].max(axis=1) > 0
        after = (
            np.convolve(touching, np.ones(round(1.0 / (FRAMES_A_ROW * FRAME_S))))[
                : len(touching)
            ]
            > 0
        )
        counts = after | (np.arange(len(touching)) % 5 == 0)
        seen.append(_means(with_it)[counts][:, touched].ravel())
        model.append(np.stack([_means(p)[counts][:, touched].ravel() for p in parts]))
    y, columns = np.concatenate(seen), np.concatenate(model, axis=1)
    columns = np.vstack([columns, np.ones(len(y))])
    rest = y - np.linalg.lstsq(columns.T, y, rcond=None)[0] @ columns
    floor = math.hypot(
        NOISE_COUNT / math.sqrt(FRAMES_A_ROW), 0.4 * COUNTS * case.k_n * ROOM_ERROR_M
    )
    return COUNTS * float(np.sqrt(np.mean(rest**2))) / floor


def _means(frames: np.ndarray) -> np.ndarray:
    """Rows of ``FRAMES_A_ROW`` frames."""
    whole = len(frames) // FRAMES_A_ROW * FRAMES_A_ROW
    return frames[:whole].reshape(-1, FRAMES_A_ROW, *frames.shape[1:]).mean(axis=1)
