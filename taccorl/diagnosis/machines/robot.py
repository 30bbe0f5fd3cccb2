"""Any robot or axis as a machine: ``kind: robot``, or an axis file, which is written as a
robot without a model (``alignment.machines.robot_file``). Its parts are its joints."""

import dataclasses
import itertools
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
from taccorl.alignment.controller.rigid_joint import NEED_ROTOR
from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.alignment.machines.robot_joint import PAYLOAD_AT, TiltedBase
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import compare_joints
from taccorl.diagnosis.comparison.result import Comparison
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
    remarked,
)
from taccorl.diagnosis.problems.joint_problem import SPEED_DELAY, JointProblem
from taccorl.diagnosis.problems.joints import (
    apart,
    diagnose_joint,
    drifts_of,
    moves,
    of_joints,
)
from taccorl.diagnosis.problems.shared import (
    ALIKE,
    SharedFit,
    beside_alone,
    left_of,
    shared_fit,
    standing_in,
    with_effect,
)
from taccorl.diagnosis.remark import Remark
from taccorl.diagnosis.search.drift import Drift
from taccorl.diagnosis.search.evidence import above_floor, block_squares
from taccorl.diagnosis.search.problem import Candidate, candidate, split_rows
from taccorl.diagnosis.search.result import Changed, Diagnosis, SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload
from taccorl.sim.effects.scaled import Scale, bounded

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
GRAVITY = tuple(f"gravity_{axis}" for axis in "xyz")
"""Numbers of a robot file: unit vector along gravity in the frame of its model."""
ONE_POSE = {"rad": 0.3, "m": 0.1}
"""Unit → range of positions of another joint within which it counts as standing in one pose (a choice)."""


@machines.register("axis")
@machines.register("robot")
@dataclass(frozen=True, repr=False)
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
        self.robot.save(path)

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
        if self.robot.config.model:
            direction = map(float, self._down())
            own |= {n: (x, "1") for n, x in zip(GRAVITY, direction, strict=True)}
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
        d = found.diagnosis
        if any("payload" in own for own in (d.names, *d.rivals.values())):
            place = self._place(part, payload_of(found))
            found = dataclasses.replace(found, remark=place)
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

    def _place(self, part: str, payload: Payload | None) -> str:
        """Text on the place of a payload that was, or would be, added at a joint."""
        robot, file = self.robot, self.robot.rigid.path.name
        body = robot.last_body(part)
        if payload is not None:
            body = robot.body_of(part, payload)
        name = robot.body_name(body)
        if payload is not None and payload.like_link:
            times = 1.0 + payload.mass_kg / robot.rigid.model.body_mass[body]
            return f"mass and inertia of {name} are {times:.4g} times those in {file}: correct them there"
        text = (
            f"payload in {name}: x_m, y_m and z_m are along its axes in {file}, "
            f"within ± {robot.reach_m(part):.3g} m of its centre of mass"
        )
        idle = " and ".join("xyz"[axis] for axis in robot.idle_axes(part, body))
        return f"{text}; {part} does not feel {idle}" if idle else text

    def _down(self) -> np.ndarray:
        """(3,) unit vector along gravity in the model's frame; 0 without gravity."""
        gravity = self.robot.rigid.model.opt.gravity + self.robot.more_gravity
        return gravity / max(float(np.linalg.norm(gravity)), 1e-9)

    def _tilt(self) -> Candidate:
        """The direction of gravity as an effect that all hinges share: its two components
        across the direction of the file."""
        along = "xyz"[int(np.argmax(np.abs(self._down())))]
        return candidate(TiltedBase, {}, **{along: 0.0})

    def _payload(self, parts: Sequence[str], body: int, spread: bool) -> Candidate:
        """A payload in one body as an effect that the joints ``parts`` share.

        Args:
            body: its id.
            spread: whether its mass is spread as that of the body; else it is a point.
        """
        robot = self.robot
        link = "" if body == robot.last_body(parts[0]) else robot.body_name(body)
        idle = set.intersection(*({*robot.idle_axes(p, body)} for p in parts))
        still = PAYLOAD_AT if spread else [PAYLOAD_AT[axis] for axis in sorted(idle)]
        most = next(p.high for p in Payload.parameters() if p.name == "mass_kg")
        least, far = min(robot.removable_kg(body), most), robot.reach_m(parts[-1])
        ends = [("mass_kg", -least, most), *((n, -far, far) for n in PAYLOAD_AT)]
        where: dict[str, Any] = dict.fromkeys(still, 0.0)
        where |= {"link": link, "like_link": spread}
        return candidate(bounded("payload", tuple(ends)), {}, **where)

    def _tilted(self, found: SharedFit) -> "RobotMachine":
        """The machine with the direction of gravity that was found."""
        assert isinstance(found.effect, TiltedBase)
        down = found.effect.tilted(self._down())
        return self._with_gravity([float(x) for x in down])

    def _with_gravity(self, direction: list[float]) -> "RobotMachine":
        config = dataclasses.replace(self.robot.config, gravity=direction)
        robot = dataclasses.replace(self.robot, config=config)
        return dataclasses.replace(self, robot=robot)

    def reconsidered(
        self,
        findings: Sequence[Finding],
        measurements: Measurements,
        gains: GainsAre,
        diagnosed: Diagnosed,
    ) -> list[Finding]:
        """Where joints lack what a payload or a tilt of the base explains as well, these
        are fitted to all joints that share them. If they hold at all of these joints, the
        joints are diagnosed again with them in the file; else without them. What else was
        found at a joint is in the model when joints that lack less are judged again."""
        if not self.robot.config.model:
            return list(findings)
        how = measurements, gains, diagnosed
        findings = self._with_tilt(findings, how)
        for body in dict.fromkeys(self.robot.last_body(f.part) for f in findings):
            findings = self._with_payload(body, findings, how)
        return self._beside_larger(findings, how)

    def _with_payload(
        self, body: int, findings: Sequence[Finding], how: How
    ) -> Sequence[Finding]:
        """``findings`` with one payload in ``body``, or in the link before it that leaves
        less, in place of what several joints lack that move it."""
        robot, (measurements, gains, _) = self.robot, how
        group = {f.part: f for f in findings if robot.last_body(f.part) == body}
        stands_for = _standing_in(group, "payload")
        named = [part for part, names in stands_for.items() if "payload" in names]
        alone = len(group) == 1 and self.units[next(iter(group))] == "rad"
        if not stands_for or alone:
            return findings
        problems = {
            part: self._problem_of(f, measurements, gains) for part, f in group.items()
        }
        d = {part: f.diagnosis for part, f in group.items()}
        tried: list[tuple[int, SharedFit]] = []
        places = [body, *robot.links_before(body).values()]
        for spread, place in itertools.product((False, True), places):
            parts = [part for part in group if robot.moves_body(part, place)]
            if {*(named or stands_for)} <= {*parts}:
                own = {part: problems[part] for part in parts}
                mass = self._payload(parts, place, spread)
                tried.append((place, shared_fit(own, d, stands_for, mass)))
        place, found = tried[0]
        for other, one in tried[1:]:
            sure = 0.0 if one.numbers < found.numbers else SearchConfig().sure_score
            if one.is_better(found, sure):
                place, found = other, one
        tied = {k for k, o in tried if not o.worse and not found.is_better(o)}
        ties = {robot.body_name(k) for k in tied - {place}}
        if found.worse:
            return self.without_shared(findings, group, stands_for, "payload", how[2])
        if not (named or found.pays):
            return findings
        little = SearchConfig().little
        clear = [part for part, error in found.errors.items() if error <= little]
        if 0 < len(clear) < len(found.errors):
            # What other joints lack besides must not say how large the mass is.
            own = {part: problems[part] for part in clear}
            spread = cast(Payload, found.effect).like_link
            mass = self._payload(clear, place, spread)
            found = shared_fit(own, d, stands_for, mass)
        nearest = {part: robot.rigid.model.joint(part).id for part in stands_for}
        owner = max(named or stands_for, key=nearest.__getitem__)
        payload = cast(Payload, found.effect)
        moved = [f.part for f in findings if robot.moves_body(f.part, place)]
        mended = self.with_additions([Addition(owner, [payload], {}, {})])
        own = {f.part: f for f in findings if f.part in moved}
        if not (again := mended.shared_by(own, found, how[2])):
            return self.without_shared(findings, group, stands_for, "payload", how[2])
        judged = with_effect(again[owner], d[owner], payload, sorted(ties))
        place = self._place(owner, payload)
        again[owner] = dataclasses.replace(judged, remark=place)
        return [again.get(f.part, f) for f in findings]

    def _beside_larger(self, findings: Sequence[Finding], how: How) -> list[Finding]:
        """``findings`` with those of joints that were judged again beside what was found at joints that lack more, where that
        changes their error: a joint's acceleration is what its drive in the file makes of its targets, and loads the others."""
        measurements, gains, diagnosed = how
        done: dict[str, Finding] = {}
        masses = [
            f
            for f in findings
            if payload_of(f) is not None and not f.diagnosis.rivals.get("payload")
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
            if 1.0 / ALIKE < above_floor(left) / left_of(f.diagnosis) < ALIKE:
                continue
            (again,) = diagnosed(machine, [f.part])
            most = ALIKE if len(lacked(again)) <= len(lacked(f)) else 1.0 / ALIKE
            if left_of(again.diagnosis) <= most * left_of(f.diagnosis):
                what = " and ".join(
                    f"{' and '.join(lacked(o))} of {o.part}" for o in others
                )
                text = f"judged with {what}: mend {' and '.join(o.part for o in others)} first"
                done[f.part] = remarked(
                    again, f"{text}, or all at once, and diagnose {f.part} again"
                )
        return [done[f.part] for f in findings]

    def _with_tilt(self, findings: Sequence[Finding], how: How) -> Sequence[Finding]:
        """``findings`` with one direction of gravity in place of what several hinges lack."""
        measurements, gains, _ = how
        laws = self.robot.config.joints
        hinges = [f for f in findings if self.units[f.part] == "rad"]
        group = {f.part: f for f in hinges if laws[f.part].law != "effort"}
        # While a joint's delay is still wrong, a payload may explain the error of a tilted
        # base, where an unbalance does not.
        stands_for = _standing_in(group, "unbalance") or _standing_in(group, "payload")
        if not stands_for or not self._down().any():
            return findings
        problems = {
            part: self._problem_of(f, measurements, gains) for part, f in group.items()
        }
        d = {part: f.diagnosis for part, f in group.items()}
        found = shared_fit(problems, d, stands_for, self._tilt())
        if found.worse or any(n.startswith("gravity.") for n in found.fit.at_bound):
            if len(group) == 1:
                return findings
            return self.without_shared(findings, group, stands_for, "gravity", how[2])
        mended = self._tilted(found)
        if found.pays and len(group) > 1:
            if not (again := mended.shared_by(group, found, how[2])):
                return self.without_shared(
                    findings, group, stands_for, "gravity", how[2]
                )
            again = {
                part: self._with_changed_gravity(f, d[part], mended, found)
                for part, f in again.items()
            }
            return [again.get(f.part, f) for f in findings]
        down = mended._down()
        leans = float(np.degrees(np.arccos(np.clip(down @ self._down(), -1.0, 1.0))))
        gravity = f"[{', '.join(f'{x:.4f}' for x in down + 0.0)}]"
        values = {"degrees": leans, "gravity": gravity, "joints": [*stands_for]}
        tilt = Remark("tilt", values | {"file": self.robot.path.name})
        return [remarked(f, tilt) if f.part in stands_for else f for f in findings]

    def _with_changed_gravity(
        self, f: Finding, alone: Diagnosis, machine: "RobotMachine", found: SharedFit
    ) -> Finding:
        """Finding ``f`` of ``machine``, with the direction of gravity as numbers of the
        file that change."""
        d = f.diagnosis
        old, new = self._down(), machine._down()
        numbers = {n: float(x) for n, x in zip(GRAVITY, new, strict=True)}
        ends, changed, scale = dict(d.intervals), [], 1.0
        for k, (name, axis) in enumerate(zip(GRAVITY, "xyz", strict=True)):
            if axis not in found.intervals:
                continue
            scale = new[k] / (old[k] + getattr(found.effect, axis) or 1.0)
            low, high = (float(scale * (old[k] + end)) for end in found.intervals[axis])
            ends[name] = low, high
            without = alone.errors[alone.baseline]["validation"]
            was, now = float(old[k]), float(new[k])
            one = Changed(name=name, before=was, after=now, unit="1", without=without)
            changed.append(one)
        d = dataclasses.replace(
            beside_alone(d, alone),
            status="numbers_off" if d.status == "nothing_missing" else d.status,
            base={**d.base, **numbers},
            start={**d.start, **dict(zip(GRAVITY, map(float, old), strict=True))},
            intervals=ends,
            changed=(*changed, *d.changed),
        )
        return dataclasses.replace(f, diagnosis=d)

    def mended(self, findings: Sequence[Finding]) -> "tuple[RobotMachine, str]":
        """The machine with what was found, and a sentence on what was not written: of
        payloads that joints alone found in one body, all but the last."""
        bodies: dict[int, str] = {}
        for f in findings:
            if (own := payload_of(f)) is not None:
                bodies[self.robot.body_of(f.part, own)] = f.part
        additions, left = [], []
        for f in findings:
            d, written = f.diagnosis, [*f.diagnosis.effects]
            if payload_of(f) is not None and f.part not in bodies.values():
                written = [e for e in written if e.name != "payload"]
                left.append(f.part)
            additions.append(Addition(f.part, written, d.base, d.intervals))
        text = ""
        if left:
            text = (
                f"the payload of {' and '.join(left)} is not written: it is in the same "
                f"body as that of {' and '.join(bodies.values())}"
            )
        return self.with_additions(additions), text

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
            if GRAVITY[0] in a.base:
                direction = [float(a.base[name]) for name in GRAVITY]
                leaning = dataclasses.replace(robot.config, gravity=direction)
                robot = dataclasses.replace(robot, config=leaning)
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


def payload_of(f: Finding) -> Payload | None:
    """The payload that a finding adds."""
    found = [e for e in f.diagnosis.effects if isinstance(e, Payload)]
    return found[0] if found and "payload" not in f.diagnosis.present else None


def lacked(f: Finding) -> tuple[str, ...]:
    """Names of the effects that a finding adds, and of the numbers in the robot's file that it calls wrong."""
    added = [n for n in f.diagnosis.names if n not in f.diagnosis.present]
    return (*added, *(c.name for c in f.diagnosis.changed))


def _standing_in(
    group: Mapping[str, Finding], effect: str
) -> dict[str, tuple[str, ...]]:
    """Joint → what it has in place of ``effect``, where it has anything (``standing_in``)."""
    found = {part: standing_in(f.diagnosis, effect) for part, f in group.items()}
    return {part: names for part, names in found.items() if names}
