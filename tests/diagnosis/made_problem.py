"""A problem whose answers can be written down: a measurement is a sum of known signals, each effect adds one of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from taccorl.diagnosis.search.problem import (
    Candidate,
    Free,
    Recording,
    WithoutMaps,
    candidate,
)
from taccorl.sim.effects.effect import Effect, number

RATE_HZ = 200.0


@dataclass(kw_only=True)
class Added(Effect):
    """strength × signal; ``signal`` of the subclass."""

    slot: ClassVar = "robot"

    @classmethod
    def signal(cls, t: np.ndarray, seed: int) -> np.ndarray:
        raise NotImplementedError

    def acts_on(self) -> list[str]:
        return ["it"]


def _strength(low: float = 0.0) -> float:
    return number("s", "1", 0.0, 1.0, (low, 50.0), "made up")


@dataclass(kw_only=True)
class Ripple(Added):
    name: ClassVar = "ripple"
    strength: float = _strength()

    @classmethod
    def signal(cls, t: np.ndarray, seed: int) -> np.ndarray:
        return np.sin(40.0 * t + seed)


def kind(
    name: str,
    signal: Callable[[np.ndarray, int], np.ndarray],
    base: type[Added] = Ripple,
    **more: Any,
) -> type[Added]:
    """A new effect class called ``name``: it adds ``signal(times, seed)`` (T,) to a trace, and has the parameters of ``base``."""
    return dataclass(kw_only=True)(
        type(name, (base,), {"name": name, "signal": staticmethod(signal)} | more)
    )


Bump = kind("bump", lambda t, seed: np.exp(-(((t - 0.6) / 0.1) ** 2)))
"""In the first second only: its share of all blocks is small."""


@dataclass(kw_only=True)
class Square(Added):
    """Of either sign."""

    name: ClassVar = "square"
    strength: float = _strength(low=-50.0)

    @classmethod
    def signal(cls, t: np.ndarray, seed: int) -> np.ndarray:
        return drive(t, seed) ** 2


@dataclass(kw_only=True)
class Squire(Square):
    """The same but for a thousandth: nothing tells them apart. It needs a number more."""

    name: ClassVar = "squire"
    strength: float = _strength(low=-50.0)
    idle: float = number("i", "1", None, 1.0, (0.5, 2.0), "made up")

    @classmethod
    def signal(cls, t: np.ndarray, seed: int) -> np.ndarray:
        return Square.signal(t, seed) + 0.001 * np.sin(7.0 * t)


Hidden = kind(
    "hidden", lambda t, seed: drive(t, seed)
)  # As what the gain does: no recording shows it


def drive(t: np.ndarray, seed: int) -> np.ndarray:
    """What is commanded."""
    return np.sin((1.0 + 0.1 * seed) * t) + 0.3 * np.sin(2.7 * t + seed)


class MadeProblem(WithoutMaps):
    """measured = gain × drive + offset + effects."""

    base = (
        Free(name="gain", unit="1", start=1.0, low=0.01, high=100.0, log=True),
        Free(name="offset", unit="1", start=0.0, low=-10.0, high=10.0),
    )

    def __init__(self, *classes: type[Added]) -> None:
        self.candidates: dict[str, Candidate] = {
            cls.name: candidate(cls, {}) for cls in classes
        }

    def simulate(
        self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording
    ) -> np.ndarray:
        t, seed = recording.time_s, recording.data
        total = base["gain"] * drive(t, seed) + base["offset"]
        for effect in effects:
            total = total + vars(effect)["strength"] * effect.signal(t, seed)
        return total[:, None]


def record(
    seed: int,
    *effects: Added,
    gain: float = 3.0,
    offset: float = 0.4,
    noise: float = 0.1,
    seconds: float = 10.0,
    extra: np.ndarray | float = 0.0,
) -> Recording:
    t, rng = np.arange(0.0, seconds, 1.0 / RATE_HZ), np.random.default_rng(1000 + seed)
    total = gain * drive(t, seed) + offset + extra + noise * rng.standard_normal(len(t))
    for effect in effects:
        total = total + vars(effect)["strength"] * effect.signal(t, seed)
    return Recording(
        name=f"made {seed}",
        time_s=t,
        measured=total[:, None],
        floor=np.array([noise]),
        channels=("it [1]",),
        data=seed,
    )
