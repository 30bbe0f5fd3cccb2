"""Dropped commands: now and then a command is lost, and the drive keeps the one before it."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter

STRIDE, _FIRST, _SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
"""Constants of SplitMix64: the increment between two numbers of a stream, and the factors of its finaliser."""
_WORD = 0xFFFFFFFF


@effects.register("dropped_commands")
@dataclass(kw_only=True)
class DroppedCommands(JointEffect):
    """Commands that are lost: r_k = q*_k with probability 1 − p, else r_{k−1}; the controller's target is r.

    Each command is lost independently of the others, for all selected joints at once, because they travel in one message. The
    lost commands follow from ``seed``, the episode's seed and the number k of commands since the reset. The commands that are
    lost at a small p are also lost at a greater p. The effect acts after ``command_lag`` and before ``slew_limit``,
    ``velocity_feedforward`` and ``command_delay``. Random numbers are those of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014),
    which the compiled one-joint model draws, too.

    No search fits the effect: two recordings of one motion lose different commands, so that no p reproduces a measurement.
    """

    name: ClassVar = "dropped_commands"
    needs: ClassVar = ("target",)
    equation: ClassVar = "r_k = q*_k with probability 1 − p, else r_{k−1}; τ = K_p (r − q) − K_d q̇ + T_ref"
    in_words: ClassVar = (
        "A busy bus or computer loses a command now and then; the drive keeps the one before until the next arrives."
    )
    at_a_policy: ClassVar = "Motion stutters, the more the faster it is, and differently each time."
    to_record: ClassVar = "The same fast chirp at least twice: what differs between them does not repeat."
    near_twins: ClassVar = {
        "command_delay": "On average commands are older by p / (1 − p) periods; a delay repeats, drops do not: record twice.",
    }
    fitted: ClassVar = False
    possible: ClassVar = (*ROBOT.joints, "gripper")
    probability: float = parameter(
        unit="1",
        symbol="p",
        absent=0.0,
        low=0.0,
        high=0.95,
        typical=0.1,
        source="a choice; one in ten shows in a second of motion",
    )
    seed: int = 0
    """Seed of the bus: with another seed other commands are lost."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed <= _WORD:
            raise TaccorlError(f"effect {self.name}: seed is {self.seed!r}; give a whole number in 0 … {_WORD}")

    def drive(self) -> dict[str, float]:
        return {"drop_probability": self.probability, "drop_seed": float(self.seed)}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {
            "target": np.full((num_sims, ROBOT.num_actions), np.nan),
            "count": np.zeros(num_sims),
            "episode": np.zeros(num_sims),
        }

    def begin(self, memory: Memory, ids: np.ndarray, seeds: np.ndarray) -> None:
        seeds = np.asarray(seeds, dtype=np.uint64)
        memory["episode"][ids] = (seeds ^ (seeds >> np.uint64(32))) & np.uint64(_WORD)

    def command(self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        held, sent = memory["target"], dt_s > 0
        lost = uniform(self.seed, memory["episode"], memory["count"]) < self.probability
        keeps = np.where(sent, lost, True)[:, None] & ~np.isnan(held)
        held[:] = np.where(keeps, held, targets)
        memory["count"] += sent
        targets = targets.copy()
        targets[:, self.columns] = held[:, self.columns]
        return targets


def uniform(seed: int | np.ndarray, episode: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Random numbers in [0, 1), float64, for buses (``seed``), episodes and commands (``count``), each given by whole numbers
    below 2³²: arrays (…) of one shape, or that broadcast to it. They are the same on every machine.
    """
    # Arrays of at least one number: they wrap around, scalars warn.
    key = (np.atleast_1d(seed).astype(np.uint64) << np.uint64(32)) + np.asarray(episode, dtype=np.uint64)
    bits = mixed(mixed(key) + (np.asarray(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(STRIDE))
    return (bits >> np.uint64(11)) * 2.0**-53


def mixed(bits: Any) -> Any:
    """Scramble 64-bit numbers (finaliser of the SplitMix64 generator): arrays (…) uint64 here, single numbers in the compiled
    ``joint_kernel``."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(_FIRST)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(_SECOND)
    return bits ^ (bits >> np.uint64(31))
