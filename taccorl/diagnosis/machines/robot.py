"""Any robot or axis as a machine: ``kind: robot``, or an axis file, which is written as a
robot without a model (``alignment.machines.robot_file``). Its parts are its joints."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, cast

import numpy as np

from taccorl.alignment.checks.columns import check_columns
from taccorl.alignment.checks.effort_time import check_effort_time, law_of_all
from taccorl.alignment.checks.registry import find
from taccorl.alignment.checks.robot import check_robot
from taccorl.alignment.controller.joint_model import JointModel, JointResponse
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.controller.rigid_joint import NEED_ROTOR, rigid_terms, weighs
from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.alignment.machines.robot_joint import PAYLOAD_AT
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import compare_joints
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.diagnosis.machines.changed_findings import (
    TILT,
    lacked,
    left_of,
    numbers_off,
    payload_of,
    payloads,
    placed,
    remarked,
    standing_in,
    without_numbers,
    without_payload,
    without_tilt,
)
from taccorl.diagnosis.machines.machine import (
    Addition,
    Counted,
    Diagnosed,
    Drive,
    Finding,
    GainsAre,
    Machine,
    machines,
    numbers_of,
)
from taccorl.diagnosis.problems.joint_problem import SPEED_DELAY, JointProblem
from taccorl.diagnosis.problems.joints import (
    JointFinding,
    apart,
    diagnose_joint,
    drifts_of,
    moves,
    of_joints,
)
from taccorl.diagnosis.problems.one_mass import ALIKE, OneMass, is_better, one_mass
from taccorl.diagnosis.problems.one_tilt import one_tilt
from taccorl.diagnosis.problems.tilted_base import (
    MOST_LEFT,
    change_between_poses,
    tilt_like,
)
from taccorl.diagnosis.remark import Remark
from taccorl.diagnosis.search.drift import Drift
from taccorl.diagnosis.search.evidence import above_floor, block_squares
from taccorl.diagnosis.search.problem import candidate, split_rows
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload
from taccorl.sim.effects.scaled import Scale
from taccorl.sim.twin_file import write_whole

How = tuple[Measurements, GainsAre, Diagnosed]
"""What ``RobotMachine.reconsidered`` is given besides the findings."""
OF_POSITION = (
    "cable_spring",
    "cogging",
    "gravity_mismatch",
    "position_dependent_friction",
    "unbalance",
)
"""Effects with a torque that depends on the position of the joint, as that of a weight does."""
CLEAR_FLOORS = 3.0
"""Largest error [noise floors] of a joint with a shared payload at which it helps to say where the mass is (a choice)."""
ONE_POSE = {"rad": 0.3, "m": 0.1}
"""Unit → range of positions of another joint within which it counts as standing in one pose (a choice)."""


@machines.register("axis")
@machines.register("robot")
@dataclass(frozen=True)
class RobotMachine(Machine):
    """A robot described by a robot file, and by an MJCF or URDF file if it has a model."""

    robot: Robot
    """Content of the robot file, and its model."""
    name: str
    """The file's stem."""
    part_word: ClassVar[str] = "joint"

    @classmethod
    def load(cls, path: Path) -> Self:
        return cls(load_robot(path), Path(path).stem)

    def save(self, path: Path) -> None:
        write_whole(path, self.robot.text(path))

    def digest(self) -> str:
        return self.robot.digest()

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(
            dict.fromkeys(
                e.name
                for joint in self.robot.config.joints.values()
                for e in joint.effects
            )
        )

    def numbers(self, part: str) -> dict[str, tuple[float, str]]:
        config, joint = self.robot.config.joints[part], self.robot.joint(part)
        times = ["position_age_s", "target_late_s"]
        own = dict(config.numbers)
        if config.inertia is not None:
            own = {"inertia": (config.inertia, "kg·m²"), **own}
            times = ["target_late_s", "speed_late_s"]
            weights = ("weight_sin", "weight_cos")
            for name in weights if joint.unit == "rad" else weights[1:]:
                own[name] = (getattr(config, name), "N·m")
        own |= {name: (getattr(config, name), "s") for name in times}
        return {
            n: (value, Scale(unit=joint.unit).unit_of(unit))
            for n, (value, unit) in own.items()
        } | numbers_of(config.effects)

    @property
    def units(self) -> Mapping[str, str]:
        return self.robot.units

    # measurements ----------------------------------------------------------------------------------------------------

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Recording → findings: positions or efforts beyond their limits, an impossible inertia, missing columns."""
        found: dict[str, list[DataFinding]] = {}
        own = {
            j: [self._whole(m) for m in measurements.all if moves(m, j)]
            for j in self.robot.config.joints
        }
        fits = {
            name: law_of_all(law, own[name], name)
            for name, law in self.robot.config.joints.items()
        }
        for m in measurements.all:
            found[m.name] = check_robot(
                self.robot,
                m,
                self._whole(m),
                [name for name in own if moves(m, name)],
                fits,
            )
        check_columns(self.robot, own, found)
        for name, law in self.robot.config.joints.items():
            check_effort_time(
                law,
                own[name],
                found,
                name,
                self.robot.path.name,
                self.robot.joint(name).inertia_kgm2,
            )
        for name, own_drifts in self._drifts(measurements).items():
            for drift in own_drifts:
                text = f"{name}: {drift.words}"
                found[drift.second].append(find("drift", name, text))
        return found

    def _drifts(self, measurements: Measurements) -> dict[str, list[Drift]]:
        """Joint → its numbers that changed between recordings of one motion."""
        moved = {
            name: of_joints(measurements, [name]) for name in self.robot.config.joints
        }
        return {
            name: drifts_of(self.robot, name, own)
            for name, own in moved.items()
            if own.fit
        }

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        for m in measurements.all:
            self._whole(m)
        found = tuple(
            s
            for s in self.robot.config.joints
            if any(moves(m, s) for m in measurements.fit)
        )
        if not found:
            raise TaccorlError(
                f"no fit recording moves a joint of {self.robot.path} by 2 mrad (2 mm) or more; record a sweep of each: "
                "± 0.3 rad (of a slide a third of its range), 0.1 to 2 Hz, 10 s, twice"
            )
        return found

    def _compared(
        self, measurements: Measurements, name: str, progress: Counted
    ) -> Comparison:
        laws = self.robot.config.joints
        drifted = [d for own in self._drifts(measurements).values() for d in own]
        measurements = apart(measurements, drifted)
        return compare_joints(
            self.robot,
            laws,
            measurements,
            self._whole,
            name=name,
            file=self.robot.path.name,
            effects=self.effects,
            uncertain=[s for s, law in laws.items() if law.is_uncertain],
            by_motion=True,
            progress=progress,
        )

    def diagnose(
        self, part: str, measurements: Measurements, **options: Any
    ) -> Finding:
        found = diagnose_joint(self.robot, part, measurements, **options)
        if not self.robot.config.model:
            return found
        if any(
            "payload" in own
            for own in (found.diagnosis.names, *found.diagnosis.rivals.values())
        ):
            body, file, far = (
                self._payload_body(found),
                self.robot.rigid.path.name,
                self.robot.reach_m(part),
            )
            name = self.robot.body_name(body)
            text = f"payload in {name}: x_m, y_m and z_m are along its axes in {file}, within ± {far:.3g} m of its centre of mass"
            if idle := self.robot.idle_axes(part, body):
                text += f"; {part} does not feel {' and '.join('xyz'[axis] for axis in idle)}"
            if own := [
                p.mass_kg for f in payloads([found]) if (p := payload_of(f)).like_link
            ]:
                times = 1.0 + own[0] / self.robot.rigid.model.body_mass[body]
                text = f"mass and inertia of {name} are {times:.4g} times those in {file}: correct them there"
            found = dataclasses.replace(found, remark=text)
        if (
            found.diagnosis.status == "something_else"
            and not self.robot.config.joints[part].rotor_inertia
        ):
            text = f"{' and '.join(NEED_ROTOR)} were not tried: {self.robot.path.name} has no rotor_inertia of {part}"
            found = remarked(found, text)
        others = self._in_one_pose(part, measurements)
        lacked = [
            n
            for n in found.diagnosis.names
            if n in OF_POSITION and n not in found.diagnosis.present
        ]
        if others and lacked:
            found = dataclasses.replace(
                found,
                diagnosis=dataclasses.replace(
                    found.diagnosis, one_pose=dict.fromkeys(lacked, others)
                ),
            )
        if tilt := self._tilt(found, measurements):
            found = remarked(found, tilt)
        if (
            self.robot.config.joints[part].law != "impedance"
            or "torque_speed_limit" not in found.diagnosis.names
        ):
            return found
        text = (
            f"{part} has law impedance in {self.robot.path.name}. A drive that sets its motor's voltage (a hobby servo's) has a "
            "torque-speed limit where its duty is clipped: if it is one, write `law: pwm` with supply_v, resistance_ohm and "
            "torque_nm_per_a instead of the effect"
        )
        return remarked(found, text)

    def _in_one_pose(self, part: str, measurements: Measurements) -> tuple[str, ...]:
        """Joints before and behind ``part`` if all of them stood within ``ONE_POSE`` in all recordings that move it, also if the
        recordings do not have them; else empty."""
        others = self.robot.along_chain(part)
        for name in others:
            own = [
                m.moved(name)
                for m in of_joints(measurements, [part]).all
                if name in m.signals
            ]
            seen = np.concatenate(
                [np.zeros(0), *(positions[np.isfinite(positions)] for positions in own)]
            )
            if seen.size and np.ptp(seen) > ONE_POSE[self.units[name]]:
                return ()
        return others

    def _tilt(self, found: JointFinding, measurements: Measurements) -> Remark | None:
        """By how much the base would have to be tilted so that gravity gives the torque of the effect
        ``unbalance``, in the poses of the fit recordings. None if ``unbalance`` was neither added nor tied with the added
        effect, or if the error is at the floor in poses between which that torque would differ."""
        d = found.diagnosis
        values = (
            [dict(d.after.values)]
            if "unbalance" in d.names and "unbalance" not in d.present
            else []
        )
        values += [
            e.values
            for r in d.rounds
            if "unbalance" in r.ties
            for e in r.evidence
            if e.name == "unbalance"
        ]
        if not values:
            return None
        own = [self._whole(m) for m in of_joints(measurements, [found.part]).fit]
        numbers = (
            values[0][f"unbalance.{name}"] for name in ("torque_nm", "hangs_at_rad")
        )
        down = tilt_like(self.robot, found.part, own, *numbers)
        if down is None:
            return None
        if (
            d.status == "at_floor"
            and change_between_poses(self.robot, found.part, own, down) > MOST_LEFT
        ):
            return None  # an equal torque in poses in which a tilt has others
        g = self.robot.rigid.model.opt.gravity
        leans = np.degrees(np.arccos(np.clip(down @ g / np.linalg.norm(g), -1.0, 1.0)))
        gravity = f"[{', '.join(f'{x:.4f}' for x in down + 0.0)}]"
        values = {"degrees": float(leans), "part": found.part, "gravity": gravity}
        return Remark(TILT, values | {"file": self.robot.path.name})

    def reconsidered(
        self,
        findings: Sequence[Finding],
        measurements: Measurements,
        gains: GainsAre,
        diagnosed: Diagnosed,
    ) -> list[Finding]:
        """A payload that was found at one joint is in the model when the other joints that move its body are diagnosed again.
        Where no joint alone determines its mass and place, or several found one, one mass is fitted to all joints
        (``one_mass``). So is what else was found at a joint, where it changes the error of others that lack less. One tilt of
        the base is fitted to all joints where several lack what it would explain (``one_tilt``)."""
        if not self.robot.config.model:
            return list(findings)
        how = measurements, gains, diagnosed
        return self._with_one_tilt(
            self._beside_larger(self._with_payloads(findings, how), how),
            measurements,
            gains,
        )

    def _beside_larger(self, findings: Sequence[Finding], how: How) -> list[Finding]:
        """``findings`` with those of joints that were judged again beside what was found at joints that lack more, where that
        changes their error: a joint's acceleration is what its drive in the file makes of its targets, and loads the others."""
        measurements, gains, diagnosed = how
        done: dict[str, Finding] = {}
        masses = [
            f for f in payloads(findings) if not f.diagnosis.rivals.get("payload")
        ]
        for f in sorted(
            findings,
            key=lambda f: -f.diagnosis.errors[f.diagnosis.baseline]["validation"],
        ):
            larger = [
                o for o in done.values() if lacked(o) and "payload" not in lacked(o)
            ]
            done[f.part] = f
            if not larger or "payload" in lacked(f):
                continue
            machine, _ = self.mended(others := [*masses, *larger])
            problem = machine._problem_of(f, measurements, gains)
            left = block_squares(
                problem,
                f.diagnosis.after,
                problem.validation or split_rows(problem.fit)[1],
            )
            if 1.0 / ALIKE < above_floor(left) / left_of(f) < ALIKE:
                continue
            (again,) = diagnosed(machine, [f.part])
            most = ALIKE if len(lacked(again)) <= len(lacked(f)) else 1.0 / ALIKE
            if left_of(again) <= most * left_of(f):
                what = " and ".join(
                    f"{' and '.join(lacked(o))} of {o.part}" for o in others
                )
                text = f"judged with {what}: mend {' and '.join(o.part for o in others)} first"
                done[f.part] = remarked(
                    again, f"{text}, or all at once, and diagnose {f.part} again"
                )
        return [done[f.part] for f in findings]

    def _with_one_tilt(
        self, findings: Sequence[Finding], measurements: Measurements, gains: GainsAre
    ) -> list[Finding]:
        """``findings`` with a remark on one tilt of the base in place of those on single joints, where it explains what several
        hinges lack, or where it does not hold at all of them."""
        group = {
            f.part: f
            for f in findings
            if self.units[f.part] == "rad"
            and self.robot.config.joints[f.part].law != "effort"
        }
        stands_for = {
            part: names
            for part, f in group.items()
            if (names := standing_in(f.diagnosis, "unbalance"))
        }
        if len(group) < 2 or not stands_for:
            return list(findings)
        problems = {
            part: self._problem_of(f, measurements, gains) for part, f in group.items()
        }
        found = one_tilt(
            self.robot,
            problems,
            {part: f.diagnosis for part, f in group.items()},
            stands_for,
        )
        if not found.disagree and not found.is_simpler:
            return list(findings)
        if found.disagree:
            errors = [
                f"{with_it:.2f} instead of {alone:.2f} noise floors at {j}"
                for j, (alone, with_it) in found.disagree.items()
            ]
            text = f"no tilt of the base explains {' and '.join(group)} together: it would leave {', '.join(errors)}"
        else:
            text = found.words(stands_for, self.robot.path.name)
            leaned = {
                part: dataclasses.replace(
                    cast(JointFinding, f), leaned=found.joints[part]
                )
                for part, f in group.items()
            }
            findings = [leaned.get(f.part, f) for f in findings]
        return [
            remarked(without_tilt(f), text) if f.part in stands_for else f
            for f in findings
        ]

    def _with_payloads(
        self, given: Sequence[Finding], how: How, sure: bool = True
    ) -> list[Finding]:
        """``sure``: a payload that one joint alone determines stays, unless joints that move it end with a larger error, or need
        other numbers of the file with it, which one mass at all of them makes superfluous."""
        findings = given
        for body in dict.fromkeys(self.robot.last_body(f.part) for f in given):
            findings = self._with_one_mass(body, findings, how, sure)
        owners = [
            f for f in payloads(findings) if not f.diagnosis.rivals.get("payload")
        ]
        shared = {f.part: self._payload_body(f) for f in owners if payload_of(f).link}
        owners = [
            f
            for f in owners
            if not any(
                self.robot.moves_body(f.part, shared[p]) for p in {*shared} - {f.part}
            )
        ]
        owners = [f for f in owners if f.part in self._owners(owners)]
        felt = {
            f.part: owner
            for owner in owners
            for f in findings
            if f.part not in {o.part for o in owners}
            and self.robot.moves_body(f.part, self._payload_body(owner))
        }
        if not felt:
            return list(findings)
        again: dict[str, Finding] = {}
        for f in how[2](
            self.with_additions(
                [Addition(f.part, [payload_of(f)], {}, {}) for f in owners]
            ),
            list(felt),
        ):
            mass, body = (
                payload_of(felt[f.part]),
                self.robot.body_name(self._payload_body(felt[f.part])),
            )
            text = (
                f"judged with the payload of {mass.mass_kg:.3g} kg in {body} that this diagnosis found at "
                f"{felt[f.part].part}: add both, or the payload first and diagnose {f.part} again"
            )
            again[f.part] = remarked(without_numbers(f, felt[f.part]), text)
        judged = [(f, again[f.part]) for f in given if f.part in again]
        worse = any(left_of(now) > ALIKE * left_of(f) for f, now in judged)
        if sure and (
            worse or any({*numbers_off(now)} - {*numbers_off(f)} for f, now in judged)
        ):
            together = self._with_payloads(given, how, sure=False)
            if worse or payloads(together):
                return together
        return [again.get(f.part, f) for f in findings]

    def _with_one_mass(
        self, body: int, findings: Sequence[Finding], how: How, sure: bool
    ) -> list[Finding]:
        """``findings`` with one payload in place of what several joints lack, if it holds with fewer numbers at all that move
        it: in ``body`` or a link before it that leaves less. Without a payload if it holds in none of them."""
        robot, (measurements, gains, diagnosed) = self.robot, how
        group = {f.part: f for f in findings if robot.last_body(f.part) == body}
        stands_for = {
            part: found
            for part, f in group.items()
            if (found := standing_in(f.diagnosis, "payload"))
        }
        tied = [part for part, f in group.items() if f.diagnosis.rivals.get("payload")]
        alone = [
            part
            for part, names in stands_for.items()
            if "payload" in names and part not in tied
        ]
        loaded = any(weighs(rigid_terms(robot.rigid.model, part)) for part in alone)
        if not stands_for or (sure and loaded and len(alone) == 1):
            return list(
                findings
            )  # weight that turns with a joint shows where the mass is
        if len(group) == 1 and not alone and self.units[next(iter(group))] == "rad":
            return list(
                findings
            )  # one vertical hinge tells a mass from a rotor in no way
        (owner,) = self._owners([group[part] for part in alone or stands_for])
        at_centre, made = (
            dict.fromkeys(PAYLOAD_AT, 0.0),
            dict[tuple[str, int], JointProblem](),
        )

        def fitted(parts: Sequence[str], assumed: Payload) -> OneMass:
            place = robot.body_of(owner, assumed)
            parts = [part for part in parts if robot.moves_body(part, place)]
            machine, own = (
                self._assuming(owner, assumed),
                {"link": assumed.link, "like_link": assumed.like_link},
            )
            for part in [part for part in parts if (part, place) not in made]:
                made[part, place] = machine._problem_of(
                    group[part], measurements, gains
                )
            problems = {part: made[part, place] for part in parts}
            idle = set.intersection(
                *({*robot.idle_axes(part, place)} for part in parts)
            )
            at = (
                at_centre
                if assumed.like_link
                else {PAYLOAD_AT[axis]: 0.0 for axis in sorted(idle)}
            )
            mass = candidate(
                machine.robot.joint(owner).in_units(Payload), {}, **own, **at
            )
            return one_mass(
                problems,
                {part: group[part].diagnosis for part in parts},
                stands_for,
                mass,
            )

        places = [
            (link, spread)
            for spread in (False, True)
            for link in ("", *robot.links_before(body))
        ]
        tried = [
            Payload(mass_kg=0.0, link=link, like_link=spread, **at_centre)
            for link, spread in places
        ]
        first = found = fitted([*group], tried[0])
        every = [first]
        for one in tried[1:]:
            if all(
                robot.moves_body(part, robot.body_of(owner, one))
                for part in alone or stands_for
            ):
                every.append(fitted([*group], one))
                least = (
                    0.0
                    if one.like_link > found.payload.like_link
                    else SearchConfig().sure_score
                )  # fewer numbers
                found = (
                    every[-1] if is_better(every[-1], found, first, least) else found
                )
        bodies = [
            robot.body_of(owner, o.payload)
            for o in every
            if o.holds and not is_better(found, o, first)
        ]
        ties = {robot.body_name(k) for k in bodies} - {
            robot.body_name(robot.body_of(owner, found.payload))
        }
        if not found.holds:
            added = [part for part, names in stands_for.items() if "payload" in names]
            again = (
                {f.part: f for f in diagnosed(self, added, ["payload"])}
                if added
                else {}
            )
            findings = [again.get(f.part, f) for f in findings]
            return [
                without_payload(f, list(group)) if f.part in stands_for else f
                for f in findings
            ]
        if not (found.is_simpler or alone):
            mass, where = (
                found.payload.mass_kg,
                robot.body_name(robot.body_of(owner, found.payload)),
            )
            text = (
                f"one mass of {mass:.3g} kg in {where} explains as much at {' and '.join(stands_for)}, with as many numbers: "
                "record a joint that weight loads, or one more that moves it"
            )
            return [
                remarked(f, text) if len(stands_for) > 1 and f.part in stands_for else f
                for f in findings
            ]
        clear = [part for part in found.errors if found.errors[part] <= CLEAR_FLOORS]
        if len(clear) < len(
            found.errors
        ):  # what other joints lack besides must not say where the mass is
            found = fitted(clear or [owner], found.payload)
        left_out = [name for name in stands_for[owner] if name != "payload"]
        (again,) = diagnosed(self._assuming(owner, found.payload), [owner], left_out)
        if "payload" not in again.diagnosis.names:
            return list(findings)
        return [
            placed(again, found.model, stands_for, sorted(ties))
            if f.part == owner
            else f
            for f in findings
        ]

    def _payload_body(self, found: Finding) -> int:
        """Id of the body of the payload that a finding adds, or would add."""
        own = [self.robot.body_of(found.part, payload_of(f)) for f in payloads([found])]
        return own[0] if own else self.robot.last_body(found.part)

    def _assuming(self, part: str, payload: Payload) -> "RobotMachine":
        """The machine in which a search assumes the place of the payload of ``part``."""
        assumed = {self.robot.body_of(part, payload): self.robot.mass(part, payload)}
        return dataclasses.replace(
            self, robot=dataclasses.replace(self.robot, assumed=assumed)
        )

    def mended(self, findings: Sequence[Finding]) -> "tuple[RobotMachine, str]":
        """The machine with what was found, and a sentence on what was not written. If several joints that move the same body each
        have a payload, only the one whose mass has the narrowest relative interval is written: it is the same mass. If one tilt
        of the base explains several joints, it is written as ``gravity``, with the numbers that were fitted beside it."""
        leaned = {
            f.part: own
            for f in findings
            if (own := cast(JointFinding, f).leaned) is not None
        }
        found = payloads(findings)
        kept = self._owners(found)
        left = [f.part for f in found if f.part not in kept]
        additions = []
        for f in findings:
            own = leaned.get(f.part, f.diagnosis)
            written = [
                e for e in own.effects if e.name != "payload" or f.part not in left
            ]
            additions.append(Addition(f.part, written, own.base, own.intervals))
        machine = self
        for own in leaned.values():  # which all have the same
            config = dataclasses.replace(self.robot.config, gravity=[*own.gravity])
            machine = dataclasses.replace(
                self, robot=dataclasses.replace(self.robot, config=config)
            )
        text = f"the payload of {' and '.join(left)} is not written: it is the mass that was found at {' and '.join(kept)}"
        return machine.with_additions(additions), text * bool(left)

    def changes_as_a_whole(self, findings: Sequence[Finding]) -> list[str]:
        """The direction of gravity, if one tilt of the base explains several joints."""
        found = {
            own.gravity
            for f in findings
            if (own := cast(JointFinding, f).leaned) is not None
        }
        return [
            f"gravity [{', '.join(f'{x:.4f}' for x in gravity)}]" for gravity in found
        ]

    def _owners(self, findings: Sequence[Finding]) -> set[str]:
        """Of joints with a payload in the same body the one that determines its mass best; without a payload the nearest one."""

        def unsure(f: Finding) -> tuple[float, int]:
            low, high = f.diagnosis.intervals.get("payload.mass_kg", (0.0, math.inf))
            return (high - low) / max(low, -high, 1e-9), -self.robot.rigid.model.joint(
                f.part
            ).id

        owners: dict[int, Finding] = {}
        for f in sorted(findings, key=unsure):
            owners.setdefault(self._payload_body(f), f)
        return {f.part for f in owners.values()}

    @property
    def fitted_gains(self) -> tuple[str, ...]:
        return tuple(
            name
            for name, joint in self.robot.config.joints.items()
            if joint.gains == "fitted"
        )

    @property
    def effort_limits(self) -> Mapping[str, float]:
        return {
            name: j.effort_limit
            for name, j in self.robot.config.joints.items()
            if j.effort_limit is not None
        }

    @property
    def command_rates(self) -> Mapping[str, float]:
        return {
            n: law.command_hz or 0.0
            for n, law in self.robot.config.joints.items()
            if law.law != "effort"
        }

    def drive(self, part: str) -> Drive:
        joint, c = self.robot.joint(part), self.robot.config.joints[part]
        return Drive(
            joint.unit,
            joint.known.limits,
            c.effort_limit,
            c.target_kind,
            c.law != "pwm",
        )

    def answer(self, part: str, m: Measurement) -> JointResponse:
        model = JointModel(self.robot, part)
        return model.simulate(
            motion_of(model.joint.whole(m), part, model.joint), model.gains
        )

    def motion_problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> JointProblem:
        return JointProblem(
            self.robot, part, of_joints(measurements, [part]), gains=gains
        )

    def _problem_of(
        self, f: Finding, measurements: Measurements, gains: GainsAre
    ) -> JointProblem:
        """``motion_problem`` of one part in which effects of the file that its diagnosis did not fit stay."""
        held = {e.name for e in self.robot.config.joints[f.part].effects} - {
            *f.diagnosis.present
        }
        return JointProblem(
            self.robot,
            f.part,
            of_joints(measurements, [f.part]),
            gains=gains,
            held=held,
        )

    # effects ---------------------------------------------------------------------------------------------------------

    def effect(self, name: str, part: str, values: Mapping[str, Any]) -> Effect | None:
        joint = self.robot.joint(part)
        if joint.selectors(effects.get(name)) is None:
            return None
        own = {
            key: value for key, value in values.items() if key not in ("arm", "joints")
        }
        return joint.made(name, **own)

    def with_additions(self, additions: Sequence[Addition]) -> "RobotMachine":
        robot = self.robot
        for a in additions:
            config = robot.config.joints[a.part].with_numbers(a.base)
            joint = robot.joint(a.part)  # bounds of a search may be narrower
            new = [
                joint.made(e.name, **{key: getattr(e, key) for key in e.settings()})
                for e in a.effects
            ]
            if "speed_delay_s" in a.base:  # in the file beyond a whole period
                half_s = 0.5 * float(a.base.get("loop_s", 0.0))
                delay_s = max(a.base["speed_delay_s"] - half_s, -SPEED_DELAY.high)
                new.append(joint.made("speed_delay", delay_s=delay_s))
            kept = [e for e in config.effects if e.name not in {n.name for n in new}]
            effects_ = [*kept, *(e for e in new if not e.is_absent)]
            config = dataclasses.replace(config, effects=effects_)
            robot = robot.with_joint(a.part, config)
        if (wrong := robot.wrong_mass())[0]:
            raise TaccorlError(wrong[1])
        return dataclasses.replace(self, robot=robot)

    def _whole(self, m: Measurement) -> Measurement:
        return self.robot.joint(next(iter(self.robot.config.joints))).whole(m)
