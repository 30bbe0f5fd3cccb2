"""Any robot as a machine: ``kind: robot`` (``alignment.machines.robot_file``). Its parts are its joints, by the model's names."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, cast

import numpy as np

from taccorl.alignment.checks.clock import check_against_twin
from taccorl.alignment.checks.robot import check_robot
from taccorl.alignment.controller.joint_model import JointModel, JointResponse, with_other_numbers
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.alignment.measurements.folder import Measurements, Use
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import SignalFloor, noise_floor
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import moving, traces_of
from taccorl.diagnosis.comparison.replays import replay_joints
from taccorl.diagnosis.comparison.result import USES, Comparison, Kind
from taccorl.diagnosis.machines.machine import Addition, Drive, Finding, GainsAre, Machine, machines
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.problems.joints import JointFinding, diagnose_joint, moves, of_joints
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.payload import Payload
from taccorl.sim.twin_file import write_whole


@machines.register("robot")
@dataclass(frozen=True)
class RobotMachine(Machine):
    """A robot described by an MJCF or URDF file and a robot file."""

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
        return tuple(dict.fromkeys(e.name for joint in self.robot.config.joints.values() for e in joint.effects))

    @property
    def units(self) -> Mapping[str, str]:
        return self.robot.units

    # measurements ----------------------------------------------------------------------------------------------------

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Check recordings: positions or efforts beyond their limits, an impossible inertia, missing columns. Returns recording
        → findings."""
        found: dict[str, list[DataFinding]] = {}
        for m in measurements.all:
            moved = [name for name in self.robot.config.joints if moves(m, name)]
            found[m.name] = check_robot(self.robot, m, self._whole(m), moved)
        return found

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        for m in measurements.all:
            self._whole(m)
        found = tuple(s for s in self.robot.config.joints if any(moves(m, s) for m in measurements.fit))
        if not found:
            raise TaccorlError(
                f"no fit recording moves a joint of {self.robot.path} by 2 mrad (2 mm) or more; record a sweep of each: "
                "± 0.3 rad, 0.1 to 2 Hz, 10 s, twice"
            )
        return found

    def compare(
        self,
        measurements: Measurements,
        *,
        name: str = "",
        pressed: PressedObject | None = None,
        progress: Callable[[str, int, int], None] = lambda recording, done, total: None,
    ) -> Comparison:
        if pressed is not None:
            raise TaccorlError(f"--pressed: {self.name} has no pads; remove the option")
        uses: list[tuple[Use, Measurement]] = [
            (use, self._whole(m)) for use in USES for m in getattr(measurements, use)
        ]
        every = [m for _, m in uses]
        floors: dict[Kind, dict[str, SignalFloor]] = {kind: noise_floor(every, kind) for kind in ("position", "effort")}
        levels = {signal: floor.value for signal, floor in floors["position"].items()}
        traces, clock, held = [], {}, set()
        for k, (use, m) in enumerate(uses):
            progress(m.name, k, len(uses))
            moved = moving(m.with_position_targets(m.measured))
            known = [s for s in moved if s in self.robot.config.joints]
            held |= {s for s in moved if s not in self.robot.config.joints}
            response = replay_joints(self.robot, m, known)
            positions = m.with_position_targets(np.nan_to_num(response.reported))
            held_there = [m.column(s) for s in known if self.robot.config.joints[s].law == "effort"]
            response.reported[:, held_there] = np.nan
            traces += [
                t
                for t in traces_of(positions, use, dataclasses.replace(response, measurement=positions), floors)
                if t.signal in known
            ]
            known = [s for s in known if self.robot.config.joints[s].law != "effort"]
            if known:
                commanded = m.with_position_targets(np.zeros(m.target.shape))
                uncertain = [s for s in known if self.robot.config.joints[s].is_uncertain]
                at = [m.column(s) for s in known]

                def changed(signal: str, m: Measurement = m) -> list[np.ndarray]:
                    model = JointModel(self.robot, signal)
                    return with_other_numbers(model, motion_of(m, signal, model.joint))

                clock[m.name] = tuple(
                    check_against_twin(commanded.only(known), response.reported[:, at], levels, uncertain, changed)
                )
        progress("", len(uses), len(uses))
        if not traces:
            raise TaccorlError(
                f"{', '.join(m.name for m in every)}: nothing to compare: no joint of the robot file moved"
            )
        left_out = [f"{s}: {self.robot.path.name} does not name it under joints" for s in sorted(held)]
        return Comparison(
            twin=name or self.name,
            effects=self.effects,
            traces=tuple(traces),
            split=measurements.record(),
            clock=clock,
            left_out=tuple(left_out),
        )

    def diagnose(
        self,
        part: str,
        measurements: Measurements,
        *,
        gains: GainsAre = "auto",
        search: SearchConfig | None = None,
        without: Sequence[str] = (),
    ) -> Finding:
        found = diagnose_joint(self.robot, part, measurements, gains=gains, search=search, without=without)
        if "payload" in found.diagnosis.names:
            body = self.robot.body_name(self.robot.last_body(part))
            text = (
                f"payload: x_link6_m, y_link6_m and z_link6_m are along the axes of {body} in {self.robot.rigid.path.name}, from "
                f"its centre of mass, within ± {self.robot.reach_m(part):.3g} m"
            )
            idle = self.robot.idle_axis(part)
            if idle is not None:
                text += f"; {part} does not feel {'xyz'[idle]}"
            found = dataclasses.replace(found, remark=text)
        if self.robot.config.joints[part].law != "impedance" or "torque_speed_limit" not in found.diagnosis.names:
            return found
        text = (
            f"{part} has law impedance in {self.robot.path.name}. A drive that sets its motor's voltage (a hobby servo's) has a "
            "torque-speed limit where its duty is clipped: if it is one, write `law: pwm` with supply_v, resistance_ohm and "
            "torque_nm_per_a instead of the effect"
        )
        diagnosis = dataclasses.replace(found.diagnosis, remarks=(*found.diagnosis.remarks, text))
        return dataclasses.replace(found, diagnosis=diagnosis)

    def reconsidered(
        self, findings: Sequence[Finding], diagnosed: Callable[[Machine, Sequence[str]], list[Finding]]
    ) -> list[Finding]:
        """A payload that was found at one joint is in the model when the other joints that move its body are diagnosed again."""
        owners = [f for f in _payloads(findings) if not f.diagnosis.rivals.get("payload")]
        owners = [f for f in owners if f.part in self._most_distal(owners)]
        found = [Addition(f.part, [_payload(f)], {}, {}) for f in owners]
        felt = {
            f.part: owner
            for owner in owners
            for f in findings
            if f.part not in {o.part for o in owners}
            and self.robot.moves_body(f.part, self.robot.last_body(owner.part))
        }
        if not felt:
            return list(findings)
        again: dict[str, Finding] = {}
        for f in diagnosed(self.with_additions(found), list(felt)):
            owner = felt[f.part]
            body = self.robot.body_name(self.robot.last_body(owner.part))
            text = (
                f"judged with the payload of {_payload(owner).mass_kg:.3g} kg in {body} that this diagnosis found at "
                f"{owner.part}: add both, or the payload first and diagnose {f.part} again"
            )
            again[f.part] = dataclasses.replace(
                cast(JointFinding, f), diagnosis=dataclasses.replace(f.diagnosis, remarks=(*f.diagnosis.remarks, text))
            )
        return [again.get(f.part, f) for f in findings]

    def mended(self, findings: Sequence[Finding]) -> "tuple[RobotMachine, str]":
        """Of payloads that were found at several joints of one body only that of the joint nearest to it is written."""
        found = _payloads(findings)
        kept = self._most_distal(found)
        left = [f.part for f in found if f.part not in kept]
        additions = [
            Addition(
                f.part,
                [e for e in f.diagnosis.effects if e.name != "payload" or f.part not in left],
                f.diagnosis.base,
                f.diagnosis.intervals,
            )
            for f in findings
        ]
        text = (
            f"the payload of {' and '.join(left)} is not written: it is the mass that was found at {' and '.join(kept)}"
        )
        return self.with_additions(additions), text * bool(left)

    def _most_distal(self, findings: Sequence[Finding]) -> set[str]:
        """Of joints with a payload in the same body the one nearest to it."""
        nearest_: dict[int, str] = {}
        for f in findings:
            body = self.robot.last_body(f.part)
            other = nearest_.setdefault(body, f.part)
            model = self.robot.rigid.model
            if model.joint(f.part).id > model.joint(other).id:
                nearest_[body] = f.part
        return set(nearest_.values())

    @property
    def fitted_gains(self) -> tuple[str, ...]:
        return tuple(name for name, joint in self.robot.config.joints.items() if joint.gains == "fitted")

    def drive(self, part: str) -> Drive:
        joint = self.robot.joint(part)
        c = self.robot.config.joints[part]
        return Drive(joint.unit, joint.known.limits, c.effort_limit, c.target_kind, c.law != "pwm")

    def answer(self, part: str, m: Measurement) -> JointResponse:
        model = JointModel(self.robot, part)
        return model.simulate(motion_of(model.joint.whole(m), part, model.joint), model.gains)

    def motion_problem(self, part: str, measurements: Measurements, gains: GainsAre) -> JointProblem:
        return JointProblem(self.robot, part, of_joints(measurements, [part]), gains=gains)

    # effects ---------------------------------------------------------------------------------------------------------

    def effect(
        self, name: str, part: str, values: Mapping[str, Any], base: Mapping[str, float] | None = None
    ) -> Effect | None:
        joint = self.robot.joint(part)
        if joint.selectors(effects.get(name)) is None:
            return None
        own = {key: value for key, value in values.items() if key not in ("arm", "joints")}
        make_effect(name, **own)  # which names what is wrong
        return joint.in_units(effects.get(name))(**own)

    def with_additions(self, additions: Sequence[Addition]) -> "RobotMachine":
        robot = self.robot
        for a in additions:
            config = robot.config.joints[a.part]
            numbers = {key: float(value) for key, value in config.law_numbers(a.base).items()}
            # The file has the registered classes, whose numbers are the same.
            new = [
                make_effect(e.name, **{f.name: getattr(e, f.name) for f in dataclasses.fields(e)}) for e in a.effects
            ]
            if "position_age_s" in a.base:
                numbers["position_age_s"] = config.position_age_s + float(a.base["position_age_s"])
            if "speed_delay_s" in a.base:
                low, high = a.intervals["speed_delay_s"]
                sure = low > 0.0 or high < 0.0
                new.append(make_effect("speed_delay", delay_s=float(a.base["speed_delay_s"]) * sure))
            names = {e.name for e in new}
            kept = [e for e in config.effects if e.name not in names]
            effects_ = [*kept, *(e for e in new if not e.is_absent)]
            robot = robot.with_joint(a.part, dataclasses.replace(config, **numbers, effects=effects_))
        name, why = robot.mass_twice()
        if name:
            raise TaccorlError(why)
        return dataclasses.replace(self, robot=robot)

    def _whole(self, m: Measurement) -> Measurement:
        return self.robot.joint(next(iter(self.robot.config.joints))).whole(m)


def _payloads(findings: Sequence[Finding]) -> list[Finding]:
    """Findings that add a payload."""
    return [f for f in findings if "payload" in f.diagnosis.names and "payload" not in f.diagnosis.present]


def _payload(finding: Finding) -> Payload:
    return next(e for e in finding.diagnosis.effects if isinstance(e, Payload))
