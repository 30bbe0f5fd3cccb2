"""Words of a plan of recordings by the kind of its part: entries of plan.yaml, and facts about each motion or press."""

from collections.abc import Iterator
from typing import Any

from taccorl.alignment.machines.cells_file import LOADS
from taccorl.alignment.measurements.presses import RADIUS_M
from taccorl.diagnosis.experiment_design.loads import CellsPart
from taccorl.diagnosis.experiment_design.motions import EFFORT_SHARE, JointPart
from taccorl.diagnosis.experiment_design.plan import Part, Plan, Planned
from taccorl.diagnosis.experiment_design.presses import PadsPart
from taccorl.diagnosis.problems.touch_problem import FRAMES_A_ROW
from taccorl.report.planned import Words


def words(part: Part) -> Words:
    """Words of a part of any kind."""
    if isinstance(part, JointPart):
        return _of_joint(part)
    if isinstance(part, PadsPart):
        return _of_pads(part)
    assert isinstance(part, CellsPart)
    return _of_cells(part)


def _of_joint(part: JointPart) -> Words:
    ground, unit, of_piper = part.ground, part.drive.unit, part.ground.of_piper
    small, factor = ("µm", 1e6) if unit == "m" else ("mrad", 1e3)
    peak = "peak force with weight" if unit == "m" else "peak torque with weight"
    place = {"pose": part.pose} if of_piper else {}
    checked = "Collisions are not checked: look where the motion goes. "
    stand = (
        "Gains as in the file; other joints stand where the model's zero pose has them"
    )
    stand = (
        f"Masses and gains as in {ground.like.name}, other joints there, too"
        if ground.like
        else stand
    )
    kind = unit + "/s" * part.column.endswith("qd_target")
    units = f"t in s, {part.column} and range in {kind}, peak_effort in {ground.effort_unit}"
    how = f"{checked}Begin and end at rest; record one motion twice. {stand}"
    if of_piper:
        units = "t in s, q_target in rad"
        how = (
            "begin and end at rest; hold the other joints where `pose` says (rad, gripper m); record one motion twice; "
            "payload_kg is held at the TCP, peak_torque_nm includes the carried weight"
        )

    def entry(p: Planned) -> dict[str, Any]:
        target = p.columns[part.column]
        seconds, ends = (
            round(len(target) / ground.rate_hz, 1),
            (float(target.min()), float(target.max())),
        )
        if of_piper:
            own = {
                "gains": f"{p.item.gain:g} times the usual",
                "payload_kg": p.item.payload_kg,
                "seconds": seconds,
            }
            return own | {
                "range_rad": [round(x, 4) for x in ends],
                "peak_torque_nm": round(p.peak, 3),
            }
        ends = [float(f"{x:.6g}") for x in ends]
        return {
            "seconds": seconds,
            "range": ends,
            "peak_effort": float(f"{p.peak:.4g}"),
        }

    def row(p: Planned) -> tuple[str, ...]:
        payload = f"{p.item.payload_kg:g} kg" if p.item.payload_kg else ""
        return f"× {p.item.gain:g}", payload, f"{p.peak:.3g} {ground.effort_unit}"

    def remarks(found: Plan) -> Iterator[str]:
        most = part.drive.effort_limit
        limit = "" if most is None else f", {EFFORT_SHARE:.0%} of effort_limit {most:g}"
        low, high = ground.span
        for name, far in found.reaches.items():
            if far < 1.0:
                yield (
                    f"{name}: no motion reaches the suspected limit, the nearest goes to {far:.0%} of it. Motions stay within "
                    f"{low:.4g} … {high:.4g} {unit} (--span=), {ground.room.speed_rad_per_s:.3g} {unit}/s (--speed=){limit}; "
                    "allow more if the machine may, or the effect stays undecided"
                )

    return Words(
        kind=("joint" if of_piper else "part", "motions"),
        heads=("motion", "gains", "payload", peak),
        floor=f"{part.floor * factor:.3g} {small}",
        same=f"from angles{' and efforts' * part.efforts} they are the same thing, pick either",
        facts={"units": units, **place, "how": how},
        entry=entry,
        row=row,
        remarks=remarks,
    )


def _of_pads(part: PadsPart) -> Words:
    def entry(p: Planned) -> dict[str, Any]:
        target, *_ = p.columns.values()
        return {
            "seconds": round(len(target) / part.rate_hz, 1),
            "depth_m": round(float(p.item.penetration_m().max()), 6),
            "range_m": [round(float(target.min()), 6), round(float(target.max()), 6)],
            "peak_force_n": round(p.peak, 1),
            "pressed": p.item.pressed(part.arm).entry(),
        }

    def row(p: Planned) -> tuple[str, ...]:
        size = f"{p.item.shape} of {1e3 * RADIUS_M[p.item.shape]:g} mm"
        return size, f"{1e3 * p.item.penetration_m().max():.2f} mm", f"{p.peak:.0f} N"

    return Words(
        kind=("pads", "presses"),
        heads=("press", "radius", "depth", "peak force"),
        floor=f"{part.floor:.2g} counts, a taxel's mean over {FRAMES_A_ROW} frames",
        same="from what pads read in a known object they are the same thing, pick either",
        facts={
            "units": "t in s, q_target and opening in m",
            "how": "hold the object where `pressed` says, in the hand's own frame, and the arm still; record pads and measured "
            "opening, one press twice; put `pressed` under the recording's name in measurements.yaml",
            "targets": "q_target is what to command a gripper that yields as the twin's does, opening is where its fingers shall "
            "then be; a gripper that goes where it is told is sent the opening",
        },
        entry=entry,
        row=row,
    )


def _of_cells(part: CellsPart) -> Words:
    unit = part.config.load.unit

    def lasts_s(p: Planned) -> float:
        return (p.made.num_rows - 1) / part.rate_hz

    def remarks(found: Plan) -> Iterator[str]:
        if part.place_mm is not None:
            x, y = part.place_mm
            yield f"all presses at x {x:.4g} mm, y {y:.4g} mm, a place of the recordings"

    return Words(
        kind=("sensor", "presses"),
        heads=("press", "highest load", "lasts"),
        floor=f"{part.floor:.3g} {part.config.reading.unit}, the median cell",
        same="from readings under these loads they are the same thing, pick either",
        facts={
            "units": f"t in s, {LOADS[unit][0]}, highest_load in {unit}",
            "how": "apply the load over time as well as your press can, record the load that acts and the readings, one press "
            "twice; the recording need not follow the table exactly",
        },
        entry=lambda p: {
            "seconds": round(lasts_s(p), 1),
            "highest_load": float(f"{p.peak:.4g}"),
        },
        row=lambda p: (f"{p.peak:.3g} {unit}", f"{lasts_s(p):.0f} s"),
        remarks=remarks,
    )
