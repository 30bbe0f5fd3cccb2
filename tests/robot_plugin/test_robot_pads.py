"""Pads beside any robot: a driver of one's own, and flexitac's published interface with the serial port replaced."""

import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robot_plugin.pads import DriverPads, FlexiTacPads, Pads


class Steady:
    """A driver: the same resting counts 200 times a second, with one pressed taxel from ``press`` on."""

    press = unplugged = False

    def __init__(self, name: str) -> None:
        self._rest = np.random.default_rng(sum(name.encode())).integers(10, 40, (12, 32)).astype(np.uint8)
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


def test_a_driver_of_ones_own_gives_counts_above_its_baseline_at_the_right_taxel(tmp_path: Path) -> None:
    pads = Pads(DriverPads(open_with=f"{__name__}:Steady", pads=["one", "two"]), tmp_path / "pads.json")
    pads.connect()
    assert not pads.at(time.monotonic())[0].any()
    Steady.press = True
    time.sleep(0.1)
    found, ages = pads.at(time.monotonic())
    Steady.press, Steady.unplugged = False, True  # on the way: its frames get old, at which safety holds and stops
    time.sleep(0.2)
    assert min(pads.at(time.monotonic())[1].values()) > 0.15
    Steady.unplugged = False
    time.sleep(0.1)
    assert max(pads.at(time.monotonic())[1].values()) < 0.1 and not pads.at(time.monotonic())[0].any()
    pads.close()
    expected = np.zeros((2, 32, 12))
    expected[:, 20, 3] = 100  # rows of the wire are columns of the pad
    np.testing.assert_array_equal(found[0], expected.reshape(-1))
    assert max(ages.values()) < 0.1
    swapped = Pads(DriverPads(open_with=f"{__name__}:Steady", pads=["two", "one"]), tmp_path / "pads.json")
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
def test_pads_that_cannot_be_read_are_said(config: DriverPads, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flexitac", None)  # not installed
    with pytest.raises(TaccorlError, match=said):
        Pads(config).connect(0.3)


def test_raw_frames_of_flexitac_are_taken_and_its_own_normalisation_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in with the interface of flexitac 0.3.1's FlexiTacSensor takes the place of the sensor on a serial port."""
    given: dict = {}

    class FlexiTacSensor:
        def __init__(
            self, port: str, *, rows: int = 12, cols: int = 32, baseline: float | None = None, **more: float
        ) -> None:
            given.update(port=port, baseline=baseline, **more)
            self.shape = rows, cols

        def open(self) -> "FlexiTacSensor":
            if given["port"] == "/dev/none":
                raise OSError("no such file")
            return self

        def read(self) -> types.SimpleNamespace:
            return types.SimpleNamespace(raw=np.full(self.shape, 7, np.uint8), normalized=np.ones(self.shape))

        def close(self) -> None:
            given["closed"] = True

    monkeypatch.setitem(sys.modules, "flexitac", types.SimpleNamespace(FlexiTacSensor=FlexiTacSensor))
    driver = FlexiTacPads(ports={"left_a": "/dev/ttyUSB3"}).open("left_a")
    stamp_s, frame = driver.read()
    driver.close()
    assert frame.shape == (12, 32) and (frame == 7).all() and abs(stamp_s - time.monotonic()) < 0.5
    assert given == {"port": "/dev/ttyUSB3", "baseline": 0.0, "read_timeout_s": 0.5, "closed": True}
    with pytest.raises(TaccorlError, match="port /dev/none cannot be opened"):
        FlexiTacPads(ports={"left_a": "/dev/none"}).open("left_a")
