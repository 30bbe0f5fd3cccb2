"""Matched contact replays: depths against a ball's arithmetic and the twin's pads, effects against the simulation's."""

import dataclasses
from typing import ClassVar

import numpy as np
import pytest
from made_press import K_D, K_N, RADIUS_M, ball_at, penetration_m, press

from pipelines.benchmarks.grip_rig import HOME_RAD, gripped
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.pressed import PressedObject, indenter
from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import TouchMotion, touch_motion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.added import AddedEffects
from taccorl.sim.effects.effect import Effect, Memory, TouchEffect, number
from taccorl.sim.pad import OneSim, PadArray
from taccorl.sim.shapes import Box
from taccorl.sim.twin import TwinConfig

CONFIG = TwinConfig()


@pytest.fixture(scope="module")
def motion() -> TouchMotion:
    return touch_motion(
        press(0, opening_noise_m=0.0, noise_count=0.0), CONFIG, ball_at(0.001, 0.003)
    )


def test_the_deepest_taxel_is_as_deep_as_the_ball_was_pressed_in(
    motion: TouchMotion,
) -> None:
    """A ball of 12 mm whose middle is up to 1.42 mm beside a taxel loses 1.42² / 24 = 0.085 mm there."""
    assert motion.pads == ("left_a", "left_b")
    deepest = motion.depth()[0].max(axis=(2, 3))
    pressed = np.maximum(penetration_m(motion.time_s, 0), 0.0)
    assert pressed.max() == pytest.approx(1e-3, abs=1e-5)
    # The scan is 10 ms long and corners are smoothed: 10 mm/s · 10 ms = 0.1 mm at most
    assert np.abs(deepest - pressed).max() < 2e-4
    still = np.abs(np.gradient(pressed[:, 0])) < 1e-9
    low, high = pressed[still].max(axis=1) - 8.5e-5, pressed[still].max(axis=1) + 1e-6
    inside = (deepest[still].max(axis=1) >= np.maximum(low, 0)) & (
        deepest[still].max(axis=1) <= high
    )
    assert inside.mean() > 0.97  # all but a few frames beside a corner


def test_counts_of_the_law_are_those_that_were_made_by_other_arithmetic(
    motion: TouchMotion,
) -> None:
    """Made with the converter's rounding only, so half a count is left; more where the smoothed opening cuts a corner."""
    model = TouchModel(CONFIG)
    left = model.counts(motion, model.simulate(motion, K_N, K_D)) - motion.measured
    assert np.abs(left).mean() < 0.05
    touched = motion.depth()[0] > 0
    assert np.sqrt(np.mean(np.square(left[touched]))) < 0.6 and np.abs(left).max() < 6


def test_rate_is_the_derivative_of_depth(motion: TouchMotion) -> None:
    depth, rate = motion.depth()
    time_s = motion.time_s[:, 0]
    by_difference = (depth[2:] - depth[:-2]) / (time_s[2:] - time_s[:-2])[
        :, None, None, None
    ]
    inside = (depth[2:] > 0) & (depth[:-2] > 0) & (depth[1:-1] > 0)
    assert np.abs(rate[1:-1] - by_difference)[inside].max() < 2e-3
    assert np.abs(rate[1:-1][inside]).max() > 9e-3


def test_taxels_moved_along_the_pad_feel_what_others_would_and_out_of_it_they_go_deeper(
    motion: TouchMotion,
) -> None:
    plain, by_a_taxel = motion.depth()[0], motion.depth(((0.002, 0.0, 0.0),) * 2)[0]
    # A column further on is scanned 0.8 ms later: 17 mm/s · 0.8 ms
    np.testing.assert_allclose(by_a_taxel[..., :-1], plain[..., 1:], atol=2e-5)
    deeper, touched = motion.depth(((0.0, 0.0, 1e-4),) * 2)[0], plain > 0
    np.testing.assert_allclose(
        (deeper - plain)[touched], 1e-4, rtol=0.15
    )  # along the ball's slope at its rim


def as_measured(
    opening_m: np.ndarray, arms: np.ndarray, time_s: np.ndarray
) -> Measurement:
    """Rows (T,) of the right gripper's opening and both arms' joints (6,), with frames of the pads every 10 ms."""
    rows = np.tile(np.r_[arms, 0.07, arms, 0.07], (len(time_s), 1))
    rows[:, 13] = opening_m
    base = press(0)
    frames = base.touch.time_s[:, 0] < time_s[-1] - 0.02
    touch = dataclasses.replace(
        base.touch, time_s=base.touch.time_s[frames], counts=base.touch.counts[frames]
    )
    return Measurement(
        name="rows", time_s=time_s, target=rows, measured=rows, touch=touch
    )


@pytest.mark.parametrize("frame", ["tcp", "world"])
def test_depths_in_a_part_are_those_of_the_twins_own_pads(frame: str) -> None:
    """A gripped part in MuJoCo, pressed in and tilted as it came to lie: the same depths from joints and opening alone."""
    model, data = gripped(0.1, 20.0)
    expected = PadArray(model, ROBOT.pads).penetration(OneSim(data)).depth_m[0]
    assert expected[2:].max() > 1e-3
    arms = np.array([data.joint(f"right_joint{k + 1}").qpos[0] for k in range(6)])
    opening = sum(data.joint(f"right_finger_{f}").qpos[0] for f in "ab")
    pose = np.eye(4)
    if frame == "world":
        pose[:3, :3], pose[:3, 3] = (
            data.body("peg").xmat.reshape(3, 3),
            data.body("peg").xpos,
        )
    else:
        tcp = data.site("right_tcp")
        turn = tcp.xmat.reshape(3, 3).T
        pose[:3, :3], pose[:3, 3] = (
            turn @ data.body("peg").xmat.reshape(3, 3),
            turn @ (data.body("peg").xpos - tcp.xpos),
        )
    part = PressedObject(
        solids=[Box(half_m=(0.01, 0.01, 0.03))], arm="right", pose=pose, frame=frame
    )  # pyright: ignore[reportArgumentType]
    time_s = np.arange(0.0, 1.0, 0.005)
    found = touch_motion(
        as_measured(np.full(len(time_s), opening), arms, time_s), CONFIG, part
    )
    assert found.pads == ("right_a", "right_b")
    depth, rate = found.depth()
    # The rack's equality is soft: the fingers stand 1e-6 m apart from half the opening each.
    np.testing.assert_allclose(depth[50].reshape(2, -1), expected[2:], atol=1e-5)
    assert np.abs(rate).max() < 1e-6


def test_a_rod_is_felt_along_its_length() -> None:
    """Across the pads, 12 mm long: 6 columns of 2 mm; pressed in by 1.2 mm it reaches √(2 · 6 · 1.2) = 3.8 mm along."""
    rod = indenter("rod", 0.006, "right", length_m=0.012, rpy_rad=(0.0, np.pi / 2, 0.0))
    time_s = np.arange(0.0, 1.0, 0.005)
    motion = touch_motion(
        as_measured(np.full(len(time_s), 0.012 - 2.4e-3), np.array(HOME_RAD), time_s),
        CONFIG,
        rod,
    )
    touched = motion.depth()[0][30] > 0
    for pad in touched:
        assert np.flatnonzero(pad.any(axis=0)).tolist() == [3, 4, 5, 6, 7, 8]
        assert np.flatnonzero(pad.any(axis=1)).tolist() == [14, 15, 16, 17]


@dataclasses.dataclass(kw_only=True)
class Fades(TouchEffect):
    """A user's own: with a memory, scan by scan."""

    name: ClassVar = "fades"
    slot: ClassVar = "material"
    rate: float = number("a", "1", 0.0, 0.2, (0.0, 1.0), "planted")

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"sum": np.zeros((num_sims, len(ROBOT.pads), *pad_shape), np.float32)}

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        memory["sum"] += reading * dt_s[:, None, None, None].astype(np.float32)
        return reading * np.exp(-np.float32(self.rate) * memory["sum"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        [make_effect("taxel_creep", share=0.3)],
        [make_effect("taxel_hysteresis", half_width=0.2)],
        [
            make_effect("touch_lag", time_constant_s=0.03),
            make_effect("touch_delay", delay_s=0.025, pads=["left_b"]),
        ],
        [
            make_effect("taxel_power_law", exponent=1.5),
            make_effect("taxel_crosstalk", share=0.3),
        ],
        [
            make_effect("taxel_gain_spread", log_std=0.2, seed=2),
            make_effect("baseline_drift", rate_per_min=2.0),
        ],
        [Fades(rate=0.2)],
    ],
    ids=lambda effects: "+".join(e.name for e in effects),
)
def test_effects_act_as_in_the_simulation_scan_by_scan(
    motion: TouchMotion, effects: list[Effect]
) -> None:
    model = TouchModel(CONFIG)
    plain, seen = (
        model.simulate(motion, K_N, K_D),
        model.simulate(motion, K_N, K_D, effects),
    )
    clock = np.zeros(1)
    added, time_s = AddedEffects(effects, clock), motion.time_s.mean(axis=1)
    for k in range(330):  # over the first presses
        clock[:] = time_s[k] - time_s[0]
        ideal = np.zeros((1, len(ROBOT.pads), *ROBOT.pad.shape), np.float32)
        ideal[0, :2] = plain[k]
        np.testing.assert_allclose(
            added(ideal)[0, :2], seen[k], atol=2e-6, err_msg=f"frame {k}"
        )
        added.scan(ideal, np.arange(1))
    assert np.abs(seen[:330] - plain[:330]).max() > 1e-3


def test_effects_of_the_twin_always_act_and_not_twice(motion: TouchMotion) -> None:
    lag = make_effect("touch_lag", time_constant_s=0.05)
    own = TouchModel(TwinConfig(effects=[lag]))
    np.testing.assert_array_equal(
        own.simulate(motion, K_N, K_D),
        TouchModel(CONFIG).simulate(motion, K_N, K_D, [lag]),
    )
    with pytest.raises(TaccorlError, match="touch_lag acts on left_a twice"):
        own.simulate(motion, K_N, K_D, [lag])


def test_a_thicker_pad_reads_as_the_depth_that_it_adds(motion: TouchMotion) -> None:
    model = TouchModel(CONFIG)
    thicker = model.simulate(
        motion, 1000.0, 0.0, [make_effect("depth_offset", offset_m=1e-4)]
    )
    np.testing.assert_allclose(
        thicker, 1000.0 * motion.depth(((0.0, 0.0, 1e-4),) * 2)[0], rtol=1e-6
    )


def test_what_cannot_be_replayed_is_said() -> None:
    measurement = press(0)
    with pytest.raises(TaccorlError, match="no frames of the pads"):
        touch_motion(
            dataclasses.replace(measurement, touch=None), CONFIG, ball_at(0.0, 0.0)
        )
    said = r"never comes within 1 mm of the pads of the left arm.*opening is at least 2[12]\.\d\d mm"
    with pytest.raises(TaccorlError, match=said):
        touch_motion(measurement, CONFIG, indenter("sphere", 0.005, "left"))
    nothing = measurement.measured.copy()
    nothing[:, 6] = np.nan
    with pytest.raises(TaccorlError, match=r"left_gripper were measured.*0%.*rows"):
        touch_motion(
            dataclasses.replace(measurement, measured=nothing),
            CONFIG,
            ball_at(0.0, 0.0),
        )
    with pytest.raises(TaccorlError, match="no shape 'spere'"):
        indenter("spere", 0.01, "left")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TaccorlError, match="no arm 'middle'"):
        indenter("sphere", RADIUS_M, "middle")
