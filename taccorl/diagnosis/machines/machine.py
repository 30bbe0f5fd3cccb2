"""Base class of machines that are compared with measurements and diagnosed: the PiPER's twin, or another one described by a file.

The commands ``compare``, ``diagnose`` and ``add-effect`` use a ``Machine`` only by the methods here. ``load_machine`` reads which
kind a file describes from its key ``kind:``; a file without that key is a ``twin.yaml`` of the PiPER.

A new kind is one module in ``taccorl/diagnosis/machines/`` with one class under ``@machines.register("kind")``.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self

from taccorl.alignment.controller.joint_model import JointResponse
from taccorl.alignment.measurements.folder import Measurements, read_measurements
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.data.finding import Finding as DataFinding
from taccorl.data.finding import listed
from taccorl.diagnosis.comparison.result import USES, Comparison
from taccorl.diagnosis.problems.joints import each
from taccorl.diagnosis.problems.shared import ALIKE, SharedFit, left_of
from taccorl.diagnosis.remark import Remark
from taccorl.diagnosis.search.problem import Progress, Stopped, no_progress
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.solve import PartFinding as Finding
from taccorl.diagnosis.search.solve import PartProblem, RecordedProblem, solved
from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

Counted = Callable[[str, int, int], None]
"""Function that is called with (recording, number of recordings done, number in all)."""
GainsAre = Literal["auto", "commanded", "fitted"]
"""Treatment of gains. ``auto``: gains that every recording states stay fixed, others are fitted."""


class Addition(NamedTuple):
    """Changes of a machine's file for one part."""

    part: str
    effects: Sequence[Effect]
    """Effects to add, and effects of the file that were refitted with them."""
    base: Mapping[str, float]
    """Always fitted numbers that were refitted with the effects; empty: they are not changed."""
    intervals: Mapping[str, Sequence[float]]
    """Name of a number → (low, high) of its 95 % interval."""


class Drive(NamedTuple):
    """Facts about a part that a motion to be recorded must respect."""

    unit: str
    """Unit of its position: rad or m."""
    limits: tuple[float, float] | None
    """Lowest and highest position [rad, m] as the file or the model states them; None if not stated."""
    effort_limit: float | None
    """Largest effort of the motor [N·m, N]; None if not stated."""
    target_kind: TargetKind
    """Quantity that it takes as target."""
    logs_effort: bool
    """False for hobby servos (law pwm), which measure none."""


class Diagnosed(Protocol):
    """Function that diagnoses parts of a machine."""

    def __call__(
        self, machine: "Machine", some: Sequence[str], leave_out: Sequence[str] = ()
    ) -> list[Finding]:
        """Findings of the parts ``some``, searched without the effects ``leave_out``."""
        ...


class Machine(ABC):
    """A machine as described by a file. Machines are immutable: methods that change something return a new one."""

    name: str
    """Name for titles and tables: the file's stem."""
    part_word: ClassVar[str] = "part"
    """Word for one of its parts in messages: joint, axis, pad."""
    saved_words: ClassVar[str] = "compare and diagnose load it"
    """Text that completes messages about a file that ``save`` has written: what the file is for."""

    def __repr__(self) -> str:
        effects = ", ".join(self.effects) or "no effects"
        return f"{type(self).__name__} {self.name!r}: {effects}"

    @property
    def file_name(self) -> str:
        """Name of the file in the report's folder to which ``diagnose --until=noise_floor`` writes the corrected machine."""
        return f"{self.name}.yaml"

    @classmethod
    @abstractmethod
    def load(cls, path: Path) -> Self:
        """Load a machine from a file.

        Raises:
            SpecError: the file is invalid; the message names file, line and key.
        """

    @abstractmethod
    def save(self, path: Path) -> None:
        """Write a file from which ``load`` reads the same machine; it is replaced as a whole or not at all."""

    @abstractmethod
    def digest(self) -> str:
        """Digest of the machine, 16 hexadecimal digits; only equal machines have equal digests."""

    @property
    @abstractmethod
    def effects(self) -> tuple[str, ...]:
        """Names of the machine's effects."""

    @abstractmethod
    def numbers(self, part: str) -> dict[str, tuple[float, str]]:
        """Name → (value, unit) of the numbers of one part that ``with_additions`` may change, as the file has them: ``kp``, or
        ``EFFECT.PARAMETER`` of its effects."""

    @property
    @abstractmethod
    def units(self) -> Mapping[str, str]:
        """Signal → unit of its position (rad, m), for tables without a columns file."""

    def read(
        self,
        path: Path,
        *,
        spec: str | None = None,
        columns: Path | None = None,
        validation_every: int | None = None,
        fit_needed: bool = True,
    ) -> Measurements:
        """Read recordings of the machine, divided into fit, validation and test; arguments and errors are those of
        ``read_measurements``."""
        return read_measurements(
            path,
            spec=spec,
            columns=columns,
            validation_every=validation_every,
            units=self.units,
            fit_needed=fit_needed,
        )

    # measurements ----------------------------------------------------------------------------------------------------

    of_joints: ClassVar[bool] = True
    """True if its recordings are of joints, so that the checks of telemetry apply."""

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Recording → findings of checks specific to this kind of machine, such as positions beyond its limits."""
        return {}

    @abstractmethod
    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        """Names of the parts that the fit recordings excite, so that they can be diagnosed. Raises TaccorlError: there are none;
        the message states what to record."""

    def select(
        self, parts: Sequence[str], joints: Sequence[str], pads: Sequence[str]
    ) -> tuple[str, ...]:
        """Parts of the machine that ``--joints`` and ``--pads`` name; all ``parts`` if neither is given. Raises TaccorlError: the
        machine has no part of that name."""
        if pads:
            raise TaccorlError(
                f"--pads={pads[0]}: {self.name} has no pads; remove --pads"
            )
        known = [*self.units] or parts
        for name in joints:
            if name not in known:
                raise TaccorlError(
                    f"--joints={name}: no such {self.part_word}; {nearest(name, known)}"
                )
            if name not in parts:
                raise TaccorlError(
                    f"--joints={name}: no fit recording moves this {self.part_word}; moved are: {listed(list(parts))}"
                )
        return tuple(p for p in parts if not joints or p in joints)

    def compare(
        self,
        measurements: Measurements,
        *,
        name: str = "",
        pressed: PressedObject | None = None,
        progress: Counted = lambda recording, done, total: None,
    ) -> Comparison:
        """Simulate every recording's commands, and compute the residuals.

        Args:
            name: name for titles; the machine's own if empty.
            pressed: object between the PiPER's fingers in recordings that do not state one.
            progress: function that is called with (recording, number of recordings done, number in all).
        """
        if pressed is not None:
            raise TaccorlError(f"--pressed: {self.name} has no pads; remove the option")
        return self._compared(measurements, name or self.name, progress)

    def _compared(
        self, measurements: Measurements, name: str, progress: Counted
    ) -> Comparison:
        """``compare``, for kinds without pads."""
        raise NotImplementedError

    def of_part(self, part: str, measurements: Measurements) -> Measurements:
        """What ``diagnose`` of one part reads of ``measurements``; its worker gets no more."""
        return measurements

    def problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> PartProblem:
        """Search problem of one part. Kinds that override ``diagnose`` need not implement it."""
        raise NotImplementedError

    def diagnose(
        self,
        part: str,
        measurements: Measurements,
        *,
        gains: GainsAre = "auto",
        search: SearchConfig | None = None,
        without: Sequence[str] = (),
        progress: Progress = no_progress,
    ) -> Finding:
        """Search for the effect that is missing at one part.

        Args:
            measurements: recordings of all parts; those that excite this part are used.
            gains: treatment of the part's gains.
            search: criteria of acceptance; the default ones if not given.
            without: effects that are left out of the search.
            progress: function that is called with a text about the present step.
        """
        return solved(
            part, self.problem(part, measurements, gains), search, without, progress
        )

    @property
    def fitted_gains(self) -> tuple[str, ...]:
        """Parts whose gains in the file are only the start of a fit, because nobody knows them."""
        return ()

    @property
    def effort_limits(self) -> Mapping[str, float]:
        """Joint or axis → limit of its motor's effort in the machine's file [N·m; N if it slides], where one is stated."""
        return {}

    @property
    def command_rates(self) -> Mapping[str, float]:
        """Joint or axis → rate at which its drive receives targets [Hz]; 0, or left out, if the machine's file states none."""
        return {}

    # motions ---------------------------------------------------------------------------------------------------------

    def drive(self, part: str) -> Drive:
        """Limits of one part's motion. Raises TaccorlError: the machine has no motions, or no such part."""
        raise TaccorlError(
            f"{self.name}: no command plans motions for it; its parts are no joints or axes"
        )

    def answer(self, part: str, m: Measurement) -> JointResponse:
        """Simulated answer of one part to the targets of ``m``, from rest where ``m`` was measured first."""
        raise NotImplementedError

    def motion_problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> RecordedProblem:
        """Search problem of one joint or axis, for ``taccorl excite`` and ``taccorl surrogate``; equal to ``problem`` by default.

        Args:
            measurements: recordings, and simulated measurements of motions that have not been recorded.
        """
        return self.problem(part, measurements, gains)

    # effects ---------------------------------------------------------------------------------------------------------

    @abstractmethod
    def effect(self, name: str, part: str, values: Mapping[str, Any]) -> Effect | None:
        """Make the effect of that name at one part; None if it cannot act there.

        Args:
            values: its parameters, interval and evidence, and other fields if a report states them.

        Raises:
            TaccorlError: the effect or a parameter is unknown, or a value is out of bounds.
        """

    def by_hand(
        self,
        name: str,
        joints: Sequence[str],
        pads: Sequence[str],
        values: Mapping[str, float],
    ) -> list[Addition]:
        """Additions for an effect with values by hand, one for each named part; for the only part if the machine has one.

        Args:
            joints, pads: names of parts, as in ``select``.
            values: parameter → value.

        Raises:
            TaccorlError: the effect cannot act there, or no part is named.
        """
        if not joints and len(self.units) > 1:
            raise TaccorlError(
                f"{name}: which {self.part_word}? --joints={next(iter(self.units))}"
            )
        return self._by_hand(name, self.select(tuple(self.units), joints, pads), values)

    def _by_hand(
        self, name: str, parts: Sequence[str], values: Mapping[str, float]
    ) -> list[Addition]:
        found = []
        for part in parts:
            effect = self.effect(name, part, {**values, "evidence": "by hand"})
            if effect is None:
                raise TaccorlError(f"{name} cannot act on {part}")
            found.append(Addition(part, [effect], {}, {}))
        return found

    @abstractmethod
    def with_additions(self, additions: Sequence[Addition]) -> Self:
        """A copy of the machine with these effects and numbers; an effect of the same name at the same part is replaced.

        Raises:
            TaccorlError: parts that share a number need different values of it.
        """

    def reconsidered(
        self,
        findings: Sequence[Finding],
        measurements: Measurements,
        gains: GainsAre,
        diagnosed: "Diagnosed",
    ) -> list[Finding]:
        """``findings``, with other findings of those parts that an effect found at another part changes.

        Args:
            measurements, gains: as for ``diagnose``.
            diagnosed: function that diagnoses parts of a machine.
        """
        return list(findings)

    def shared_by(
        self, alone: Mapping[str, Finding], found: SharedFit, diagnosed: "Diagnosed"
    ) -> dict[str, Finding]:
        """Findings of parts by this machine, which has the numbers ``found`` that they
        share; empty if one of them ends with a larger error than ``alone``, without."""
        name = found.effect.name
        without = [name] if name in effects else []
        again = diagnosed(self, [*alone], without)
        for f in again:
            left = left_of(f.diagnosis)
            if left > ALIKE * left_of(alone[f.part].diagnosis):
                return {}
        remark = Remark("shared", {"name": name, "joints": [*alone]})
        return {f.part: remarked(f, remark) for f in again}

    def without_shared(
        self,
        findings: Sequence[Finding],
        group: Collection[str],
        stands_for: Collection[str],
        name: str,
        diagnosed: "Diagnosed",
    ) -> list[Finding]:
        """``findings`` with a remark that no effect ``name`` explains all parts of
        ``group``. Those that may have it alone are diagnosed without it."""
        remark = Remark("shared_without", {"name": name, "joints": [*group]})
        again = {f.part: f for f in findings if f.part in stands_for}
        if name in effects:
            again = {f.part: f for f in diagnosed(self, [*again], [name])}
        told = {part: remarked(f, remark) for part, f in again.items()}
        return [told.get(f.part, f) for f in findings]

    def mended(self, findings: Sequence[Finding]) -> tuple[Self, str]:
        """Copy of the machine with everything that was found, and text: why a part of it could not be written, or empty."""
        found = [
            Addition(
                f.part, f.diagnosis.effects, f.diagnosis.base, f.diagnosis.intervals
            )
            for f in findings
        ]
        return self.with_additions(found), ""

    def refitted(self, findings: Sequence[Finding]) -> Self:
        """The machine with no effect added, and with the numbers refitted that every fit adjusts, to compare errors with."""
        firsts = [(f.part, f.diagnosis.before) for f in findings]
        return self.with_additions(
            [
                Addition(
                    part,
                    b.effects,
                    {f.name: b.values[f.name] for f in b.frees},
                    b.intervals(),
                )
                for part, b in firsts
            ]
        )

    def option_of(self, part: str) -> list[str]:
        """Command-line options with which ``taccorl add-effect`` must name this part, such as ["--pads=left"]; empty if the
        diagnosis determines it."""
        return []


def remarked[FindingT: Finding](f: FindingT, *remarks: str | Remark) -> FindingT:
    """The finding with more remarks about its result."""
    every: tuple[Any, ...] = (*f.diagnosis.remarks, *remarks)
    d = dataclasses.replace(f.diagnosis, remarks=every)
    return dataclasses.replace(f, diagnosis=d)


def numbers_of(effects: Iterable[Effect]) -> dict[str, tuple[float, str]]:
    """``EFFECT.PARAMETER`` → (value, unit) of these effects."""
    return {
        f"{e.name}.{p.name}": (getattr(e, p.name), p.unit)
        for e in effects
        for p in e.parameters()
    }


machines: Registry[type[Machine]] = Registry(
    "kind of machine", "taccorl.diagnosis.machines"
)
"""Kinds of machines, by the word after ``kind:`` in a file."""


SAME_ERROR = 0.05
"""Largest relative difference of the errors of one file with the same noise floors."""


def as_written(
    findings: Sequence[Finding],
    before: Comparison,
    later: Mapping[str, Comparison | None],
) -> list[Finding]:
    """``findings`` with the errors of the files that are compared and written.

    A fit simulates how joints load each other by the drives of the file as it is, and may
    free numbers that no file states, such as the scale of reported efforts.

    Args:
        before: comparison of the file as it is.
        later: "fitted", "after" → comparison of that file, or None if it was not compared.
            A part keeps the errors of its fit if it is
            no joint, if rows were split off for validation, or if its fit had other noise
            floors, as that of an axis whose motions were never repeated.
    """
    return [_as_written(f, before, {"before": before, **later}) for f in findings]


def _as_written(
    f: Finding, before: Comparison, replays: Mapping[str, Comparison | None]
) -> Finding:
    errors = f.diagnosis.errors
    own = {
        stage: {
            use: error
            for use in USES
            if use in errors[stage] and (error := c.error(f.part, use)) is not None
        }
        for stage, c in replays.items()
        if c is not None
    }
    first, bounds = own["before"], before.of(f.part)
    compared = first.keys() == errors["before"].keys()
    other_floors = any(t.floor.lower_bound for t in bounds) and any(
        abs(error - errors["before"][use]) > SAME_ERROR * error
        for use, error in first.items()
    )
    if f.rows_split or not compared or other_floors:
        return f
    diagnosis = dataclasses.replace(f.diagnosis, errors={**errors, **own})
    return dataclasses.replace(f, diagnosis=diagnosis)


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
    progress: Callable[[str, str], None] = no_progress,
) -> list[Finding]:
    """Findings of several parts, in the order of ``parts``, ``workers`` at the same time; they do not depend on ``workers``.
    ``Machine.reconsidered`` may diagnose parts again with an effect that was found at another part.

    Args:
        without: effects that are left out of the search.
        done: function that is called with each finished part.
        progress: function that is called with (part, text about the present step), in the process of the part if ``workers`` is
            above 1. Parts in which it raises ``Stopped`` before an effect was added are left out.
    """

    def diagnosed(
        machine: Machine,
        some: Sequence[str],
        leave_out: Sequence[str] = (),
        done: Callable[[str], None] = lambda _: None,
    ) -> list[Finding | None]:
        options = {"gains": gains, "search": search, "without": (*without, *leave_out)}
        items = {part: (part, machine.of_part(part, measurements)) for part in some}
        return each(
            partial(_diagnosed, machine, progress, options), items, workers, done
        )

    def again(
        machine: Machine, some: Sequence[str], leave_out: Sequence[str] = ()
    ) -> list[Finding]:
        if len(
            found := [f for f in diagnosed(machine, some, leave_out) if f is not None]
        ) < len(some):
            raise Stopped
        return found

    found = [f for f in diagnosed(machine, parts, done=done) if f is not None]
    try:
        return machine.reconsidered(found, measurements, gains, again)
    except Stopped:
        return found


def _diagnosed(
    machine: Machine,
    progress: Callable[[str, str], None],
    options: Mapping[str, Any],
    item: tuple[str, Measurements],
) -> Finding | None:
    part, measurements = item
    try:
        return machine.diagnose(
            part, measurements, **options, progress=partial(progress, part)
        )
    except Stopped:
        return None
