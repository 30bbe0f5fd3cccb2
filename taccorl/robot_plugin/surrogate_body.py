"""A surrogate robot in simulated time: the twin plus hidden effects, with the sensors of the drivers. Nothing here is a robot.

Joints at 200 Hz, pads at 100 Hz, cameras at 30 Hz as JPEG; each message is due when a driver would have delivered it.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError, UnreachableError, nearest
from taccorl.robot_plugin import MOST_PX
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation, Watch, checked_seeds
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig
from taccorl.sim.twin_file import load_twin
from taccorl.surrogate.cases import draw_case, draw_secret
from taccorl.surrogate.drivers import (
    CAMERA_HZ,
    JOINT_HZ,
    PAD_HZ,
    PAD_WIRE_SHAPE,
    DriverConfig,
    jpeg,
)
from taccorl.surrogate.recordings import EFFORT_QUANTUM_NM, NOISE_RAD, QUANTUM_RAD

FAULTS = {
    "dead_camera": "the front camera sends nothing",
    "frozen_camera": "the front camera sends its last picture again and again",
    "slow_camera": "the front camera sends every fifth picture",
    "silent_pad": "pad left_a sends nothing",
    "exchanged_pads": "left_a and right_a are plugged into each other's port",
    "pressed_pad": "pad left_a is pressed hard",
    "late_state": "joint states arrive 0.3 s late",
    "jammed": "joint 2 of the left arm reports a large effort",
    "jitter": "every message arrives up to 30 ms late",
    "lost_socket": "nothing is sent or received",
}
"""Name of a fault that can be injected → what it does."""
LATE_S, JITTER_S = 0.3, 0.03
LEAST_PX = 8  # Fewest rows and columns of a camera's pictures
_CAMERA_LATENCY_S = DriverConfig.camera_latency_s
_DRAWN_MAX_BEHIND = 2  # ticks behind the clock at which a picture is left out: motion and touch come first
_DRAWN_AT_LEAST = 10  # ticks after which it is drawn all the same


@dataclass(kw_only=True)
class SurrogateConfig:
    """A surrogate robot: the twin with hidden effects, in real time, in place of a robot."""

    task: str = "assembly_1"
    """Scene on the bench: {tasks}."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given. Its effects are present, too."""
    secret: int | None = None
    """Seed of the hidden effects; none are hidden if it is not given."""
    effects: list[str] | None = None
    """Names of the hidden effects, instead of those that the secret draws."""
    seed: int = 0
    """Seed of the first scene; each reset without a seed takes the next one."""
    camera_px: int = 224
    """Rows and columns of the cameras' pictures; 0: no cameras (without OpenGL)."""
    faults: list[str] = field(default_factory=list)
    """Faults from the start; dead_camera, silent_pad, lost_socket and others, see docs/robot.md."""


class Message(NamedTuple):
    """One message of the surrogate: kind (``tick`` or ``camera``), time when it arrives [s], header and payload."""

    kind: str
    due_s: float
    header: dict[str, Any]
    payload: bytes


def hidden_twin(config: SurrogateConfig) -> TwinConfig:
    """The twin with the hidden effects. Raises TaccorlError: unknown effects, or one outside the registry."""
    twin = load_twin(config.twin) if config.twin else TwinConfig()
    if config.secret is None and not config.effects:
        return twin
    names = (
        draw_secret(config.secret or 0) if config.effects is None else config.effects
    )
    hidden = draw_case(names, config.secret or 0).hidden
    outside = [h.name for h in hidden if not h.registered]
    if outside:
        text = f"--secret={config.secret}: hides {', '.join(outside)}, which the twin cannot simulate in contact"
        raise TaccorlError(
            f"{text}; give another --secret, or --effects=[coulomb_friction]"
        )
    twin.effects = [*twin.effects, *(h.effect() for h in hidden)]
    return twin


class SurrogateBody:
    """The surrogate in simulated time: ``tick`` advances it by 10 ms and returns what its drivers would send."""

    TICK_S = 1 / PAD_HZ

    def __init__(self, config: SurrogateConfig) -> None:
        for fault in config.faults:
            if fault not in FAULTS:
                raise TaccorlError(f"--faults={fault}: {nearest(fault, FAULTS)}")
        if config.task not in tasks:
            raise TaccorlError(
                f"--task={config.task}: {nearest(config.task, list(tasks))}"
            )
        if config.camera_px and not LEAST_PX <= config.camera_px <= MOST_PX:
            raise TaccorlError(
                f"--camera_px={config.camera_px}: give {LEAST_PX} … {MOST_PX}, or 0 for no cameras"
            )
        for option in ("secret", "seed"):
            value = getattr(config, option)
            if value is not None and value < 0:
                raise TaccorlError(f"--{option}={value}: give a whole number from 0 on")
        self.config, self.faults = config, set(config.faults)
        self.sim = Simulation(
            tasks.get(config.task)(config.difficulty), hidden_twin(config)
        )
        self.cameras = ROBOT.cameras if config.camera_px else ()
        hidden = (
            "no hidden effect"
            if config.secret is None and not config.effects
            else "hidden effects"
        )
        self.origin = Origin(
            "surrogate", f"surrogate robot (the twin with {hidden}), not a robot"
        )
        dice = np.random.default_rng(
            zlib.crc32(b"pads of the surrogate")
        )  # the same pads in every session
        self.baselines = np.round(
            dice.uniform(10, 40, (len(ROBOT.pads), *PAD_WIRE_SHAPE))
        )
        self._physics = round(
            self.sim.config.physics.steps_per_control_step * CONTROL_HZ / PAD_HZ
        )
        self.ticks, self.scene_seed = 0, config.seed - 1
        self.reset(config.seed)

    def reset(self, seed: int | None = None) -> int:
        """A new scene with the arms at home: of ``seed``, or the next one. Returns its
        seed. Raises TaccorlError: ``seed`` is no seed; nothing was changed."""
        found = (self.scene_seed + 1) % 2**63 if seed is None else seed
        self.scene_seed = int(checked_seeds([found])[0])
        self.sim.reset([self.scene_seed])
        self._rng = np.random.default_rng([self.scene_seed, 2])
        self._from = self._goal = self._target = self.sim.targets[0].copy()
        self._begin, self._since, self._steps = self.ticks, self.ticks, 0
        self._scan = self._frames()
        self._last_jpeg: dict[str, bytes] = {}
        self._drawn: dict[str, int] = {}
        self._expert: Any = None
        self.lead = self._goal.copy()
        """(14,) newest command of the surrogate's leader arms, which a scripted expert moves."""
        return self.scene_seed

    def command(self, target: np.ndarray) -> None:
        """Move to ``target`` (14,) [rad, m] within 1/30 s, in a straight line, as in the twin. Raises TaccorlError: a value is
        not finite."""
        if not np.isfinite(target).all():
            raise TaccorlError(
                f"command: {ROBOT.action_names[int(np.argmin(np.isfinite(target)))]} is not finite"
            )
        self._from, self._since = self._target, self.ticks
        self._goal = np.clip(target, ROBOT.action_low, ROBOT.action_high)

    def hold(self) -> None:
        """Come to rest: the present position becomes the target at once."""
        here = np.clip(
            self.sim.proprioception()[0], ROBOT.action_low, ROBOT.action_high
        )
        here[ROBOT.gripper_indices] = self._target[
            ROBOT.gripper_indices
        ]  # what is gripped stays gripped
        self._from = self._goal = self._target = here

    def outcome(self) -> dict[str, Any]:
        """What the task's own predicate says of the episode so far: a judge beside the robot, no sensor of it."""
        found = self.sim.judge.outcome
        said = {
            "success": bool(found.success[0]),
            "failure": str(found.failure[0]),
            "partial": int(found.partial[0]),
        }
        return said | {"seconds": self._steps / CONTROL_HZ, "seed": self.scene_seed}

    def lead_on(self) -> None:
        """Next command of the leader: the task's scripted expert, a person's stand-in. At its end it stays where it is."""
        from taccorl.episodes.sources.expert import ExpertSource

        if self._expert is None:
            self._expert = ExpertSource().actions(
                self.sim, np.random.default_rng([self.scene_seed, 1])
            )
        try:
            self.lead = np.asarray(next(self._expert).sent, dtype=float)
        except (StopIteration, UnreachableError):
            self._expert = iter(())

    def tick(
        self, behind: int = 0, lead: Callable[[], bool] = lambda: False
    ) -> list[Message]:
        """Advance by 10 ms; returns the messages, due in the future. ``behind``: ticks by which the caller is late; pictures
        are then left out. ``lead``: whether the leader moves."""
        states: list[tuple[float, np.ndarray]] = []
        now_s = self.ticks * self.TICK_S
        every = round(self._physics * PAD_HZ / JOINT_HZ)
        passed = (
            self.ticks
            - self._since
            + np.arange(every, self._physics + 1, every)[:, None, None] / self._physics
        )
        share = np.minimum(passed * self.TICK_S * CONTROL_HZ, 1.0)
        line = self._from + share * (self._goal - self._from)
        self._target = self._goal if share[-1, 0, 0] == 1.0 else line[-1, 0]

        def see(step: int) -> None:
            states.append(
                (now_s + step * self.sim.config.physics.timestep_s, self._state())
            )

        at = range(every, self._physics + 1, every)
        self.sim.advance(line, every, watch=Watch(at, see))
        self.ticks += 1
        if (self.ticks - self._begin) * CONTROL_HZ // PAD_HZ > self._steps:
            self._steps += 1
            self.sim.judge.update(self.sim, None)
            if lead():
                self.lead_on()
        now_s = self.ticks * self.TICK_S
        scanned, self._scan = self._scan, self._frames()
        return [
            *self._telemetry(now_s, states, scanned),
            *self._pictures(now_s, behind),
        ]

    def _state(self) -> np.ndarray:
        """(3, 14) angles [rad, m] and efforts [N·m, N], with an encoder's noise and steps; velocities are not measured (NaN)."""
        noise = self._rng.normal(0, NOISE_RAD, ROBOT.num_actions) * ROBOT.per_action(
            1.0, 0.05
        )
        position = (
            np.round((self.sim.proprioception()[0] + noise) / QUANTUM_RAD) * QUANTUM_RAD
        )
        effort = np.round(self.sim.effort()[0] / EFFORT_QUANTUM_NM) * EFFORT_QUANTUM_NM
        if "jammed" in self.faults:
            effort[1] += 60.0
        return np.stack([position, np.full(ROBOT.num_actions, np.nan), effort])

    def _frames(self) -> np.ndarray:
        """(4, 12, 32) uint8 frames of the pads as their boards send them."""
        clean = self.sim.sensor.clean_counts(self.sim.reading())[0].swapaxes(1, 2)
        if "pressed_pad" in self.faults:
            clean[0] += 200.0
        counts = (
            self.baselines
            + clean
            + self._rng.normal(0, DriverConfig.pad_noise_counts, clean.shape)
        )
        wire = np.clip(np.round(counts), 0, 255).astype(np.uint8)
        if "exchanged_pads" in self.faults:
            wire = wire[[2, 1, 0, 3]]
        return wire

    def _telemetry(
        self, now_s: float, states: list[tuple[float, np.ndarray]], scanned: np.ndarray
    ) -> list[Message]:
        pads = [
            k
            for k, _ in enumerate(ROBOT.pads)
            if not (k == 0 and "silent_pad" in self.faults)
        ]
        late_s = LATE_S if "late_state" in self.faults else 0.0
        header = {"stamps_s": [s for s, _ in states], "lead": self.lead.tolist()}
        joints = Message(
            "state",
            self._due(now_s + late_s),
            header,
            np.stack([x for _, x in states]).tobytes(),
        )
        touch = Message(
            "pads",
            self._due(now_s),
            {"stamps_s": [now_s], "pads": pads},
            scanned[pads].tobytes(),
        )
        return [joints, touch]

    def _pictures(self, now_s: float, behind: int) -> list[Message]:
        """One camera a tick, in turn, so that no tick takes long: each has 30 pictures a second."""
        found = []
        for k, camera in enumerate(self.cameras):
            phase = self.ticks + k * round(PAD_HZ / CAMERA_HZ / len(self.cameras))
            number = phase * CAMERA_HZ // PAD_HZ
            faults = self.faults if camera == "front" else set()
            late = (
                behind > _DRAWN_MAX_BEHIND
                and self.ticks - self._drawn.get(camera, -PAD_HZ) < _DRAWN_AT_LEAST
            )
            if (
                number == (phase - 1) * CAMERA_HZ // PAD_HZ
                or late
                or "dead_camera" in faults
            ):
                continue
            self._drawn[camera] = self.ticks
            if "slow_camera" in faults and number % 5:
                continue
            if not ("frozen_camera" in faults and camera in self._last_jpeg):
                size = self.config.camera_px, self.config.camera_px
                picture = self.sim.render([camera], size=size)[camera][0, :, :, ::-1]
                # The low bits of a real picture are never twice the same.
                noisy = picture ^ self._rng.integers(0, 4, picture.shape, np.uint8)
                self._last_jpeg[camera] = jpeg(
                    np.ascontiguousarray(noisy), DriverConfig.jpeg_quality
                )
            header = {"camera": camera, "stamps_s": [now_s]}
            due_s = self._due(now_s + _CAMERA_LATENCY_S)
            found.append(Message("camera", due_s, header, self._last_jpeg[camera]))
        return found

    def _due(self, due_s: float) -> float:
        return due_s + (
            self._rng.uniform(0, JITTER_S) if "jitter" in self.faults else 0.0
        )

    def facts(self) -> Mapping[str, Any]:
        """What a client is told of the robot: no pose, no effect, nothing that a robot would not know of itself."""
        px = self.config.camera_px
        told = {
            "task": self.config.task,
            "instruction": self.sim.task.instruction,
            "seed": self.scene_seed,
        }
        return told | {
            "cameras": {name: [px, px] for name in self.cameras},
            "origin": dict(self.origin.record()),
        }

    def close(self) -> None:
        """Free OpenGL contexts and threads."""
        self.sim.close()
