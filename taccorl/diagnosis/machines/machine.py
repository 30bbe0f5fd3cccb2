"""What is compared with measurements and diagnosed: the PiPER's twin, or another machine that a file describes.

The commands ``compare``, ``diagnose`` and ``add-effect`` use a ``Machine`` only by the methods here. ``load_machine`` reads which
kind a file describes from its key ``kind:``; a file without that key is a ``twin.yaml`` of the PiPER.

A new kind is one module in ``taccorl/diagnosis/machines/`` with one class under ``@machines.register("kind")``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self

from taccorl.alignment.measurements.folder import Measurements, read_measurements
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.data.finding import Finding as DataFinding
from taccorl.data.finding import listed
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.diagnosis.problems.joints import each
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.problem import Recording
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.solve import Startable, solve
from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.sim.effects.effect import Effect

GainsAre = Literal["auto", "commanded", "fitted"]
"""``auto``: gains that every recording states stay fixed, others are fitted."""


class Finding(Protocol):
    """What was found out about one part of a machine."""

    @property
    def part(self) -> str:
        """As tables and reports call it."""
        ...

    @property
    def diagnosis(self) -> Diagnosis: ...

    @property
    def can_tell(self) -> Identifiability:
        """What its recordings can show and tell apart, whatever they say."""
        ...

    @property
    def known(self) -> Known | None:
        """The numbers that the recordings identify; None where that is not worked out."""
        ...

    @property
    def noise(self) -> str:
        """Noise floors in words."""
        ...

    @property
    def numbers(self) -> str:
        """Where the always fitted numbers are from, in words."""
        ...

    @property
    def measured(self) -> str:
        """Channels whose errors are counted, in words."""
        ...

    @property
    def recordings(self) -> dict[str, tuple[str, ...]]:
        """fit, validation, test → names."""
        ...

    @property
    def rows_split(self) -> bool:
        """No recording was marked for validation: the last rows of each were used."""
        ...

    @property
    def remark(self) -> str:
        """What the search could not judge; empty if there is nothing."""
        ...


@dataclass(frozen=True, kw_only=True)
class PartFinding:
    """A ``Finding`` of a part that needs nothing special."""

    part: str
    diagnosis: Diagnosis
    can_tell: Identifiability
    noise: str
    numbers: str
    measured: str
    recordings: dict[str, tuple[str, ...]]
    rows_split: bool
    known: Known | None = None
    remark: str = ""


class Addition(NamedTuple):
    """What is written into a machine's file at one part."""

    part: str
    effects: Sequence[Effect]
    """Those that are added, and those of the file that were refitted with them."""
    base: Mapping[str, float]
    """Always fitted numbers, refitted with them; empty: they stay."""
    intervals: Mapping[str, Sequence[float]]
    """Number → 95 % interval."""


class PartProblem(Startable, Protocol):
    """A problem with the recordings that it is solved on."""

    fit: Sequence[Recording]
    validation: Sequence[Recording]
    test: Sequence[Recording]
    noise: str
    numbers: str
    measured: str


class Machine(ABC):
    """A machine as a file describes it. Machines are values: methods that change something return another one."""

    name: str
    """For titles and tables: the file's stem."""
    part_word: ClassVar[str] = "part"
    """What messages call one of its parts: joint, axis, pad."""
    saved_words: ClassVar[str] = "compare and diagnose load it"
    """Use of a file that ``save`` has written."""

    @property
    def file_name(self) -> str:
        """Name of the file, in the folder of the report, that ``diagnose --until=noise_floor`` writes the mended machine to."""
        return f"{self.name}.yaml"

    @classmethod
    @abstractmethod
    def load(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            SpecError: with file, line and key.
        """

    @abstractmethod
    def save(self, path: Path) -> None:
        """Write a file that ``load`` reads as the same machine; it is replaced as a whole or not at all."""

    @abstractmethod
    def digest(self) -> str:
        """16 hexadecimal digits that two machines share only if they are the same."""

    @property
    @abstractmethod
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that it has."""

    @property
    @abstractmethod
    def units(self) -> Mapping[str, str]:
        """Signal → unit of its position (rad, m), for tables without a columns file."""

    def read(
        self, path: Path, *, spec: str | None = None, columns: Path | None = None, validation_every: int | None = None
    ) -> Measurements:
        """Recordings of it, as ``read_measurements`` reads them."""
        return read_measurements(path, spec=spec, columns=columns, validation_every=validation_every, units=self.units)

    # measurements ----------------------------------------------------------------------------------------------------

    of_joints: ClassVar[bool] = True
    """Whether its recordings are of joints, which the checks of telemetry judge."""

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Recording → findings that only this machine can make, such as positions beyond its limits."""
        return {}

    @abstractmethod
    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        """Parts that the fit recordings excite, so that something can be found out about them.

        Raises:
            TaccorlError: none; names what to record.
        """

    def select(self, parts: Sequence[str], joints: Sequence[str], pads: Sequence[str]) -> tuple[str, ...]:
        """Those of ``parts`` that ``--joints`` and ``--pads`` name; all if neither is given.

        Raises:
            TaccorlError: a name that is none of them.
        """
        if pads:
            raise TaccorlError(f"--pads={pads[0]}: {self.name} has no pads; leave --pads out")
        known = [*self.units] or parts
        for name in joints:
            if name not in known:
                raise TaccorlError(f"--joints={name}: no such {self.part_word}; {nearest(name, known)}")
            if name not in parts:
                raise TaccorlError(
                    f"--joints={name}: no fit recording moves it; those that are moved: {listed(list(parts))}"
                )
        return tuple(p for p in parts if not joints or p in joints)

    @abstractmethod
    def compare(
        self,
        measurements: Measurements,
        *,
        name: str = "",
        pressed: PressedObject | None = None,
        progress: Callable[[str, int, int], None] = lambda recording, done, total: None,
    ) -> Comparison:
        """Simulate every recording's commands, and keep what is left.

        Args:
            name: for titles; the machine's own if empty.
            pressed: object between the PiPER's fingers in recordings that do not state one.
            progress: called with (recording, recordings done, recordings in all).
        """

    def problem(self, part: str, measurements: Measurements, gains: GainsAre) -> PartProblem:
        """One part as a problem for the search; kinds with a ``diagnose`` of their own need none."""
        raise NotImplementedError

    def diagnose(
        self,
        part: str,
        measurements: Measurements,
        *,
        gains: GainsAre = "auto",
        search: SearchConfig | None = None,
        without: Sequence[str] = (),
    ) -> Finding:
        """Search for the effect that is missing at one part.

        Args:
            without: effects that are not considered.
        """
        return solved(part, self.problem(part, measurements, gains), search, without)

    # effects ---------------------------------------------------------------------------------------------------------

    @abstractmethod
    def effect(
        self, name: str, part: str, values: Mapping[str, Any], base: Mapping[str, float] | None = None
    ) -> Effect | None:
        """The effect of that name at one part; None if it cannot act there.

        Args:
            values: its parameters, interval and evidence, and whatever else its fields hold where a report gives them.
            base: always fitted numbers of the diagnosis that fitted it.

        Raises:
            TaccorlError: unknown effect or parameter, or a value out of bounds.
        """

    def by_hand(
        self, name: str, joints: Sequence[str], pads: Sequence[str], values: Mapping[str, float]
    ) -> list[Addition]:
        """An effect with numbers by hand at the parts that are named; at the only part if the machine has one.

        Raises:
            TaccorlError: it cannot act there, or no part is named.
        """
        if not joints and len(self.units) > 1:
            raise TaccorlError(f"{name}: which {self.part_word}? --joints={next(iter(self.units))}")
        found = []
        for part in self.select(tuple(self.units), joints, pads):
            effect = self.effect(name, part, {**values, "evidence": "by hand"})
            if effect is None:
                raise TaccorlError(f"{name} cannot act on {part}")
            found.append(Addition(part, [effect], {}, {}))
        return found

    @abstractmethod
    def with_additions(self, additions: Sequence[Addition]) -> Self:
        """A copy of the machine with these effects and numbers; an effect of the same name at the same part is replaced.

        Raises:
            TaccorlError: parts that share a number need different ones.
        """

    def mended(self, findings: Sequence[Finding]) -> tuple[Self, str]:
        """With all that was found, and why a part of it could not be written; empty if all was."""
        found = [Addition(f.part, f.diagnosis.effects, f.diagnosis.base, f.diagnosis.intervals) for f in findings]
        return self.with_additions(found), ""

    def refitted(self, findings: Sequence[Finding]) -> Self:
        """With the always fitted numbers refitted and no further effect: what effects are credited against."""
        firsts = [(f.part, f.diagnosis.before) for f in findings]
        return self.with_additions([Addition(part, b.effects, b.values, b.intervals()) for part, b in firsts])

    def option_of(self, part: str) -> list[str]:
        """Options with which ``taccorl add-effect`` must name this part although it was diagnosed."""
        return []


def solved(
    part: str, problem: PartProblem, search: SearchConfig | None = None, without: Sequence[str] = ()
) -> PartFinding:
    """``solve`` of a problem that holds its recordings.

    Raises:
        TaccorlError: nothing was measured in the validation rows.
    """
    found = solve(part, problem, problem.fit, problem.validation, problem.test, search, without)
    return PartFinding(
        part=part,
        diagnosis=found.diagnosis,
        can_tell=found.can_tell,
        noise=problem.noise,
        numbers=problem.numbers,
        measured=problem.measured,
        recordings={use: tuple(r.name for r in getattr(problem, use)) for use in ("fit", "validation", "test")},
        rows_split=found.rows_split,
    )


machines: Registry[type[Machine]] = Registry("kind of machine", "taccorl.diagnosis.machines")


def diagnose_parts(
    machine: Machine,
    parts: Sequence[str],
    measurements: Measurements,
    *,
    gains: GainsAre = "auto",
    search: SearchConfig | None = None,
    without: Sequence[str] = (),
    workers: int = 1,
    done: Callable[[str], None] = lambda _: None,
) -> list[Finding]:
    """Several parts, ``workers`` at a time; the same for any number of them.

    Args:
        done: called with each part that is finished.
    """
    one = partial(machine.diagnose, measurements=measurements, gains=gains, search=search, without=without)
    return each(one, parts, workers, done)
