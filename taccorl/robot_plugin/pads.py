"""Touch beside any robot: drivers that yield frames, their baseline, which pad is which, and what was felt at a given time.

Frames are matched with times as ``taccorl ingest`` does it (``timing.match``). A driver is read in a thread of its own.
"""

import bisect
import importlib
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import draccus
import numpy as np

from taccorl.data.sensor_spec import SensorSpec, load_sensor_spec
from taccorl.data.spec import data_specs_folder
from taccorl.data.timing import NS_PER_S, match
from taccorl.errors import TaccorlError
from taccorl.robot_plugin.faults import (
    Repeats,
    Unfit,
    close_all,
    described,
    number,
    stuck_taxels,
)

_log = logging.getLogger(__name__)
SENSOR = "flexitac_v2"
SAME_PAD = 0.8
"""Least correlation of a pad's resting counts with those that were stored: they differ from taxel to taxel, and so tell pads
apart."""
_KEPT_S = 5.0  # of frames, for windows of touch
_LEAST_REST_COUNT = 5  # resting counts from which a taxel's noise does not reach 0
REPEATED = "it repeats its frames"
DEAD = "a line of its taxels reads 0 that is above 0 at rest"
STUCK = "lines of its taxels stand still while others change"
_STUCK_FRAMES = 5  # in which taxels do not change that are stuck: 0.05 s


class PadDriver(Protocol):
    """One pad's driver."""

    def read(self) -> tuple[float, np.ndarray]:
        """Wait for the next frame; returns its time [s of ``time.monotonic``] and its counts as on the wire, (rows, columns)
        uint8. Raises OSError (such as TimeoutError) or ValueError: the pad sends nothing usable, and may do so again. Any
        other exception is a stop."""
        ...

    def close(self) -> None:
        """Free the port."""
        ...


@dataclass(kw_only=True)
class PadsConfig(draccus.ChoiceRegistry):
    """Pads of a robot, in the order of ``observation.tactile``."""

    raw: bool = True
    """Whether frames are an ADC's counts, whose noise makes every frame new and which are above 0 at rest. False
    for a driver that filters or subtracts: frames that repeat, and zeros, are then no fault."""

    def open(self, name: str) -> PadDriver:
        """Open the driver of the pad of that name. Raises TaccorlError: a package is missing, or the port cannot be opened."""
        raise NotImplementedError

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pads, in their order."""
        raise NotImplementedError


@PadsConfig.register_subclass("flexitac")
@dataclass(kw_only=True)
class FlexiTacPads(PadsConfig):
    """FlexiTac pads on serial ports, read by the package ``flexitac``."""

    ports: dict[str, str] = field(default_factory=dict)
    """Pad → port, in the order of the dataset: {left_a: /dev/ttyUSB0, …}; `flexitac-find-port` names the ports."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.ports)

    def open(self, name: str) -> PadDriver:
        if len(set(self.ports.values())) < len(self.ports):
            raise TaccorlError(
                f"pads.ports: {self.ports}: a port is given twice; each pad has its own"
            )
        return FlexiTacDriver(name, self.ports[name])


@PadsConfig.register_subclass("driver")
@dataclass(kw_only=True)
class DriverPads(PadsConfig):
    """Tactile pads of another make, read by a function that the user names."""

    open_with: str = ""
    """Function that takes a pad's name and returns an object with read() and close(), as module:function."""
    pads: list[str] = field(default_factory=list)
    """Names of the pads, in the order of the dataset."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.pads)

    def open(self, name: str) -> PadDriver:
        module, _, function = self.open_with.partition(":")
        try:
            return getattr(importlib.import_module(module), function)(name)
        except (ImportError, AttributeError, ValueError) as error:
            raise TaccorlError(
                f"pads.open_with={self.open_with}: {error}; give module:function"
            ) from error


class FlexiTacDriver:
    """A pad by ``flexitac.FlexiTacSensor`` (0.3.1): its raw frames; its normalisation by the frame's own peak is not used."""

    def __init__(self, name: str, port: str) -> None:
        try:
            sensor = importlib.import_module("flexitac").FlexiTacSensor
        except ImportError as error:
            raise TaccorlError(
                "pads.type=flexitac needs the package flexitac: pip install flexitac"
            ) from error
        try:
            # A baseline is given so that the sensor does not calibrate by itself; only raw frames are used.
            self._sensor: Any = sensor(port, baseline=0.0, read_timeout_s=0.5).open()
        except OSError as error:
            text = f"pad {name}: port {port} cannot be opened: {error}; flexitac-find-port names it"
            raise TaccorlError(text) from error

    def read(self) -> tuple[float, np.ndarray]:
        frame = self._sensor.read()
        return time.monotonic(), frame.raw

    def close(self) -> None:
        self._sensor.close()


class Pads:
    """Reads the tactile pads of a robot, each in a thread. ``identity``: JSON file of each taxel's counts without contact, by
    which pads are told apart. ``listen``: called with (time [s], pad, frame as on the wire) of every frame."""

    def __init__(
        self,
        config: PadsConfig,
        identity: Path | None = None,
        listen: Callable[[float, str, np.ndarray], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        max_skew_s: float = 0.05,
    ) -> None:
        """``max_skew_s``: as that of ``SafetyConfig``."""
        self.config, self.names = config, config.names
        self._identity, self._listen, self._clock = identity, listen, clock
        self._max_skew_s = max_skew_s
        self.spec: SensorSpec = load_sensor_spec(
            data_specs_folder() / "sensors" / f"{SENSOR}.yaml"
        )
        if not self.names:
            raise TaccorlError(
                "pads: no pad is named; give pads.ports={left_a: /dev/ttyUSB0}, in the dataset's order"
            )
        self.baseline: np.ndarray | None = None
        """(K,) resting counts; None before ``connect``."""
        size = round(_KEPT_S * self.spec.rate_hz)
        self._frames: dict[str, deque[tuple[float, np.ndarray]]] = {
            n: deque(maxlen=size) for n in self.names
        }
        self._drivers: dict[str, PadDriver] = {}
        self._threads: list[threading.Thread] = []
        self._ended = threading.Event()
        self._stamps_s: dict[str, float] = {}
        self._repeats: dict[str, Repeats] = {}
        self._still: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        """Pad → its last counts (taxels,), and for how many frames each is unchanged."""
        self.faults: dict[str, str] = {}
        """Pad → why nothing newer of it can be used, if that is so."""
        self.broken = ""
        """Why a pad's driver must not be read any more; empty if all may be."""

    @property
    def num_taxels(self) -> int:
        """K: number of taxels of all pads."""
        return len(self.names) * self.spec.rows * self.spec.columns

    @property
    def layout(self) -> list[int]:
        """Pads, rows and columns."""
        return [len(self.names), self.spec.rows, self.spec.columns]

    def connect(self, timeout_s: float = 3.0) -> None:
        """Open all pads, take their baseline, and check which is which. Raises TaccorlError: a pad is missing, silent, touched,
        or not the one that was there before."""
        self._ended = threading.Event()  # of this connection: its threads keep it
        self.broken, self.baseline = "", None
        self._stamps_s, self.faults, self._still = {}, {}, {}
        self._repeats = {name: Repeats() for name in self.names}
        for frames in self._frames.values():
            frames.clear()
        try:
            for name in self.names:
                self._drivers[name] = self.config.open(name)
            for name, driver in self._drivers.items():
                thread = threading.Thread(
                    target=self._read,
                    args=(name, driver, self._ended),
                    daemon=True,
                    name=f"pad {name}",
                )
                self._threads.append(thread)
                thread.start()
            self.calibrate(timeout_s)
            self._identify()
        except BaseException as error:
            failures = close_all({"pads": self.close})
            if failures and isinstance(error, Exception):
                text = "; ".join([described(error), *failures])
                raise TaccorlError(text) from error
            raise

    def calibrate(self, timeout_s: float = 3.0) -> None:
        """Take the median of the next frames as baseline; the pads must not be touched. Raises TaccorlError: a pad is silent,
        or is touched."""
        rule, begin_s, parts = self.spec.baseline, self._clock(), []
        for name in self.names:
            first = np.stack(
                self._newest(name, begin_s, rule.frames, timeout_s)
            ).astype(np.int64)
            baseline = np.round(np.median(first, axis=0)).astype(np.int64)
            spread = float(np.quantile(np.abs(first - baseline), 0.99))
            if spread > rule.max_spread_count:
                text = f"pad {name}: counts spread by {spread:.0f} about their median, at most by {rule.max_spread_count:g}"
                raise TaccorlError(
                    f"{text} at rest: is it touched? Open the grippers, and connect again"
                )
            ends = (first == 0) | (first == self.spec.max_count)
            stuck = int((ends.all(axis=0) & (first == first[0]).all(axis=0)).sum())
            if self.config.raw and stuck >= self._line:
                text = f"pad {name}: {stuck} of {len(baseline)} taxels always read 0 or"
                text += f" {self.spec.max_count} at rest: is it unplugged or pressed? A"
                raise TaccorlError(f"{text} driver that subtracts needs pads.raw=false")
            same = self._as_pad((first == first[0]).all(axis=0))
            if self.config.raw and (stuck := stuck_taxels(same)):
                text = (
                    f"pad {name}: {stuck} of {len(baseline)} taxels, in whole rows or"
                )
                text += (
                    f" columns, give one number in {len(first)} frames at rest while"
                )
                text += " others change: is a line unplugged? A driver that filters"
                raise TaccorlError(f"{text} needs pads.raw=false")
            parts.append(baseline)
        self.baseline = np.concatenate(parts)

    def forget(self, timeout_s: float = 3.0) -> None:
        """Drop the frames so far, and wait for one of each pad. Raises TaccorlError: a pad is silent."""
        begin_s = self._clock()
        for name in self.names:
            self._newest(name, begin_s, 1, timeout_s)
            while self._frames[name][0][0] < begin_s:
                self._frames[name].popleft()

    def _newest(
        self, name: str, begin_s: float, count: int, timeout_s: float
    ) -> list[np.ndarray]:
        while (
            len(new := [f for t, f in list(self._frames[name]) if t >= begin_s]) < count
        ):
            if self.broken:
                raise TaccorlError(self.broken)
            if self._clock() - begin_s > timeout_s:
                text = f"pad {name}: {len(new)} frames in {timeout_s:g} s, not {count}"
                raise TaccorlError(
                    f"{text}: {self.faults.get(name) or 'is it plugged in?'}"
                )
            time.sleep(0.005)
        return new[:count]

    def close(self) -> None:
        """End the threads and close the ports. Raises TaccorlError, after all were
        tried: one could not be closed, or a thread hangs in its driver."""
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        failures = close_all({f"pad {n}": d.close for n, d in self._drivers.items()})
        for thread in self._threads:
            thread.join(timeout=0.5)  # one that waits on a port ends with the port
            if thread.is_alive():
                failures.append(f"{thread.name}: its driver does not return")
        self._threads, self._drivers = [], {}
        if failures:
            raise TaccorlError("; ".join(failures))

    def at(
        self, time_s: float, *, rows: int = 1, period_s: float = 0.0
    ) -> tuple[np.ndarray, dict[str, float]]:
        """(rows, K) int16 counts above baseline at ``time_s`` and before it, one every ``period_s``, oldest first; and the age of
        each pad's newest frame [s], inf without one. Before the first frame there was none: it is repeated."""
        assert self.baseline is not None, "connect first"
        grid_ns = np.round(
            (time_s - np.arange(rows)[::-1] * period_s) * NS_PER_S
        ).astype(np.int64)
        parts, ages = [], {}
        for name in self.names:
            frames = list(self._frames[name])
            frames = frames[
                max(
                    bisect.bisect(
                        frames, time_s - (rows - 1) * period_s, key=itemgetter(0)
                    )
                    - 1,
                    0,
                ) :
            ]
            stamps_ns = np.round(np.array([t for t, _ in frames]) * NS_PER_S).astype(
                np.int64
            )
            found = match(
                grid_ns, stamps_ns - round(self.spec.scan_time_s * NS_PER_S), "hold"
            )
            ages[name] = float(found.age_s[-1])
            values = (
                [frames[max(int(k), 0)][1] for k in found.index[:, 0]] if frames else []
            )
            empty = np.zeros((rows, self.spec.rows * self.spec.columns), np.int64)
            parts.append(np.stack(values).astype(np.int64) if values else empty)
        above = np.concatenate(parts, axis=1) - self.baseline
        return above.astype(np.int16), ages

    @property
    def _line(self) -> int:
        """Number of taxels on the shorter lines of the matrix, which fail together."""
        return min(self.spec.wire.rows, self.spec.wire.columns)

    def _read(self, name: str, driver: PadDriver, ended: threading.Event) -> None:
        while not ended.is_set():
            try:
                stamp_s, frame = driver.read()
                self._take(name, stamp_s, frame)
            except (OSError, ValueError) as error:
                # TimeoutError is an OSError; a pad that comes back is read again
                self.faults[name] = described(error)
                ended.wait(0.01)
            except BaseException as error:
                if not ended.is_set():
                    prefix = "" if isinstance(error, Unfit) else f"pad {name}: "
                    self.broken = prefix + described(error)
                return

    def _take(self, name: str, stamp_s: float, frame: np.ndarray) -> None:
        """Keep a frame that is new and whole; state in ``faults`` why another is not.
        Raises Unfit: its time cannot be."""
        stamp_s = number(f"the time of pad {name}", stamp_s)
        last_s, most_s = self._stamps_s.get(name, stamp_s), self._max_skew_s
        if (ahead_s := stamp_s - self._clock()) > most_s:
            text = f"pad {name} is stamped {ahead_s:.3g} s ahead of the clock"
            raise Unfit(f"{text}, at most {most_s:g} s")
        if (back_s := last_s - stamp_s) > most_s:
            text = f"the time of pad {name} went back by {back_s:.3g} s"
            raise Unfit(f"{text}, at most {most_s:g} s")
        self._stamps_s[name] = max(stamp_s, last_s)
        wire = self.spec.wire
        shape, dtype = np.shape(frame), getattr(frame, "dtype", type(frame).__name__)
        if shape != (wire.rows, wire.columns) or dtype != wire.dtype:
            sent = shape if dtype == wire.dtype else f"{shape} {dtype}"
            needed = f"{self.spec.name} sends {(wire.rows, wire.columns)} {wire.dtype}"
            self.faults[name] = f"frames of {sent}, but {needed}"
            return
        if self._listen is not None:
            self._listen(stamp_s, name, frame)
        values = (frame.T if wire.transpose else frame).reshape(-1)
        fault = self._fault(name, values) if self.config.raw else ""
        if fault:
            self.faults[name] = fault
            return
        self.faults.pop(name, None)
        frames = self._frames[name]
        frames.append((stamp_s, values))
        if stamp_s < last_s:  # it came late
            in_order = sorted(frames, key=itemgetter(0))
            self._frames[name] = deque(in_order, maxlen=frames.maxlen)

    def _fault(self, name: str, values: np.ndarray) -> str:
        """Why (taxels,) counts are not those of a pad that works; empty if they are."""
        is_new = self._repeats[name].is_new(values)
        if self.baseline is not None:
            start = self.names.index(name) * len(values)
            rest = self.baseline[start : start + len(values)]
            dead = int(((values == 0) & (rest >= _LEAST_REST_COUNT)).sum())
            if dead >= self._line:
                return DEAD
        last, frames = self._still.get(name, (values, np.zeros(len(values), int)))
        # What saturates is pressed, and stands still for as long as it is.
        still = (values == last) & (values < self.spec.max_count)
        frames = np.where(still, frames + 1, 0)
        self._still[name] = values, frames
        stuck = stuck_taxels(self._as_pad(frames >= _STUCK_FRAMES))
        if stuck and self.baseline is not None:  # else ``calibrate`` sees it
            return f"{STUCK}: {stuck} of {len(values)}"
        return "" if is_new else REPEATED

    def _as_pad(self, values: np.ndarray) -> np.ndarray:
        """(rows, columns) of the pad for one of each taxel (taxels,)."""
        return values.reshape(self.spec.rows, self.spec.columns)

    def _identify(self) -> None:
        """Compare the resting counts with those of the first connection: a pad in another's port shows another's."""
        if self._identity is None:
            return
        assert self.baseline is not None
        now = dict(
            zip(self.names, np.split(self.baseline, len(self.names)), strict=True)
        )
        if not self._identity.is_file():
            self._identity.parent.mkdir(parents=True, exist_ok=True)
            self._identity.write_text(
                json.dumps({n: v.astype(int).tolist() for n, v in now.items()}),
                encoding="utf-8",
            )
            _log.info(
                "resting counts of the pads stored in %s, to compare the next connection with",
                self._identity,
            )
            return
        stored = {
            n: np.array(v)
            for n, v in json.loads(self._identity.read_text(encoding="utf-8")).items()
        }
        way_out = f"If pads were changed on purpose, remove {self._identity}"
        for name, counts in now.items():
            likeness = {
                other: float(np.corrcoef(counts, of)[0, 1])
                for other, of in stored.items()
            }
            best = max(likeness, key=lambda n: likeness[n], default="")
            if best and best != name and likeness[best] > SAME_PAD:
                raise TaccorlError(
                    f"pad {name}: on its port is {best}: pads are exchanged; correct ports. {way_out}"
                )
            if likeness.get(name, 0.0) <= SAME_PAD:
                text = f"pad {name}: its resting counts differ from those of before: is it touched, or another pad? {way_out}"
                raise TaccorlError(text)
