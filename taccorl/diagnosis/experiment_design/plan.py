"""Choose the recording to make next: the one that best separates rival explanations after a refit (T-optimal design).

T-optimal design (Atkinson and Fedorov 1975): for rivals A and B and a recording, a measurement is simulated with A, and B with
all its numbers is fitted to it; the residual in noise floors is the discrimination, the smaller one of both directions. Below
about one floor the recording would not separate the rivals. Existing recordings are part of both fits.

What is recorded is a ``Part`` with a library as data: motions of a joint (``motions``), presses of pads (``presses``), loads of
cells (``loads``). Where its library separates two rivals nowhere, it is tried with the motor's effort recorded, too.
"""

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from taccorl.diagnosis.machines.machine import Machine
from taccorl.diagnosis.search.fit import fit, rms, stacked
from taccorl.diagnosis.search.problem import Problem, Recording, Values, chosen
from taccorl.diagnosis.search.solve import Startable
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

TELLS = 1.25
"""Discrimination [noise floors] from which on a recording separates two rivals: √(1 + 1.25²) = 1.6."""
SAME = 0.25
"""Two effects count as the same if they differ by less than so many floors on every motion."""
STEPS = 12
"""Most steps of the solver in a refit."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A recording that could be made, with its discrimination between rivals."""

    part: "Part"
    """What a planned motion is to be recorded of: a joint, a pair of pads, a sensor's cells."""
    item: Any
    """The motion or press of the library."""
    columns: Mapping[str, np.ndarray]
    """Table of what to command: column → (T,) values."""
    peak: float
    """Largest effort with the carried weight [N·m, N], force on a pad [N], or load of a cell in its unit."""
    made: Any = field(repr=False, compare=False)
    """The planned recording as a measurement; of a joint with the effort that it needs, (T,) [N·m, N]."""
    ways: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """"a | b" → residual [floors] after a refit of b to data simulated with a, and of a to data simulated with b."""

    @property
    def name(self) -> str:
        """Name of the motion or press, and of the condition in which it is recorded if that is not the present one."""
        return "_".join(filter(None, (self.item.name, self.part.label)))

    @property
    def discrimination(self) -> dict[str, float]:
        """Pair "a | b" → discrimination in noise floors, the smaller of both directions."""
        return {pair: min(ways) for pair, ways in self.ways.items()}

    @property
    def worst(self) -> float:
        """Smallest discrimination over all pairs of rivals [floors]."""
        return min(self.discrimination.values(), default=0.0)

    @property
    def mean(self) -> float:
        """Mean discrimination over all pairs of rivals [floors]; 0 without a pair."""
        return (
            float(np.mean(list(self.discrimination.values())))
            if self.discrimination
            else 0.0
        )


class Explanation(NamedTuple):
    """An explanation of the recordings: one effect with all fitted numbers of the part."""

    values: Values
    """All fitted numbers of the part, those of the effect included."""
    effect: Effect
    """The effect with these values."""


class Scene:
    """A recording that could be made, in the form for the search.

    Args:
        problem: search problem with it.
        recordings: existing recordings, followed by the one that could be made.
    """

    def __init__(self, problem: Startable, recordings: Sequence[Recording]) -> None:
        self.problem, self.recordings = problem, recordings

    def told(
        self, rivals: Sequence[str], fitted: Mapping[str, Values]
    ) -> dict[str, Explanation]:
        """Name of each rival → its explanation, with the numbers that were ``fitted`` with it, or typical values.

        Raises:
            TaccorlError: a rival is not a candidate of the problem.
        """
        found = {}
        for c in chosen(self.problem, rivals):
            typical = {f.name: f.start for f in c.frees} | c.starts[len(c.starts) // 2]
            values = dict(self.problem.start) | typical | fitted.get(c.name, {})
            found[c.name] = Explanation(values=values, effect=c.make(values))
        return found

    def said(
        self, truth: Explanation, other: Explanation, effects: Sequence[Effect]
    ) -> tuple[Problem, Sequence[Recording]]:
        """Problem and recordings as ``truth`` with its ``effects`` gives them, for a fit of ``other``."""
        return self.problem, [
            dataclasses.replace(
                r, measured=self.problem.simulate(truth.values, effects, r)
            )
            for r in self.recordings
        ]

    def left(self, truth: Explanation, other: Explanation) -> float:
        """Residual RMS [noise floors] on the last recording after fitting ``other`` to data simulated from ``truth``. Effects of
        the file are in both, and their numbers are fitted, too."""
        rivals = (truth.effect.name, other.effect.name)
        present = [name for name in self.problem.present if name not in rivals]
        own = [
            self.problem.candidates[name].make(self.problem.start) for name in present
        ]
        problem, said = self.said(truth, other, [*own, truth.effect])
        model = fit(problem, said, (*present, other.effect.name), other.values, STEPS)
        return rms(stacked(problem, model.values, model.effects, said[-1:]))


class Part(ABC):
    """A part of a machine for which recordings are planned: how they are limited, made and simulated."""

    machine: Machine
    name: str
    """Name of the part: ``left_joint5``, ``left pads``."""
    library: Sequence[Any]
    """Motions or presses from which is chosen."""
    floor: float
    """Noise floor: of a joint's position [rad, m], or of a taxel's or cell's row in its unit."""
    rate_hz: float
    """Rate of the planned tables of targets or loads [rows/s], that of the recordings."""
    label: str = ""
    """Word for the condition of the recordings in names of files, ``with_efforts``; empty for the present one."""
    where: str = ""
    """Text of this condition."""
    pose: Mapping[str, float] = {}
    """Positions of the arm's other joints and gripper meanwhile [rad, m]; empty for presses."""

    @abstractmethod
    def offer(self, item: Any, suspected: Mapping[str, Explanation]) -> Planned:
        """The recording of a motion or press of the library, without scores.

        Args:
            suspected: explanations at whose limits motions are aimed.

        Raises:
            TaccorlError: it must not be recorded; the message says which limit it exceeds.
        """

    @abstractmethod
    def scene(self, p: Planned) -> Scene:
        """``p`` in the form for the search, as the machine's model answers it."""

    def aimed(self, rivals: Sequence[str]) -> Sequence[Any]:
        """Further motions, which are aimed at the suspected limits of ``rivals``."""
        return ()

    def reach(self, p: Planned, told: Mapping[str, Explanation]) -> dict[str, float]:
        """Rival that does nothing below a limit → how far ``p`` goes toward it, 1 at the limit."""
        return {}

    def with_efforts(self) -> "Part | None":
        """The part with the motor's effort recorded, too; None if it is recorded already, or cannot be."""
        return None


@dataclass(frozen=True)
class Plan:
    """Recordings that could be made for one part, best first."""

    part: str
    rivals: tuple[str, ...]
    floor: float
    """Noise floor, as ``Part.floor``."""
    planned: tuple[Planned, ...]
    refused: dict[str, str]
    """Motion or press → reason why it must not be recorded."""
    reaches: dict[str, float] = field(default_factory=dict)
    """Rival that does nothing below a limit → how far the motions go toward it, 1 at the limit; empty if there is none, or they
    were not aimed."""
    tried: dict[str, dict[str, float]] = field(default_factory=dict)
    """Text of another condition in which the library was tried → pair of rivals that nothing separated before → the best
    discrimination there [floors]."""

    @property
    def hopeless(self) -> tuple[str, ...]:
        """Pairs ("a | b") of rivals that no recording of the plan separates: ``best`` is below 1.25 floors."""
        pairs = [f"{a} | {b}" for a, b in itertools.combinations(self.rivals, 2)]
        return tuple(pair for pair in pairs if self.best(pair) < TELLS)

    @property
    def separates_nothing(self) -> bool:
        """Whether no recording of the plan separates any two of the rivals, whichever of them is true."""
        return all(max(ways) < TELLS for p in self.planned for ways in p.ways.values())

    def best(self, pair: str) -> float:
        """Discrimination of ``pair`` ("a | b") on the recording that separates it best [floors]; 0 if nothing may be recorded."""
        return max((p.discrimination[pair] for p in self.planned), default=0.0)

    def at_first(self, pair: str) -> float:
        """The same on the recordings in the present condition."""
        return max(
            (p.discrimination[pair] for p in self.planned if not p.part.label),
            default=0.0,
        )

    def one_way(self) -> Iterator[tuple[str, str, Planned, float]]:
        """Of hopeless pairs: the pair, one of its effects, and the recording that shows best if that one is the truth, with its
        residual [floors]. Where one effect contains the other (friction that depends on the direction contains friction that
        does not), only its own motions separate them."""
        for pair in self.hopeless:
            for k, truth in enumerate(pair.split(" | ")):
                scored = [(p.ways[pair][k], p) for p in self.planned]
                apart, best = max(scored, key=lambda one: one[0], default=(0.0, None))
                if best is not None and apart >= TELLS:
                    yield pair, truth, best, apart

    def written(self, num: int) -> tuple[Planned, ...]:
        """The first ``num`` recordings, best first, with those that alone separate a pair or show one of its effects."""
        needed = {p.name for _, _, p, _ in self.one_way()}
        for pair in {pair for p in self.planned for pair in p.ways} - {*self.hopeless}:
            tells = [p.name for p in self.planned if p.discrimination[pair] >= TELLS]
            first = [p.name for p in self.planned[:num]]
            needed |= set() if {*tells} & {*first} else {tells[0]}
        rest = [p.name for p in self.planned if p.name not in needed][
            : max(num - len(needed), 0)
        ]
        return tuple(p for p in self.planned if p.name in needed or p.name in rest)


def in_file(machine: Machine, part: str) -> list[str]:
    """Names of the effects that the machine's file has at ``part``, without those that it states as absent."""
    values = machine.numbers(part)
    names = dict.fromkeys(name.split(".", 1)[0] for name in values if "." in name)
    return [
        name
        for name in names
        if any(
            values[f"{name}.{p.name}"][0] != p.absent
            for p in effects.get(name).parameters()
            if p.absent is not None
        )
    ]


def check_rivals(machine: Machine, part: str, rivals: Sequence[str]) -> None:
    """Check that there are effects to separate.

    Raises:
        TaccorlError: there are fewer than two, or the machine's file has one of them.
    """
    if len(set(rivals)) < max(len(rivals), 2):
        raise TaccorlError(
            f"give two or more effects to separate, each once, found {', '.join(rivals) or 'none'}"
        )
    if there := [name for name in in_file(machine, part) if name in rivals]:
        raise TaccorlError(
            f"the file of {machine.name} has {' and '.join(there)} at {part} already; what is in the file is fitted beside every "
            "rival, so that no recording separates it from them"
        )


def plan(
    part: Part,
    rivals: Sequence[str],
    fitted: Mapping[str, Values] | None = None,
    done: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Plan:
    """Score every motion or press of the part's library, best first. Where they separate a pair of rivals by nothing, the same
    with the motor's effort recorded; of those the recordings that separate such a pair, or show an effect of it.

    Args:
        rivals: effects to separate, two or more.
        fitted: effect → all numbers of the part with it, if it was fitted; otherwise typical values are used.
        done: function that is called with the name of each motion or press that was scored, and (number done, number in all).

    Raises:
        TaccorlError: there are fewer than two rivals, or one is in the file or cannot act on the part.
    """
    found = scored(part, rivals, fitted or {}, done)
    pairs, other = found.hopeless, part.with_efforts()
    if not pairs or other is None:
        return found
    more = scored(other, rivals, fitted or {}, done)
    shown = {(pair, truth) for pair, truth, _, _ in found.one_way()}
    needed = [
        p.name
        for pair, truth, p, _ in more.one_way()
        if pair in pairs and (pair, truth) not in shown
    ]
    needed += [
        p.name
        for p in more.planned
        if any(p.discrimination[pair] >= TELLS for pair in pairs)
    ]
    kept = [p for p in more.planned if p.name in needed]
    return dataclasses.replace(
        found,
        planned=best_first([*found.planned, *kept]),
        tried={other.where: {pair: more.best(pair) for pair in pairs}},
    )


def scored(
    part: Part,
    rivals: Sequence[str],
    fitted: Mapping[str, Values],
    done: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Plan:
    """As ``plan``, in the present condition of the part alone."""
    check_rivals(part.machine, part.name, rivals)
    planned, refused, reaches = [], {}, {}
    suspected: Mapping[str, Explanation] = {}
    every = [*part.library, *part.aimed(rivals)]
    for k, item in enumerate(every, 1):
        try:
            offer = part.offer(item, suspected)
        except TaccorlError as error:
            refused[item.name] = str(error)
        else:
            scene = part.scene(offer)
            told = scene.told(rivals, fitted)
            suspected = suspected or told
            pairs = itertools.combinations(rivals, 2)
            ways = {
                f"{a} | {b}": (
                    scene.left(told[a], told[b]),
                    scene.left(told[b], told[a]),
                )
                for a, b in pairs
            }
            planned.append(dataclasses.replace(offer, ways=ways))
            for name, far in part.reach(offer, told).items():
                reaches[name] = max(far, reaches.get(name, 0.0))
        done(item.name, k, len(every))
    return Plan(
        part.name, tuple(rivals), part.floor, best_first(planned), refused, reaches
    )


def best_first(planned: Sequence[Planned]) -> tuple[Planned, ...]:
    """``planned``, sorted by ``worst`` and then by ``mean``, the largest first."""
    return tuple(sorted(planned, key=lambda p: (-p.worst, -p.mean)))
