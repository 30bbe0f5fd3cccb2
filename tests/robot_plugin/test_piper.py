"""The interfaces of lerobot_robot_wego_piper 0.3.1 and flexitac, with CAN layer and serial port replaced. No hardware."""

import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robot_plugin.config_robots import BiPiperFlexitacConfig
from taccorl.robot_plugin.pads import DriverPads, FlexiTacPads, Pads
from taccorl.robot_plugin.piper import TwoPipers
from taccorl.robots import ROBOT

RANGES = {
    "joint1": (-150_000, 150_000),
    "joint2": (0, 180_000),
    "joint3": (-170_000, 0),
    "joint4": (-100_000, 100_000),
}
RANGES |= {
    "joint5": (-65_000, 65_000),
    "joint6": (-100_000, 130_000),
    "gripper": (0, 68_000),
}
"""The plug-in's calibration: motor → range in 0.001° (gripper: 0.001 mm)."""


class PiperFollower:
    """Its published interface: normalised positions by name; the bus holds counts."""

    def __init__(self, config: Any) -> None:
        self.config, self.counts, self.sent = config, dict.fromkeys(RANGES, 0.0), {}
        known = {
            n: types.SimpleNamespace(range_min=a, range_max=b)
            for n, (a, b) in RANGES.items()
        }
        self.bus, self.is_connected = types.SimpleNamespace(calibration=known), False

    def connect(self, calibrate: bool = True) -> None:
        if self.config.port == "can_missing":
            raise ConnectionError("Failed to open port")
        assert not calibrate, "it would drive to its origin by itself"
        self.is_connected = True

    def get_observation(self) -> dict[str, float]:
        found = {}
        for name, (low, high) in RANGES.items():
            share = (self.counts[name] - low) / (high - low)
            found[f"{name}.pos"] = (
                share * 100 if name == "gripper" else share * 200 - 100
            )
        return found

    def send_action(self, action: dict[str, float]) -> None:
        for key, value in action.items():
            low, high = RANGES[key.removesuffix(".pos")]
            share = value / 100 if key == "gripper.pos" else (value + 100) / 200
            self.sent[key.removesuffix(".pos")] = low + share * (high - low)

    def disconnect(self, disable_torque: bool = False) -> None:
        assert not disable_torque
        self.is_connected = False


@pytest.fixture
def arms(monkeypatch: pytest.MonkeyPatch) -> TwoPipers:
    plugin = types.SimpleNamespace(
        PiperFollower=PiperFollower, PiperFollowerConfig=types.SimpleNamespace
    )
    monkeypatch.setitem(sys.modules, "lerobot_robot_piper", plugin)
    return TwoPipers(BiPiperFlexitacConfig(left_can="can_l", right_can="can_r"))


def test_counts_of_the_can_bus_become_rad_and_m_and_back(arms: TwoPipers) -> None:
    arms.connect()
    arms.arms["left"].counts |= {
        "joint2": 90_000.0,
        "joint3": -45_000.0,
        "gripper": 34_000.0,
    }
    arms.arms["right"].counts |= {"joint6": 30_000.0}
    position = arms.read().position
    expected = np.zeros(14)
    expected[[1, 2, 6, 12]] = np.pi / 2, -np.pi / 4, 0.034, np.pi / 6
    np.testing.assert_allclose(position, expected, atol=1e-9)
    target = np.where(np.arange(14) == 3, 0.5, expected)
    arms.send(target)
    assert arms.arms["left"].sent["joint4"] == pytest.approx(np.degrees(0.5) * 1000)
    assert arms.arms["left"].sent["gripper"] == pytest.approx(34_000)
    assert arms.arms["right"].sent["joint6"] == pytest.approx(30_000)
    arms.disconnect()
    assert not arms.is_connected


def test_zero_and_sign_are_those_of_the_data_spec(arms: TwoPipers) -> None:
    """The plug-in's ends in rad and m: joint 2 from 0 up, joint 3 from 0 down, as the manual and the data spec have them."""
    low, high = (
        arms.to_ours(np.where(ROBOT.per_action(1, 0) > 0, v, (v + 100) / 2))
        for v in (-100.0, 100.0)
    )
    np.testing.assert_allclose(
        np.degrees(low[:6]), [-150, 0, -170, -100, -65, -100], atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(high[:6]), [150, 180, 0, 100, 65, 130], atol=1e-9
    )
    np.testing.assert_allclose([low[6], high[6]], [0, 0.068], atol=1e-12)
    assert (
        low >= ROBOT.action_low - 0.001
    ).all()  # joint 6 ends at 130°, 10° beyond the robot's: safety limits it


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"left_can": "can0", "right_can": "can0"}, "both can0"),
        ({"left_can": "can_missing"}, "the left arm does not answer"),
    ],
)
def test_wrong_ports_are_said(options: dict, said: str, arms: TwoPipers) -> None:
    with pytest.raises(TaccorlError, match=said):
        TwoPipers(BiPiperFlexitacConfig(**options)).connect()


def test_without_the_plugin_its_name_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lerobot_robot_piper", None)
    with pytest.raises(TaccorlError, match="pip install lerobot_robot_wego_piper"):
        TwoPipers(BiPiperFlexitacConfig())


# ---- pads beside any robot: a driver of one's own, and flexitac's ----


class Steady:
    """A driver: the same resting counts 200 times a second, with one pressed taxel from ``press`` on."""

    press = unplugged = False

    def __init__(self, name: str) -> None:
        self._rest = (
            np.random.default_rng(sum(name.encode()))
            .integers(10, 40, (12, 32))
            .astype(np.uint8)
        )
        self._pressed = self._rest.copy()
        self._pressed[3, 20] += 100

    def read(self) -> tuple[float, np.ndarray]:
        time.sleep(0.005)
        if Steady.unplugged:
            raise OSError("the device is gone")
        return time.monotonic(), self._pressed if Steady.press else self._rest

    def close(self) -> None:
        return


class Crooked(Steady):
    def read(self) -> tuple[float, np.ndarray]:
        return time.monotonic(), np.zeros((4, 4), np.uint8)


def test_a_driver_of_ones_own_gives_counts_above_its_baseline_at_the_right_taxel(
    tmp_path: Path,
) -> None:
    pads = Pads(
        DriverPads(open_with=f"{__name__}:Steady", pads=["one", "two"], raw=False),
        tmp_path / "pads.json",
    )
    pads.connect()
    assert not pads.at(time.monotonic())[0].any()
    Steady.press = True
    time.sleep(0.1)
    found, ages = pads.at(time.monotonic())
    Steady.press, Steady.unplugged = (
        False,
        True,
    )  # on the way: its frames get old, at which safety holds and stops
    time.sleep(0.2)
    assert min(pads.at(time.monotonic())[1].values()) > 0.15
    Steady.unplugged = False
    time.sleep(0.1)
    assert (
        max(pads.at(time.monotonic())[1].values()) < 0.1
        and not pads.at(time.monotonic())[0].any()
    )
    pads.close()
    expected = np.zeros((2, 32, 12))
    expected[:, 20, 3] = 100  # rows of the wire are columns of the pad
    np.testing.assert_array_equal(found[0], expected.reshape(-1))
    assert max(ages.values()) < 0.1
    swapped = Pads(
        DriverPads(open_with=f"{__name__}:Steady", pads=["two", "one"], raw=False),
        tmp_path / "pads.json",
    )
    swapped.connect()  # the names follow their pads
    swapped.close()


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (DriverPads(pads=["one"], open_with=f"{__name__}:Missing"), "give module:function"),
        (DriverPads(pads=["one"], open_with=f"{__name__}:Crooked"), r"frames of \(4, 4\), but flexitac_v2 sends \(12, 32\)"),
        (FlexiTacPads(ports={"a": "/dev/x", "b": "/dev/x"}), "a port is given twice"),
        (FlexiTacPads(ports={}), "no pad is named"),
        (FlexiTacPads(ports={"a": "/dev/x"}), "pip install flexitac"),
    ],
)  # fmt: skip
def test_pads_that_cannot_be_read_are_said(
    config: DriverPads, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flexitac", None)  # not installed
    with pytest.raises(TaccorlError, match=said):
        Pads(config).connect(0.3)


def test_raw_frames_of_flexitac_are_taken_and_its_own_normalisation_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stand-in with the interface of flexitac 0.3.1's FlexiTacSensor takes the place of the sensor on a serial port."""
    given: dict = {}

    class FlexiTacSensor:
        def __init__(
            self,
            port: str,
            *,
            rows: int = 12,
            cols: int = 32,
            baseline: float | None = None,
            **more: float,
        ) -> None:
            given.update(port=port, baseline=baseline, **more)
            self.shape = rows, cols

        def open(self) -> "FlexiTacSensor":
            if given["port"] == "/dev/none":
                raise OSError("no such file")
            return self

        def read(self) -> types.SimpleNamespace:
            return types.SimpleNamespace(
                raw=np.full(self.shape, 7, np.uint8), normalized=np.ones(self.shape)
            )

        def close(self) -> None:
            given["closed"] = True

    monkeypatch.setitem(
        sys.modules, "flexitac", types.SimpleNamespace(FlexiTacSensor=FlexiTacSensor)
    )
    driver = FlexiTacPads(ports={"left_a": "/dev/ttyUSB3"}).open("left_a")
    stamp_s, frame = driver.read()
    driver.close()
    assert (
        frame.shape == (12, 32)
        and (frame == 7).all()
        and abs(stamp_s - time.monotonic()) < 0.5
    )
    assert given == {
        "port": "/dev/ttyUSB3",
        "baseline": 0.0,
        "read_timeout_s": 0.5,
        "closed": True,
    }
    with pytest.raises(TaccorlError, match="port /dev/none cannot be opened"):
        FlexiTacPads(ports={"left_a": "/dev/none"}).open("left_a")
