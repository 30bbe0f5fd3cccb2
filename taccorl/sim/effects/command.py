"""Effects on the command's way to the controller: delay, low-pass, speed limit, lost commands, speeds sent along."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import JointEffect, Memory, effect, number
from taccorl.sim.effects.history import delay
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

STRIDE, _FIRST, _SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
"""Constants of SplitMix64: the increment between two numbers of a stream, and the factors of its finaliser."""
_WORD = 0xFFFFFFFF
_WITH_GRIPPER = (*ROBOT.joints, "gripper")


class _CommandEffect(JointEffect):
    """Base of effects that keep a target r between commands; after a reset it is the target at rest."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"target": np.full((num_sims, ROBOT.num_actions), np.nan)}

    def begun(self, targets: np.ndarray, memory: Memory) -> np.ndarray:
        """(N, A) r until now, to be changed in place."""
        kept = memory["target"]
        kept[:] = np.where(np.isnan(kept), targets, kept)
        return kept

    def replaced(self, targets: np.ndarray, arriving: np.ndarray) -> np.ndarray:
        """(N, A) ``targets`` with those of the chosen joints from ``arriving`` (N, A)."""
        targets = targets.copy()
        targets[:, self.columns] = arriving[:, self.columns]
        return targets


@effect("command_delay", slot="command", needs="target")
class CommandDelay(JointEffect):
    """Delay of the commands: the controller receives q*(t − d), because of bus, driver and interpolation in the drive. The phase
    lag grows in proportion to the frequency. The control loop itself is not delayed, because it runs in the drive."""

    possible: ClassVar = _WITH_GRIPPER
    delay_s: float = number(
        "d",
        "s",
        0,
        0.02,
        (0, 0.2),
        "a choice; 0.8–4 ms fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.actuator(name), self.delay_s, config.physics.timestep_s)


@effect("command_lag", slot="command", needs="target")
class CommandLag(_CommandEffect):
    """Low-pass of the commands: ṙ = (q* − r) / T, and the controller's target is r. Slow motions look delayed by T.

    The equation is solved exactly for targets that are constant between two commands. The controller gets the value of r at the
    end of that interval; the drives of axis and robot files get it in each physics step."""

    possible: ClassVar = _WITH_GRIPPER
    time_constant_s: float = number("T", "s", 0, 0.05, (0, 0.5))

    def command(
        self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray
    ) -> np.ndarray:
        smooth = self.begun(targets, memory)
        smooth += (targets - smooth) * -np.expm1(-dt_s / self.time_constant_s)[:, None]
        return self.replaced(targets, smooth)


@effect("dropped_commands", slot="command", needs="target")
class DroppedCommands(_CommandEffect):
    """Commands that are lost: r_k = q*_k with probability 1 − p, else r_{k−1}; the controller's target is r.

    Each command is lost independently of the others, for all selected joints at once, because they travel in one message. The
    lost commands follow from ``seed``, the episode's seed and the number k of commands since the reset. The commands that are
    lost at a small p are also lost at a greater p. The effect acts after ``command_lag`` and before ``slew_limit``,
    ``velocity_feedforward`` and ``command_delay``. Random numbers are those of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014),
    which the compiled one-joint model draws, too.

    No search fits the effect: two recordings of one motion lose different commands, so that no p reproduces a measurement."""

    fitted: ClassVar = False
    possible: ClassVar = _WITH_GRIPPER
    probability: float = number(
        "p", "1", 0, 0.1, (0, 0.95), "a choice; one in ten shows in a second of motion"
    )
    seed: int = 0
    """Seed of the bus: with another seed other commands are lost."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            isinstance(self.seed, bool)
            or not isinstance(self.seed, int)
            or not 0 <= self.seed <= _WORD
        ):
            raise TaccorlError(
                f"effect {self.name}: seed is {self.seed!r}; give a whole number in 0 … {_WORD}"
            )

    def drive(self) -> dict[str, float]:
        return {**(super().drive() or {}), "dropped_commands__seed": float(self.seed)}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        counts = {name: np.zeros(num_sims) for name in ("count", "episode")}
        return super().memory(num_sims, pad_shape) | counts

    def begin(self, memory: Memory, ids: np.ndarray, seeds: np.ndarray) -> None:
        seeds = np.asarray(seeds, dtype=np.uint64)
        memory["episode"][ids] = (seeds ^ (seeds >> np.uint64(32))) & np.uint64(_WORD)

    def command(
        self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray
    ) -> np.ndarray:
        held, sent = memory["target"], dt_s > 0
        lost = uniform(self.seed, memory["episode"], memory["count"]) < self.probability
        keeps = np.where(sent, lost, True)[:, None] & ~np.isnan(held)
        held[:] = np.where(keeps, held, targets)
        memory["count"] += sent
        return self.replaced(targets, held)


def uniform(
    seed: int | np.ndarray, episode: np.ndarray, count: np.ndarray
) -> np.ndarray:
    """Uniform random numbers in [0, 1), float64, shape (…), that depend only on ``seed``, ``episode`` and ``count`` (number of
    the command in its episode): whole numbers below 2³², arrays that broadcast to (…). The same on every machine."""
    # Arrays of at least one number: they wrap around, scalars warn.
    key = (np.atleast_1d(seed).astype(np.uint64) << np.uint64(32)) + np.asarray(
        episode, dtype=np.uint64
    )
    bits = mixed(
        mixed(key)
        + (np.asarray(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(STRIDE)
    )
    return (bits >> np.uint64(11)) * 2.0**-53


def mixed(bits: Any) -> Any:
    """Scramble 64-bit numbers (finaliser of the SplitMix64 generator): arrays (…) uint64 here, single numbers in the compiled
    ``joint_kernel``."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(_FIRST)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(_SECOND)
    return bits ^ (bits >> np.uint64(31))


@effect("slew_limit", slot="command", needs="target")
class SlewLimit(_CommandEffect):
    """Speed limit of the commands: |ṙ| ≤ v_max, and the controller's target is r, which moves towards q* by at most v_max Δt
    until the next command.

    As in ``command_lag``, the controller gets the value of r at the end of that Δt, or in
    each physics step: r_k = r_{k−1} + clip(q*_k − r_{k−1}, ± v_max Δt). The effect acts after
    ``command_lag`` and before ``velocity_feedforward`` and ``command_delay``."""

    speed_rad_per_s: float = number("v_max", "rad/s", math.inf, 0.5, (0.05, 20))

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: 35 to 98 % of the largest commanded speed."""
        shares = (0.35, 0.6, 0.8, 0.92, 0.98)
        return [
            {
                "speed_rad_per_s": cls.clipped(
                    "speed_rad_per_s", s * seen["peak_speed_rad_per_s"]
                )
            }
            for s in shares
        ]

    def command(
        self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray
    ) -> np.ndarray:
        limited = self.begun(targets, memory)
        reach = (self.speed_rad_per_s * dt_s)[:, None]
        limited += np.clip(targets - limited, -reach, reach)
        return self.replaced(targets, limited)


@effect("velocity_feedforward", slot="command", needs="target")
class VelocityFeedforward(_CommandEffect):
    """Velocity feedforward of the drive: τ = K_p (q* − q) + K_d (α q̇* − q̇) + T_ref. With α = 1 the lag K_d / K_p vanishes.

    q̇*_k = (q*_k − q*_{k−1}) / Δt between two commands, constant while q*_k is in force; 0 for the first command. The controller
    gets q* + α (K_d / K_p) q̇*. The effect acts after ``command_lag`` and ``slew_limit``, whose output r is differentiated, and
    before ``command_delay``."""

    share: float = number(
        "α", "1", 0, 0.5, (0, 1.5), "a choice; 1 in the MIT mode with speeds sent"
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        none = np.zeros((num_sims, len(ROBOT.action_names)))
        return super().memory(num_sims, pad_shape) | {
            "speed": none,
            "lead_s": none.copy(),
        }

    def feel(
        self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        actuators = live.actuators(self.acts_on())
        kd, kp = (
            -live.model.actuator_biasprm[actuators, 2],
            -live.model.actuator_biasprm[actuators, 1],
        )
        memory["lead_s"][ids[:, None], self.columns] = self.share * kd / kp

    def command(
        self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray
    ) -> np.ndarray:
        last, speed, sent = self.begun(targets, memory), memory["speed"], dt_s > 0
        speed[sent] = (targets - last)[sent] / dt_s[sent, None]
        last[sent] = targets[sent]
        return self.replaced(targets, targets + memory["lead_s"] * speed)
