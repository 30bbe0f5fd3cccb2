"""``python -m pipelines.judge --rows=FILE``: the same 120 diagnoses with any build.

Options: ``--workers=14``, ``--cases=robots,*pack``. Rows are appended as they are
finished; cases that have one are not run again. ``python -m pipelines.judge compare
OLD.jsonl NEW.jsonl`` prints two builds side by side, with every answer that changed.
Another build in the folder OLD runs the same cases by the same command there, after
``cp pipelines/judge.py OLD/pipelines/`` and ``cp pipelines/studies/foreign.py
OLD/pipelines/studies/``.

The cases are a fixed sample of the stored ones: of the main study over all its CPU
times, of the others all kinds and the slowest. Ten are new: one payload or one tilted
base that several joints share. Every recording is simulated.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# Before NumPy is imported, here and in every worker: CPU-seconds of one thread.
for _name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM", "NUMEXPR"):
    os.environ[f"{_name}_NUM_THREADS"] = "1"

import numpy as np  # noqa: E402
import yaml  # noqa: E402

from pipelines.studies import foreign, pairs, robots  # noqa: E402
from pipelines.studies import joints_and_pads as study  # noqa: E402
from pipelines.studies import servo as servos  # noqa: E402
from taccorl.alignment.measurements.folder import Measurements  # noqa: E402
from taccorl.diagnosis.comparison.result import Comparison  # noqa: E402
from taccorl.diagnosis.machines import machine as machine_module  # noqa: E402
from taccorl.diagnosis.machines.cells import CellsMachine  # noqa: E402
from taccorl.diagnosis.machines.load import load_machine  # noqa: E402
from taccorl.diagnosis.machines.machine import Machine, diagnose_parts  # noqa: E402
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig  # noqa: E402
from taccorl.lineage.processes import Care, Done, Failed, run_in_processes  # noqa: E402
from taccorl.sim.effects import effects  # noqa: E402
from taccorl.surrogate.cells import draw_cells, simulated  # noqa: E402

SAMPLE = {
    "single pack": """sensor_delay 770001, quadratic_drag 770004, cogging 770000,
        torque_speed_limit 770004, slew_limit 770002,
        position_dependent_friction 770001, armature 770003,
        asymmetric_friction 770003, load_friction 770001, joint_compliance 770000,
        error_deadband 770002, coulomb_friction 770000, end_stop 770002,
        stribeck_friction 770004""",
    "single chirp": """encoder_eccentricity 770001, coulomb_friction 770001,
        load_friction 770004, command_lag 770000, cable_spring 770001,
        joint_compliance 770003, torque_fade 770001, velocity_feedforward 770001,
        torque_lag 770001, integral_action 770002, command_delay 770002,
        gravity_mismatch 770001, viscous_friction 770001, payload 770000""",
    "pairs pack": """coulomb_friction+command_delay 771003, cogging+command_lag 771001,
        coulomb_friction+gravity_mismatch 771000, backlash+coulomb_friction 771002,
        backlash+coulomb_friction 771003, quadratic_drag+sensor_delay 771003,
        load_friction+torque_lag 771001, cable_spring+coulomb_friction 771000,
        stribeck_friction+joint_compliance 771001, slew_limit+coulomb_friction 771000,
        error_deadband+command_delay 771000""",
    "removed pack": """loop_delay 772501, gear_error 772501, hung_mass 772501,
        voltage_sag 772501, one_way_gains 772500""",
    "removed chirp": """sensor_delay 772000, command_lag 772000, command_delay 772000,
        backlash 772000, magnetic_hysteresis 772001""",
    "none pack": "none 770025, none 770016",
    "none chirp": "none 770018, none 770034",
    "none press": "none 770003",
    "loop chirp": "none 773500",
    "dropped pack": "dropped_commands 773004",
    "touch press": """taxel_saturation 770000, taxel_crosstalk 770001,
        taxel_ghosting 770000""",
    "removed press": "rate_softening 772000",
    "robots": """coulomb_friction 60000, viscous_friction 60001,
        stribeck_friction 60002, gear_friction 60003, torque_scale 60006,
        torque_saturation 60007, command_delay 60008, cable_spring 60024,
        command_lag 60028, backlash 60035, armature 60042, none 70000, none 70002,
        none 70020""",
    "robot_pairs": """coulomb_friction+viscous_friction 90000,
        coulomb_friction+armature 90001, coulomb_friction+gravity_mismatch 90002,
        coulomb_friction+cable_spring 90003, coulomb_friction+command_delay 90004,
        coulomb_friction+torque_scale 90005, coulomb_friction+cogging 90007,
        coulomb_friction+joint_compliance 90008, armature+cogging 90022,
        cable_spring+torque_scale 90031, command_delay+cogging 90037,
        torque_scale+cogging 90040, coulomb_friction+cable_spring 91000,
        coulomb_friction+command_delay 91001, coulomb_friction+backlash 91002,
        coulomb_friction+joint_compliance 91004""",
    "servos": """load_friction 81000, load_friction 81026, load_friction 81031,
        coulomb_friction 81001, coulomb_friction 81028, stribeck_friction 81002,
        stribeck_friction 81013, backlash 81003, backlash 81014, motor 81015,
        none 81020, none 81027""",
    "cells": """taxel_saturation 50000, taxel_power_law 50009, taxel_play 50021,
        taxel_creep 50026, touch_delay 50039, taxel_log_creep 50045,
        taxel_crosstalk 50055, none 50065""",
    "shared": """payload 95000, payload 95001, payload 95002, payload 95003,
        payload 95004, tilt 95010, tilt 95011, tilt 95012, tilt 95013, tilt 95014""",
}
"""Study → cases, each a hidden effect (none; two joined by +) and a seed."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One diagnosis of the sample."""

    study: str
    """Key of ``SAMPLE``; of the main study with the motions."""
    hidden: str
    """Hidden effects joined by +; empty: none."""
    seed: int

    @property
    def key(self) -> str:
        """Key of its row."""
        return f"{self.study} {self.hidden or 'none'} {self.seed}"


def sample(patterns: str = "*") -> list[Case]:
    """The cases of the fixed sample that ``patterns`` selects: shell patterns with commas between them, each compared with the
    name of a case's study and with its key; ``robots,*pack``."""
    words = [
        (name, *word.split()) for name in SAMPLE for word in SAMPLE[name].split(",")
    ]
    cases = [
        Case(n, hidden.replace("none", ""), int(seed)) for n, hidden, seed in words
    ]
    found = [(c, text) for c in cases for text in (c.study, c.key)]
    wanted = [c for c, text in found for p in patterns.split(",") if fnmatch(text, p)]
    return list(dict.fromkeys(wanted))


# one case


@cache
def simulations() -> list[int]:
    """[0]: simulations since the first call in this process, which any computer needs alike:
    parameter sets × recordings. Wraps the problems that this build has."""
    count, inside = [0], [False]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(problem: Any, *given: Any) -> Any:
            outer, inside[0] = inside[0], True
            several = len(given) == 2  # of ``simulate_all``; ``simulate`` has three
            count[0] += 0 if outer else len(given[0]) * len(given[1]) if several else 1
            try:
                return function(problem, *given)
            finally:
                inside[0] = outer

        return call

    for kind in ("joint", "axis", "cells", "touch"):
        name = f"taccorl.diagnosis.problems.{kind}_problem"
        if find_spec(name) is not None:
            problem = getattr(import_module(name), f"{kind.title()}Problem")
            for method in ("simulate", "simulate_all"):
                setattr(problem, method, counted(getattr(problem, method)))
    return count


def run(case: Case) -> Row:
    """Record and diagnose one case; CPU-seconds are those of this process."""
    before = simulations()[0]
    with tempfile.TemporaryDirectory() as folder:
        row = RUNS.get(case.study, _main)(case, Path(folder))
    own = {"key": case.key, "study": case.study, "hidden": case.hidden}
    return row | own | {"simulations": simulations()[0] - before}


def _main(case: Case, folder: Path) -> Row:
    """Joints and pads of the PiPER, by the main study's own rules."""
    name, design = case.study.split()
    (job,) = study.jobs(name, design, [case.hidden], [case.seed])
    row = study.run_job(job)
    answers = {
        "exact": bool(job.hidden) and study.exact_but_for_algebra(row),
        "silent": not job.hidden and not row["found"],
        "named": bool(job.hidden) and study.named(row),
    }
    if name == "removed":
        answers = {"said": not study.silently_wrong(row)}
    elif name == "dropped":
        answers = {"said": study.drop_said(row)}
    return row | {"answer": next((a for a in answers if answers[a]), "wrong")}


def _facts(d: Diagnosis) -> Row:
    """What was found, with numbers as [value, low, high]."""
    effects_ = {
        f"{e.name}.{p.name}": getattr(e, p.name)
        for e in d.effects
        for p in e.parameters()
    }
    values = {**d.base, **effects_}
    return {
        "found": [name for name in d.names if name not in d.present],
        "status": d.status,
        "errors": d.errors,
        "rivals": {name: list(of) for name, of in d.rivals.items()},
        "numbers": {
            n: [values[n], *ends] for n, ends in d.intervals.items() if n in values
        },
        "remarks": [str(remark)[:120] for remark in d.remarks],
    }


@dataclass(frozen=True)
class Recorded:
    """What a user has: a machine and recordings, and when making them began."""

    machine: Machine
    parts: tuple[str, ...]
    measurements: Measurements
    folder: Path
    began: float
    """Process time [s] before the recordings were made."""

    def diagnosed(self, most: int, truth: Mapping[str, float]) -> Row:
        """Diagnose, write the corrected file, read it again, and compare it.

        Args:
            most: most effects that are added.
            truth: number → true value, which is appended to the number's interval.
        """
        recorded, search = time.process_time(), SearchConfig(max_effects=most)
        if len(self.parts) == 1:
            part, made = self.parts[0], self.measurements
            found = [self.machine.diagnose(part, made, search=search)]
        else:
            found = diagnose_parts(
                self.machine, self.parts, self.measurements, search=search
            )
        done, path = time.process_time(), self.folder / "corrected.yaml"
        row = _facts(found[0].diagnosis)
        row["parts"] = {f.part: _facts(f.diagnosis) for f in found}
        for name in [name for name in row["numbers"] if name in truth]:
            row["numbers"][name].append(truth[name])
        try:
            self.machine.mended(found)[0].save(path)
            row["file"] = yaml.safe_load(path.read_text(encoding="utf-8"))
            before, after = (
                machine.compare(self.measurements)
                for machine in (self.machine, load_machine(path))
            )
            row["written"] = {f.part: _errors(after, f.part) for f in found}
            restated = getattr(machine_module, "as_written", lambda all_, *_: all_)
            row["stated_errors"] = {
                f.part: f.diagnosis.errors["after"]
                for f in restated(found, before, {"after": after})
            }
        except Exception as error:
            row["written_failed"] = f"{type(error).__name__}: {error}"
        row["recording_cpu_s"] = recorded - self.began
        return row | {"cpu_s": done - recorded}


def _errors(after: Comparison, part: str) -> dict[str, list[float]]:
    """Use → errors of the corrected file [floors]: of positions alone, with efforts, and
    of all rows, each in the floors of its own recording."""
    scores = after.scores() if after.traces else after.pad_scores()
    own = [s for s in scores if part in (s.signal, "") or s.kind == "touch"]
    return {
        use: [
            *(
                math.sqrt(
                    np.mean(
                        [s.ratio**2 for s in own if s.use == use and s.kind != left_out]
                    )
                )
                for left_out in ("effort", "")
            ),
            _of_rows(after, part, use),
        ]
        for use in dict.fromkeys(s.use for s in own)
    }


def _of_rows(after: Comparison, part: str, use: str) -> float:
    """RMS of the residuals of all rows or readings, each over its noise floor."""
    rows = [
        (t.residual / t.floor.value).ravel()
        for t in after.traces
        if t.signal == part and t.use == use
    ]
    rows += [t.over_floor for t in after.touches if t.use == use]
    return float(np.sqrt(np.nanmean(np.concatenate(rows) ** 2)))


KEYS = {
    "coulomb": "coulomb_friction.torque_nm",
    "viscous": "viscous_friction.damping_nms_per_rad",
    "gear_share": "gear_friction.share",
    "armature": "armature.added_kgm2",
    "spring": "cable_spring.stiffness_nm_per_rad",
    "scale": "torque_scale.factor",
    "delay_s": "command_delay.delay_s",
    "lag_s": "command_lag.time_constant_s",
    "play": "backlash.play_rad",
    "compliance": "joint_compliance.compliance_rad_per_nm",
}
"""Number of ``studies.foreign`` → number of an effect that means the same."""


def _robot(case: Case, folder: Path) -> Row:
    drawn, began = foreign.draw(case.seed, case.hidden), time.process_time()
    plant = foreign.Plant(drawn)
    machine, made = load_machine(plant.robot_file(folder)), foreign.recordings(plant)
    joint = [link.joint for link in drawn.links].index(drawn.joint)
    hidden = foreign._numbers(plant, joint)
    truth = {KEYS[k]: value for k, value in hidden.items() if k in KEYS}
    recorded = Recorded(machine, (drawn.joint,), made, folder, began)
    return _by_first(recorded.diagnosed(1, truth), case.hidden)


def _by_first(row: Row, hidden: str) -> Row:
    """``row`` with an answer by the rules of ``studies.robots`` and ``pendulums``."""
    added = row["found"][0] if row["found"] else None
    near = effects.get(added).near_twins if added else ()
    own = {"added": added, "hidden": hidden or None}
    own["beside"] = [*row["rivals"].get(added, ()), *near]
    answer = "named" if robots.is_named(own) else "wrong"
    if robots.is_exact(own):
        answer = "exact" if hidden else "silent"
    return row | {"answer": answer}


def _pair(case: Case, folder: Path) -> Row:
    one, other = case.hidden.split("+")
    began = time.process_time()
    machine, part, made = pairs.made(case.seed, one, other, folder)
    row = Recorded(machine, (part,), made, folder, began).diagnosed(4, {})
    answer = "exact" if pairs.exactly(row | {"hidden": case.hidden}) else "wrong"
    both = answer == "wrong" and pairs.both(row | {"hidden": case.hidden})
    return row | {"answer": "named" if both else answer}


def _servo(case: Case, folder: Path) -> Row:
    servo, began = servos.Servo(seed=case.seed, hidden=case.hidden), time.process_time()
    servos.write(servo, folder)
    machine = load_machine(folder / "servo.yaml")
    names = {
        "load_friction": "share",
        "coulomb_friction": "torque_nm",
        "backlash": "play_rad",
    }
    truth = {f"{case.hidden}.{names.get(case.hidden)}": servo.strength}
    made = machine.read(folder / "swings")
    row = Recorded(machine, ("servo",), made, folder, began).diagnosed(
        1, truth | {"inertia": servo.inertia}
    )
    return _by_first(row, case.hidden.replace("motor", ""))


def _cells(case: Case, folder: Path) -> Row:
    began, drawn = time.process_time(), draw_cells(case.hidden, case.seed)
    made, machine = simulated(drawn), CellsMachine(drawn.config(), "cells")
    truth = {f"{case.hidden}.{name}": value for name, value in drawn.values.items()}
    row = Recorded(machine, machine.parts(made), made, folder, began).diagnosed(
        4, truth
    )
    return _by_first(row, case.hidden)


SHARED = {
    "payload": (foreign.SHORT, foreign.SHORT, "leg", "leg", foreign.SHORT),
    "tilt": (foreign.SHORT, foreign.SHORT, "leg", "SCARA", "SCARA"),
}
"""What all joints share → robots of its cases, by the last digit of their seeds."""
UPRIGHT = np.array([0.0, 0.0, -1.0])
"""Direction of gravity in the users' models."""


def _shared(case: Case, folder: Path) -> Row:
    """A mass at the tip, or a base that leans; all joints move in every recording."""
    rng, began = np.random.default_rng([case.seed, 79]), time.process_time()
    user = foreign.Case(
        robot=SHARED[case.hidden][case.seed % 10],
        joint="",
        hidden="",
        strength=1.0,
        seed=case.seed,
        effort=bool(case.seed % 2),
    )
    joints = tuple(link.joint for link in user.links)
    mass_kg, lean, way = rng.uniform([0.15, 0.03, 0.0], [0.6, 0.1, 6.28])
    down = np.array([math.cos(way), math.sin(way), 0.0]) * math.sin(lean)
    down += UPRIGHT * math.cos(lean)
    tip, gravity = (" ".join(map(str, v)) for v in (user.links[-1].end_m, 9.81 * down))
    mass = f'<inertial pos="0 0 0" mass="{mass_kg}" diaginertia="1e-5 1e-5 1e-5"/>'
    change = ("<worldbody>", f'<option gravity="{gravity}"/><worldbody>')
    if case.hidden == "payload":
        change = ("</body>", f'<body pos="{tip}">{mass}</body></body>')
    plant = foreign.Plant(replace(user, joint=joints[0], changes=(change,)))
    middle = np.array([link.middle_rad for link in user.links])
    seeds = [[case.seed, k] for k in range(MOTIONS)]
    targets = [middle + _waves(seed, len(joints)) for seed in seeds]
    rest = [plant.record(f"motion_{k}", target, k) for k, target in enumerate(targets)]
    again = plant.record("again", targets[0], 9, repeat_of="motion_0")
    made = Measurements((*rest[:3], again), tuple(rest[3:5]), (rest[5],))
    machine = load_machine(plant.robot_file(folder))
    row = Recorded(machine, joints, made, folder, began).diagnosed(1, {})
    truth = mass_kg if case.hidden == "payload" else math.degrees(lean)
    return row | _shared_answer(row, case.hidden, float(truth), down)


MOTIONS = 6
"""Motions of a case with several joints: three to fit, two for validation, one for the test."""


def _waves(seed: Sequence[int], joints: int) -> np.ndarray:
    """(T, J) sums of three sines for 8 s, from rest [rad]."""
    rng = np.random.default_rng(seed)
    moving = np.arange(-0.5, 7.5, 1.0 / foreign.RATE_HZ).clip(0.0)[:, None]
    hz, sizes = rng.uniform([[0.1], [0.1]], [[1.2], [0.3]], (3, 2, joints)).swapaxes(
        0, 1
    )
    waves = sizes * np.sin(2.0 * np.pi * hz * moving[:, None])
    return waves.sum(axis=1) * moving.clip(0.0, 1.0)


def _shared_answer(row: Row, hidden: str, true: float, down: np.ndarray) -> Row:
    """By the corrected file: the number within 10 % or half a degree, and no effect."""
    file = row.get("file", {"joints": {}})
    joints = file["joints"].values()
    written = [e for joint in joints for e in joint.get("effects") or []]
    stated = [e["mass_kg"] for e in written if e["effect"] == "payload"]
    off = abs(stated[0] / true - 1.0) / 0.1 if stated else math.inf
    if hidden == "tilt" and "gravity" in file:
        found = np.array(file["gravity"]) / np.linalg.norm(file["gravity"])
        lean, off = np.degrees(
            np.arccos(np.clip(np.array([UPRIGHT, down]) @ found, -1.0, 1.0))
        )
        stated, off = [lean], off / 0.5
    others = [e for e in written if e["effect"] not in (hidden, "speed_delay")]
    answer = "exact" if off < 1.0 and not others else "named" if stated else "wrong"
    parts = row["parts"].items()
    names = [f"{part}:{name}" for part, of in parts for name in of["found"]]
    return {"answer": answer, "true": true, "stated": stated, "found": names}


RUNS: dict[str, Callable[[Case, Path], Row]] = {
    "robots": _robot,
    "robot_pairs": _pair,
    "servos": _servo,
    "cells": _cells,
    "shared": _shared,
}
"""Study → how a case of it is run; the others are the main study's."""


# two builds side by side

GOOD = ("exact", "named", "silent", "said")
AS_STATED = 0.05
"""Largest share by which an error may differ from what is stated."""


def read(path: Path) -> dict[str, Row]:
    """Key → row, the last one of each case."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["key"]: row for row in map(json.loads, lines)}


def _cpu(rows: Sequence[Row]) -> str:
    """Median and 90th percentile of CPU-seconds."""
    cpu = [r["cpu_s"] for r in rows if "cpu_s" in r] or [math.nan]
    return f"{np.median(cpu):.1f} / {np.quantile(cpu, 0.9):.1f}"


def _held(rows: Sequence[Row]) -> str:
    """Numbers whose interval holds the truth, of those with a known truth."""
    numbers = [n for r in rows for n in r.get("numbers", {}).values() if len(n) == 4]
    held = sum(low <= true <= high for _, low, high, true in numbers)
    return f"{held} of {len(numbers)}"


def _as_stated(rows: Sequence[Row]) -> str:
    """Cases whose corrected file has the error that was stated."""
    asked = [r for r in rows if "written" in r or "written_failed" in r]
    return f"{sum(map(_is_as_stated, asked))} of {len(asked)}"


def _is_as_stated(row: Row) -> bool:
    pairs_ = [
        (_stated(row, part).get(use, math.nan), errors)
        for part, of in row.get("written", {}).items()
        for use, errors in of.items()
    ]
    return bool(pairs_) and all(
        min(abs(e - stated) for e in errors) <= AS_STATED * stated
        for stated, errors in pairs_
    )


def _stated(row: Row, part: str) -> dict[str, float]:
    """Use → error that a report states of a part; rows of earlier builds have the fit's."""
    return (
        row.get("stated_errors", {}).get(part) or row["parts"][part]["errors"]["after"]
    )


def _right(rows: Sequence[Row]) -> str:
    """Cases with a right answer, of which exact."""
    answers = [r.get("answer") for r in rows]
    return f"{sum(a in GOOD for a in answers)} ({answers.count('exact')})"


def compare(old: Path, new: Path) -> list[str]:
    """Lines of Markdown: the cases that both files have, study by study."""
    before, after = read(old), read(new)
    keys = [case.key for case in sample() if case.key in before and case.key in after]
    lines = [f"{len(keys)} cases, all simulated: {old.name} → {new.name}", ""]
    lines += [
        "| study | n | right (exact) | CPU-s, median / 90th percentile | CPU, sum "
        "| simulations, sum | intervals hold | file as stated |"
    ]
    lines += ["|" + "---|" * 8]
    for name in [*dict.fromkeys(before[k]["study"] for k in keys), "all"]:
        sides = [
            [s[k] for k in keys if name in (s[k]["study"], "all")]
            for s in (before, after)
        ]
        cells_ = [" → ".join(map(f, sides)) for f in (_right, _cpu)]
        sums = [
            [sum(r.get(n, 0) for r in rows) for rows in sides]
            for n in ("cpu_s", "simulations")
        ]
        cells_ += [f"× {b / a:.2f}" if a else "–" for a, b in sums]
        cells_ += [" → ".join(map(f, sides)) for f in (_held, _as_stated)]
        lines.append(f"| {name} | {len(sides[0])} | {' | '.join(cells_)} |")
    changed = [k for k in keys if _what(before[k]) != _what(after[k])]
    lines += ["", f"Answers that changed: {len(changed)}"]
    lines += [f"- {k}: {_words(before[k])} → {_words(after[k])}" for k in changed]
    slow = sorted(keys, key=lambda k: -after[k].get("cpu_s", 0.0))[:10]
    lines += [
        "",
        "Slowest in the second: " + "; ".join(f"{k} {_cpu([after[k]])}" for k in slow),
    ]
    return lines


def _what(row: Row) -> tuple[str, list[str], str]:
    return row.get("answer", ""), sorted(row.get("found", [])), row.get("status", "")


def _words(row: Row) -> str:
    if "failed" in row:
        return f"failed ({row['failed'].strip().splitlines()[-1]})"
    errors = [f"{e:.2f}" for use, e in row["errors"]["after"].items() if use != "fit"]
    size = f", {row.get('stated')} for {row['true']}" if "true" in row else ""
    found = "+".join(row["found"]) or "nothing"
    return f"{row['answer']}: {found}{size}, {row['status']}, {'/'.join(errors)} floors"


def main(words: Sequence[str]) -> None:
    """Run what is missing, or compare two files."""
    if words[:1] == ["compare"]:
        print("\n".join(compare(Path(words[1]), Path(words[2]))))
        return
    parser = argparse.ArgumentParser(prog="pipelines.judge")
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cases", default="*", help="studies or keys, by commas")
    parser.add_argument("--limit_s", type=float, default=1500.0)
    options = parser.parse_args(words)
    there = {k for k, row in read(options.rows).items() if "failed" not in row}
    # The slowest studies first, so that no core waits at the end.
    late = {
        n: k for k, n in enumerate(("shared", "robot_pairs", "pairs pack", "servos"))
    }
    cases = [c for c in sample(options.cases) if c.key not in there]
    cases.sort(key=lambda c: late.get(c.study, len(late)))
    if not cases:
        sys.exit("nothing to run: all rows are there, or no case has that name")
    for case in sample("none chirp,none press,cells none*,robots none 70000"):
        print(
            f"compiled for {run(case)['key']}", flush=True
        )  # before many processes do

    def take(index: int, outcome: Done | Failed) -> None:
        case = cases[index]
        row = {"key": case.key, "study": case.study, "hidden": case.hidden}
        if isinstance(outcome, Done):
            row = outcome.result
        else:
            row["failed"] = outcome.trace or outcome.reason
        with options.rows.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, ensure_ascii=False, default=float) + "\n")
        print(f"{case.key}: {row.get('answer', 'failed')}, {_cpu([row])}", flush=True)

    care = Care(limit_s=options.limit_s)
    run_in_processes(run, cases, options.workers, str, take, care)


if __name__ == "__main__":
    main(sys.argv[1:])
