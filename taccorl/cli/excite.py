"""``taccorl excite --twin=twin.yaml --joint=left_joint5 --effects=backlash,joint_compliance``: which motion to record next.

Every motion of the library is scored by how far apart it keeps the rival explanations, in noise floors, however each is
refitted; what is recorded already (--measurements) counts. Motions beyond the joint's limits or the motor's torque are refused.
Writes a recording plan: plan.yaml, and for each motion a table of targets at 200 Hz, which a driver can send.
"""

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError

if TYPE_CHECKING:
    from taccorl.diagnosis.excitation import Plan


@dataclass(kw_only=True)
class ExciteConfig:
    """Which motion to record next, so that rival effects can be told apart."""

    joint: str
    """left_joint5."""
    effects: list[str] = field(default_factory=list)
    """Rivals, two or more; those of the diagnosis in --diagnosis if not given."""
    twin: Path | None = None
    """twin.yaml; the nominal twin if not given."""
    measurements: Path | None = None
    """Recordings that are there already."""
    diagnosis: Path = Path("diagnosis")
    """Folder of a diagnosis: its fitted numbers, and its rivals where no effects are given."""
    gains: Literal["auto", "commanded", "fitted"] = "auto"
    """``fitted``: nobody knows the gains, which then take up more."""
    floor_rad: float = 2e-4
    """Noise floor of the angle; that of the recordings where there are any."""
    num: int = 3
    """So many motions are written, best first."""
    out: Path = Path("recording_plan")
    """Folder of the plan; it must not be there yet."""


def main(argv: list[str]) -> int:
    """0: a motion tells them apart; 1: none does."""
    config = parse(ExciteConfig, argv, positional="joint")
    if config.out.exists():
        raise TaccorlError(f"{config.out}: is there already; give another --out, or remove it")
    from taccorl.alignment.measurements import read_measurements
    from taccorl.alignment.noise_floor import noise_floor
    from taccorl.cli.measured import twin_of
    from taccorl.cli.tables import Bars
    from taccorl.diagnosis.excitation import plan, rest_pose
    from taccorl.diagnosis.motions import LIBRARY, joint_number
    from taccorl.diagnosis.replays import BENCH_REST

    joint_number(config.joint)
    twin = twin_of(config.twin)
    rivals, fitted = _rivals(config)
    measurements = None if config.measurements is None else read_measurements(config.measurements)
    floor_rad = config.floor_rad
    if measurements is not None:
        swept = [m for m in measurements.all if config.joint in m.signals]
        if not swept:
            raise TaccorlError(f"{config.measurements}: no recording has {config.joint}")
        floor_rad = noise_floor([m.on_robot(BENCH_REST) for m in swept])[config.joint].value
    with Bars(len(LIBRARY)) as bars:
        count = 0

        def done(name: str) -> None:
            nonlocal count
            count += 1
            bars.update(name, count, len(LIBRARY))

        found = plan(
            twin,
            config.joint,
            rivals,
            pose=rest_pose(config.joint, measurements),
            floor_rad=floor_rad,
            measurements=measurements,
            gains=config.gains,
            fitted=fitted,
            done=done,
        )
    _table(found)
    _write(found, config)
    return int(bool(found.hopeless))


def _rivals(config: ExciteConfig) -> tuple[list[str], dict[str, dict[str, float]]]:
    """Effects to tell apart, and the numbers that a diagnosis fitted with each."""
    import json

    from taccorl.diagnosis.report import NUMBERS
    from taccorl.sim.effects import effects

    path = config.diagnosis / NUMBERS
    d = {}
    if path.is_file():
        d = json.loads(path.read_text(encoding="utf-8")).get("diagnoses", {}).get(config.joint, {})
    rows = [e for r in d.get("rounds", [])[:1] for e in r["evidence"]]
    fitted = {e["name"]: e["base"] | e["values"] for e in rows}
    names = config.effects
    if not names:
        names = [n for name, others in d.get("rivals", {}).items() for n in (name, *others)]
        if len(names) < 2:
            raise TaccorlError(
                f"excite: which effects are to be told apart? {path} names no rivals of {config.joint}; "
                "give --effects=backlash,joint_compliance"
            )
    names = [part for name in names for part in name.split(",")]
    for name in names:
        effects.get(name)
    return names, fitted


def _table(found: "Plan") -> None:
    from rich.table import Table

    from taccorl.cli.tables import console
    from taccorl.diagnosis.excitation import SAME, TELLS

    pairs = list(found.planned[0].discrimination) if found.planned else []
    table = Table(box=None, pad_edge=False)
    for head in ("motion", "gains", "payload", "peak torque", *pairs):
        table.add_column(head, justify="left" if head == "motion" else "right", overflow="fold")
    for p in found.planned:
        apart = [f"{p.discrimination[pair]:.2f} ×" for pair in pairs]
        payload = f"{p.motion.payload_kg:g} kg" if p.motion.payload_kg else ""
        table.add_row(p.motion.name, f"× {p.motion.gain:g}", payload, f"{p.peak_torque_nm:.2f} N·m", *apart)
    out = console()
    out.print(f"{found.signal}: noise floors ({found.floor_rad * 1e3:.3g} mrad) that stay between rivals after a refit")
    out.print(table)
    for name, why in found.refused.items():
        out.print(f"not {name}: {why}")
    for pair in found.hopeless:
        best = found.best(pair)
        same = (
            "from angles they are the same thing, pick either, or record efforts"
            if best < SAME
            else "no single motion tells them apart for sure"
        )
        out.print(f"{pair}: {best:.2f} floors at best, less than {TELLS:g}: {same}")


def _write(found: "Plan", config: ExciteConfig) -> None:
    import yaml

    from taccorl.diagnosis.motions import RATE_HZ

    config.out.mkdir(parents=True)
    chosen = found.planned[: config.num]
    entries = []
    for number, p in enumerate(chosen, 1):
        name = f"{number}_{p.motion.name}.csv"
        with (config.out / name).open("w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            rows.writerow(["t", f"{found.signal}.q_target"])
            rows.writerows([f"{k / RATE_HZ:.3f}", f"{q:.6f}"] for k, q in enumerate(p.target))
        entries.append(
            {
                "table": name,
                "gains": f"{p.motion.gain:g} times the usual",
                "payload_kg": p.motion.payload_kg,
                "seconds": round(len(p.target) / RATE_HZ, 1),
                "range_rad": [round(float(p.target.min()), 4), round(float(p.target.max()), 4)],
                "peak_torque_nm": round(p.peak_torque_nm, 3),
                "floors_apart": {pair: round(apart, 2) for pair, apart in p.discrimination.items()},
            }
        )
    words = {
        "joint": found.signal,
        "tells_apart": list(found.rivals),
        "rate_hz": RATE_HZ,
        "units": "t in s, q_target in rad",
        "how": "begin and end at rest; hold the other joints; record one motion twice",
        "motions": entries,
    }
    path = config.out / "plan.yaml"
    path.write_text(yaml.safe_dump(words, sort_keys=False, allow_unicode=True), encoding="utf-8")
    print(f"wrote {path} and {len(entries)} tables of targets")
