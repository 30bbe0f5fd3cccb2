"""A surrogate driven in simulated time within one process: its body, and a robot whose link has no socket."""

import json
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.robot_plugin.config_robots import TaccorlSurrogateConfig
from taccorl.robot_plugin.robots import TaccorlSurrogate
from taccorl.robot_plugin.surrogate_body import SurrogateBody, SurrogateConfig

FPS = 30


class SimulatedRobot(TaccorlSurrogate):
    """``TaccorlSurrogate`` whose clock is the body's; messages go through the link's own parser."""

    def __init__(
        self,
        folder: Path,
        faults: tuple[str, ...] = (),
        *,
        camera_px: int = 0,
        paced: bool = False,
        **options: Any,
    ) -> None:
        """``paced``: a period passes with every observation, as in LeRobot's loops."""
        self.simulated = SurrogateBody(
            SurrogateConfig(task="bench", camera_px=camera_px, faults=list(faults))
        )
        self.now_s, self.commands, self._due, self._paced = 0.0, 0, [], paced
        self._turn = threading.Lock()
        config = TaccorlSurrogateConfig(
            calibration_dir=folder,
            camera_names=["front", "left_wrist", "right_wrist"] if camera_px else [],
            camera_px=camera_px,
            **options,
        )
        super().__init__(config, clock=lambda: self.now_s)
        link: Any = self.body.link
        link.send, link.connect, link.request = self._send, self._hello, self._request
        link.close = lambda: setattr(link, "_thread", None)
        self._watch = lambda: None  # pass() calls the guard as the watchdog does

    def _hello(self) -> dict[str, Any]:
        link: Any = self.body.link
        link._thread = threading.current_thread()
        for _ in range(60):
            self.tick()
        return dict(self.simulated.facts())

    def _send(self, do: str, **values: Any) -> None:
        if do == "command" and "lost_socket" not in self.simulated.faults:
            self.commands += 1
            self.simulated.command(np.array(values["target"]))

    def _request(self, do: str, **values: Any) -> dict[str, Any]:
        assert do == "reset"
        with self._turn:
            self._due.clear()
            reply = {"kind": "reply", "seed": self.simulated.reset(values["seed"])}
            self.body.link._take(json.dumps(reply).encode(), b"")
        return reply

    def tick(self) -> None:
        """10 ms pass."""
        link: Any = self.body.link
        with self._turn:
            self._due += self.simulated.tick()
            self.now_s = self.simulated.ticks * self.simulated.TICK_S
            for message in [m for m in self._due if m.due_s <= self.now_s + 1e-9]:
                self._due.remove(message)
                if "lost_socket" not in self.simulated.faults:
                    link._take(
                        json.dumps({**message.header, "kind": message.kind}).encode(),
                        message.payload,
                    )
        until = time.monotonic() + 5.0  # the pads' threads have read what came
        while (
            self.pads
            and self.pads._drivers
            and any(not p.empty() for p in link.pads.values())
        ):
            assert time.monotonic() < until
            time.sleep(0.0005)

    def get_observation(self) -> dict[str, Any]:
        if self._paced:
            self.pass_period()
        return super().get_observation()

    def pass_period(self) -> None:
        """1/30 s passes, to within a tick, with the watchdog."""
        before_s = self.now_s
        while self.now_s < before_s + 1 / FPS - 0.0051:
            self.tick()
        with self._lock:
            if not self.body.is_lost:
                self._tick()

    def connect(self, calibrate: bool = True) -> None:
        self._while_time_passes(super().connect)

    def begin_episode(self, seed: int | None = None) -> None:
        self._while_time_passes(lambda: super(SimulatedRobot, self).begin_episode(seed))

    def _while_time_passes(self, call: Callable[[], None]) -> None:
        """Run the robot's own method in a thread, and ticks here: it waits for samples."""
        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(call)
            while not done.done():
                if self.pads and len(self.pads._threads) == len(self.pads.names):
                    self.tick()
                time.sleep(0.0005)
            done.result()
