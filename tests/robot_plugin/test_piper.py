"""Two PiPERs against the published interface of lerobot_robot_wego_piper 0.3.1, with the CAN layer replaced. No hardware."""

import sys
import types
from typing import Any

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robot_plugin.config_robots import BiPiperFlexitacConfig
from taccorl.robot_plugin.piper import TwoPipers
from taccorl.robots import ROBOT

RANGES = {"joint1": (-150_000, 150_000), "joint2": (0, 180_000), "joint3": (-170_000, 0), "joint4": (-100_000, 100_000)}
RANGES |= {"joint5": (-65_000, 65_000), "joint6": (-100_000, 130_000), "gripper": (0, 68_000)}
"""The plug-in's calibration: motor → range in 0.001° (gripper: 0.001 mm)."""


class PiperFollower:
    """Its published interface: normalised positions by name; the bus holds counts."""

    def __init__(self, config: Any) -> None:
        self.config, self.counts, self.sent = config, dict.fromkeys(RANGES, 0.0), {}
        known = {n: types.SimpleNamespace(range_min=a, range_max=b) for n, (a, b) in RANGES.items()}
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
            found[f"{name}.pos"] = share * 100 if name == "gripper" else share * 200 - 100
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
    plugin = types.SimpleNamespace(PiperFollower=PiperFollower, PiperFollowerConfig=types.SimpleNamespace)
    monkeypatch.setitem(sys.modules, "lerobot_robot_piper", plugin)
    return TwoPipers(BiPiperFlexitacConfig(left_can="can_l", right_can="can_r"))


def test_counts_of_the_can_bus_become_rad_and_m_and_back(arms: TwoPipers) -> None:
    arms.connect()
    arms.arms["left"].counts |= {"joint2": 90_000.0, "joint3": -45_000.0, "gripper": 34_000.0}
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
    low, high = (arms.to_ours(np.where(ROBOT.per_action(1, 0) > 0, v, (v + 100) / 2)) for v in (-100.0, 100.0))
    np.testing.assert_allclose(np.degrees(low[:6]), [-150, 0, -170, -100, -65, -100], atol=1e-9)
    np.testing.assert_allclose(np.degrees(high[:6]), [150, 180, 0, 100, 65, 130], atol=1e-9)
    np.testing.assert_allclose([low[6], high[6]], [0, 0.068], atol=1e-12)
    assert (low >= ROBOT.action_low - 0.001).all()  # joint 6 ends at 130°, 10° beyond the robot's: safety limits it


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
