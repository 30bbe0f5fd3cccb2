"""Registers that were logged without their sign: found in tables of every form, read by the line that is printed."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest

from taccorl.alignment.checks.registry import run
from taccorl.alignment.checks.robot import beyond_effort, reversed_effort
from taccorl.alignment.checks.telemetry import check_measurement, one_cause
from taccorl.alignment.checks.trial import Trial
from taccorl.alignment.machines.robot_file import JointConfig
from taccorl.alignment.measurements.registers import Register, find_registers
from taccorl.alignment.measurements.tables import load_table_spec, read_table
from taccorl.errors import RecordingError, SpecError

SIGN_10, SIGN_15 = Register("sign_bit", 2.0**10), Register("sign_bit", 2.0**15)
WRAP_16, WRAP_32 = Register("wraps_at", 2.0**16), Register("wraps_at", 2.0**32)
TIME_S = np.arange(1600) / 200
UNITS = {"elbow": "rad", "slide": "m"}


def effort(seed: int, offset: float = 0.0) -> np.ndarray:
    """(T,) effort of a sweep, of largest size 1: inertia, friction that changes sign at once, a constant weight and noise."""
    rng = np.random.default_rng(seed)
    phase = np.cumsum(2 * np.pi * np.geomspace(0.2, 2.0, len(TIME_S)) / 200)
    made = rng.uniform(0.3, 1) * np.sin(phase) + 0.2 * np.sign(np.cos(phase)) + offset
    made += rng.uniform(-0.2, 0.2) * np.cos(phase) + 0.005 * rng.normal(size=len(phase))
    return made / np.abs(made).max()


def logged(register: Register, counts: np.ndarray) -> np.ndarray:
    """The unsigned numbers of signed ``counts``, by the definition of both kinds of registers."""
    if register.key == "sign_bit":
        return np.where(counts < 0, register.value + np.abs(counts), counts)
    if register.key == "zero":
        return counts + register.value
    return np.where(counts < 0, register.value + counts, counts)


def test_minus_nine_in_each_register():
    signed = np.array([-9.0, 9.0, 0.0])
    for register, number in ((SIGN_10, 1033), (SIGN_15, 32777), (WRAP_16, 65527)):
        assert logged(register, signed).tolist() == [number, 9.0, 0.0]
        assert register.decoded(logged(register, signed)).tolist() == signed.tolist()


@pytest.mark.parametrize("register", [SIGN_10, SIGN_15, WRAP_16, WRAP_32])
@pytest.mark.parametrize("largest", [30, 300, 1000])
@pytest.mark.parametrize("step", [1.0, 0.1, 0.00269, 5.0])
def test_a_column_without_its_sign_is_named_with_its_register(register, largest, step):
    counts = np.round(largest * effort(7))
    found = find_registers(np.round(step * logged(register, counts), 6))
    assert len(found) == 1
    scaled, changes, row = found[0]
    assert scaled.key == register.key
    assert scaled.value == pytest.approx(step * register.value, rel=1e-9)
    first = np.flatnonzero(np.diff((counts < 0).astype(int)))[0] + 1
    assert changes >= 2 and row == first


# Signed, always above 0, magnitudes only, counts about the middle of their range, a motor that goes on and off.
@pytest.mark.parametrize("seed", range(20))
def test_no_ordinary_effort_is_accused(seed):
    counts = np.round(10 ** (1 + seed % 4) * effort(seed))
    on = counts - counts.min() + 900 * (TIME_S > 3) * (TIME_S < 6)
    columns = [counts, -counts, counts - counts.min(), np.abs(counts), on]
    columns += [counts + 512, counts + 2048, counts + 32768]
    for column in columns:
        for step in (1.0, 0.1, 0.00269):
            found = find_registers(np.round(step * column, 6))
            assert not [changes for _, changes, _ in found if changes]


def table(folder: Path, columns: dict[str, np.ndarray], form: str) -> Path:
    path = folder / "sweep.csv"
    rows = np.column_stack([TIME_S, *columns.values()])
    formats = ["%.3f", *("%.6f" if key[-4:] != ".tau" else form for key in columns)]
    header = ",".join(("t", *columns))
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt=formats)
    return path


def motion() -> np.ndarray:
    return 0.3 * np.sin(2 * np.pi * 0.5 * TIME_S)


@pytest.mark.parametrize("register", [SIGN_10, WRAP_16])
@pytest.mark.parametrize(("form", "step"), [("%d", 1.0), ("%.4f", 1.0), ("%.4f", 0.01)])
@pytest.mark.parametrize("own_names", [True, False])
def test_the_printed_line_reads_the_effort(tmp_path, register, form, step, own_names):
    signed = {"elbow": np.round(800 * effort(1)), "slide": np.round(60 * effort(2))}
    columns = {}
    for name, counts in signed.items():
        columns |= {f"{name}.q": motion(), f"{name}.q_target": motion()}
        columns[f"{name}.tau"] = step * logged(register, counts)
    path, spec = table(tmp_path, columns, form), None
    file = tmp_path / "columns.yaml"
    if not own_names:
        file.write_text(columns_file({}))
        spec = load_table_spec(file)
    m = read_table(path, spec, UNITS)
    found = {f.feature: f for f in check_measurement(m) if f.check == "unsigned_effort"}
    assert found.keys() == signed.keys()
    lines = {name: re.findall("`(.*?)`", f.text)[0] for name, f in found.items()}
    if own_names:
        inner = [line.removeprefix("changes: {")[:-1] for line in lines.values()]
        file.write_text(f"changes: {{{', '.join(inner)}}}\n")
    else:
        file.write_text(columns_file(lines))
    again = read_table(path, load_table_spec(file), UNITS)
    for name, counts in signed.items():
        own = again.effort[:, again.column(name)]
        factor = 1.0 if own_names else 0.02
        assert own == pytest.approx(factor * step * counts, abs=1e-9)
    assert "unsigned_effort" not in [f.check for f in check_measurement(again)]


def columns_file(lines: dict[str, str]) -> str:
    text = "time: {column: t, unit: s}\nsignals:\n"
    for name, unit in UNITS.items():
        tau = lines.get(name) or (
            f"tau: {{column: {name}.tau, unit: {'Nm' if unit == 'rad' else 'N'}, factor: 0.02}}"
        )
        text += f"  {name}: {{q: {{column: {name}.q, unit: {unit}}}, "
        text += f"q_target: {{column: {name}.q_target, unit: {unit}}}, {tau}}}\n"
    return text


def test_a_position_that_wraps_below_zero_is_named_with_its_line(tmp_path):
    ticks = np.round(2000 * motion())
    columns = {
        f"elbow.{key}": logged(WRAP_16, np.roll(ticks, k))
        for k, key in enumerate(("q_target", "q"))
    }
    file = tmp_path / "columns.yaml"
    text = "time: {column: t, unit: s}\nsignals: {elbow: {%s}}\n"
    key = "%s: {column: elbow.%s, unit: rad, factor: 0.001}"
    lines = [key % (name, name) for name in ("q", "q_target")]
    file.write_text(text % ", ".join(lines))
    path = table(tmp_path, columns, "%d")
    found = check_measurement(read_table(path, load_table_spec(file)))
    texts = [f.text for f in found if f.check == "unsigned_position"]
    lines = [re.findall("`(.*?)`", text)[0] for text in texts]
    assert [line.split(":")[0] for line in lines] == ["q", "q_target"]
    assert all("wraps_at: 65536" in line for line in lines)
    file.write_text(text % ", ".join(lines))
    again = read_table(path, load_table_spec(file))
    assert again.target[:, 0] == pytest.approx(0.001 * ticks)


def test_what_follows_from_the_lost_sign_is_not_said_beside_it(tmp_path):
    columns = {"elbow.q": motion(), "elbow.q_target": motion()}
    columns["elbow.tau"] = logged(SIGN_10, np.round(800 * effort(1)))
    m = read_table(table(tmp_path, columns, "%d"), None, UNITS)
    from taccorl.alignment.checks.registry import find

    more = [find("reversed_effort", "elbow", "x"), find("effort_limit", "elbow", "x")]
    found = one_cause({m.name: [*check_measurement(m), *more]}, [m])[m.name]
    assert {f.check for f in found} & {"reversed_effort", "effort_limit"} == set()
    assert "unsigned_effort" in {f.check for f in found}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("sign_bit: 1024, wraps_at: 65536", "exclude each other"),
        ("sign_bit: 0", "give the number of the sign bit"),
        ("wraps_at: -65536", "give the number of the sign bit"),
    ],
)
def test_wrong_keys_are_refused(tmp_path, keys, said):
    line = f"tau: {{column: elbow.tau, unit: Nm, {keys}}}"
    file = tmp_path / "columns.yaml"
    file.write_text(columns_file({"elbow": line}))
    with pytest.raises(SpecError, match=said):
        load_table_spec(file)


def test_numbers_that_the_register_cannot_hold_are_refused_with_their_row(tmp_path):
    for number in (-1.0, 2048.0):
        numbers = np.where(TIME_S == 0.05, number, 1.0)
        columns = {
            "elbow.q": motion(),
            "elbow.q_target": motion(),
            "elbow.tau": numbers,
        }
        file = tmp_path / "columns.yaml"
        file.write_text("changes: {elbow.tau: {sign_bit: 1024}}\n")
        path = table(tmp_path, columns, "%d")
        with pytest.raises(
            RecordingError, match=f"{number:g} in row 11 .*sign_bit: 1024"
        ):
            read_table(path, load_table_spec(file), UNITS)


def test_efforts_that_never_change_sign_are_left_to_the_machines_limits():
    counts = np.round(300 * (effort(3) - 1.5))
    found = find_registers(logged(WRAP_16, counts))
    assert {register.key for register, changes, _ in found if not changes} == {
        "sign_bit",
        "wraps_at",
    }
    assert math.isclose(found[-1][0].value, 65536)


@pytest.mark.parametrize(
    ("register", "numbers"), [(WRAP_16, 65527.0), (WRAP_32, 2.0**32 - 9)]
)
def test_minus_nine_beyond_the_limit_is_no_current(tmp_path, register, numbers):
    counts = np.round(3 * effort(1) - 9)
    assert counts.max() < 0 and logged(register, np.array([-9.0]))[0] == numbers
    columns = {"elbow.q": motion(), "elbow.q_target": motion()}
    columns["elbow.tau"] = logged(register, counts)
    m = read_table(table(tmp_path, columns, "%d"), None, UNITS)
    law = JointConfig(kp=20.0, kd=1.0, effort_limit=15.0)
    (found,) = beyond_effort(law, m, "elbow", "robot.yaml")
    assert found.check == "unsigned_effort"
    assert f"wraps_at: {register.value:.12g}" in found.text and "mA" not in found.text
    # 65 N·m of a large joint in mN·m, above no limit, are what they are.
    assert beyond_effort(JointConfig(kp=20.0, kd=1.0), m, "elbow", "robot.yaml") == []


def test_a_load_that_falls_where_its_law_asks_for_more_is_no_reversed_sign(tmp_path):
    counts = np.round(
        100 * effort(1) - 300
    )  # always below 0: the column holds 1024 + …
    columns = {"elbow.q": motion(), "elbow.q_target": motion()}
    columns["elbow.tau"] = logged(SIGN_10, counts)
    m = read_table(table(tmp_path, columns, "%d"), None, UNITS)
    (found,) = reversed_effort(m, "elbow", left=0.05, fit=None)
    assert found.check == "unsigned_effort" and "factor: -1" not in found.text
    assert "`changes: {elbow.tau: {sign_bit: 1024}}`" in found.text
    small = dataclasses.replace(m, registers=())
    assert reversed_effort(small, "elbow", 0.05, None)[0].check == "reversed_effort"


KP, KD, LIMIT = 60.0, 1.5, 20.0
LAW = {
    True: JointConfig(kp=KP, kd=KD, effort_limit=LIMIT),
    False: JointConfig(kp=KP, kd=KD),
}
"""Law with and without a stated limit of the effort."""


def driven(seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of a joint that moves, and its effort (T,) [N·m]: that of ``LAW`` at the
    row before. Its load, which sets the position error, changes sign in two of three
    seeds, else not."""
    rng = np.random.default_rng(seed)
    phase = np.cumsum(2 * np.pi * np.geomspace(0.2, 1.5, len(TIME_S)) / 200)
    target = 0.4 * np.sin(phase)
    weight = rng.choice([-6.0, 0.0, 6.0]) + rng.uniform(-1, 1)
    load = weight + 2.0 * np.sin(phase) + 0.3 * np.tanh(20 * np.cos(phase))
    late = np.r_[target[:1], target[:-1]]
    q = late - load / KP + 2e-5 * rng.normal(size=len(phase))
    made = KP * (late - q) - KD * np.gradient(q, TIME_S) + rng.normal(0, 0.01, len(q))
    return {"elbow.q": q, "elbow.q_target": target}, made


def planted(seed: int) -> tuple[int, str, int, float, int, bool]:
    """Bits, layout, sign of the register, factor of the logger, counts at 10 N·m, and
    whether the file states a limit of the effort."""
    rng = np.random.default_rng(1000 + seed)
    key = ("sign_bit", "wraps_at", "zero")[seed % 3]
    usual = [8, 10, 12, 14, 16, 24, 32, 48, 52]
    bits = int(rng.choice(usual if key == "zero" else [*usual, 9, 11, 40, 63, 64]))
    loggers = [1.0, -1.0, 0.1, -0.1, 0.00269, 5.0] if bits <= 16 else [1.0, -1.0]
    counts = int(min(0.85 * 2 ** (bits - 1), rng.choice([700, 3000])))
    return (
        bits,
        key,
        int(rng.choice([1, -1])),
        float(rng.choice(loggers)),
        counts,
        bool(rng.integers(2)),
    )


def written(number: int, factor: float) -> str:
    """A register's number as a logger writes it: whole ones with all digits."""
    if abs(factor) == 1.0:
        return str(int(factor) * number)
    return f"{factor * number:.10g}"


def of_effort(path: Path, spec: Path, law: JointConfig) -> tuple[list, np.ndarray]:
    """Findings on the effort, and the effort (T,) as it is read."""
    m = read_table(path, load_table_spec(spec), UNITS)
    found = [f for f in run("rows", Trial(m, {}, {})) if f.check == "unsigned_effort"]
    if not found:
        found = beyond_effort(law, m, "elbow", "robot.yaml")
    return found, m.effort[:, 0]


@pytest.mark.parametrize("batch", range(6))
def test_random_registers_are_read_by_the_line_that_is_printed(tmp_path, batch):
    """72 registers of 8 to 64 bits of a joint whose law is known, above or below 0 in the
    table: named, and read again with the line."""
    for seed in range(12 * batch, 12 * batch + 12):
        case = bits, key, sign, logger, most, has_limit = planted(seed)
        columns, made = driven(seed)
        half = 2 ** (bits - 1)
        counts = [round(sign * most / 10.0 * tau) for tau in made]
        of = {
            "sign_bit": [n if n >= 0 else half - n for n in counts],
            "wraps_at": [n % (2 * half) for n in counts],
            "zero": [n + half for n in counts],
        }
        assert max(of[key]) < 2 * half
        tau = [written(n, logger) for n in of[key]]
        rows = zip(TIME_S, *columns.values(), tau, strict=True)
        text = "\n".join(
            f"{t:.3f},{q:.6f},{target:.6f},{n}" for t, q, target, n in rows
        )
        path, spec = tmp_path / "sweep.csv", tmp_path / "columns.yaml"
        path.write_text(f"t,elbow.q,elbow.q_target,elbow.tau\n{text}\n")
        factor = sign * 10.0 / most / logger
        line = f"tau: {{column: elbow.tau, unit: Nm, factor: {factor:.15g}}}"
        one = "time: {column: t, unit: s}\nsignals: {elbow: {q: {column: elbow.q, "
        one += "unit: rad}, q_target: {column: elbow.q_target, unit: rad}, %s}}\n"
        spec.write_text(one % line)
        found, _ = of_effort(path, spec, LAW[has_limit])
        if key != "zero" and min(counts) >= 0:
            assert not found, (seed, case)  # its numbers are those of a signed column
            continue
        assert [f.check for f in found] == ["unsigned_effort"], (seed, case)
        spec.write_text(one % re.findall("`(.*?)`", found[0].text)[0])
        found, effort = of_effort(path, spec, LAW[has_limit])
        signed = sign * 10.0 / most * np.array(counts)
        assert effort == pytest.approx(signed, abs=1e-6), (seed, case)
        assert not found, (seed, case)


@pytest.mark.parametrize("has_limit", [True, False])
def test_no_clean_register_is_named(tmp_path, has_limit):
    """24 signed columns: of both signs, and of a weight that keeps them above or below
    0 up to near powers of two."""
    for seed in range(24):
        columns, made = driven(seed)
        most = (64, 700, 3000)[seed % 3]
        counts = np.round(most / 10.0 * (made + (seed % 4) * np.sign(made.mean())))
        form, step = (("%d", 1.0), ("%.6f", 0.00269))[seed % 2]
        tau = {"elbow.tau": step * counts}
        path, spec = table(tmp_path, columns | tau, form), tmp_path / "columns.yaml"
        line = f"elbow.tau: {{factor: {10.0 / most / step:.12g}}}"
        spec.write_text(f"changes: {{{line}}}\n")
        found, effort = of_effort(path, spec, LAW[has_limit])
        assert effort == pytest.approx(10.0 / most * counts, abs=1e-3)
        assert not found, seed


def test_offset_binary_of_a_joint_is_no_current(tmp_path):
    """2048 + counts of 0.01 N·m: 20.48 N·m beside the law, within no limit that is
    stated. One finding before gives the factor, as of any other unit."""
    columns, made = driven(3)
    counts = np.round(made / 0.01)
    path = table(tmp_path, columns | {"elbow.tau": 2048 + counts}, "%d")
    spec = tmp_path / "columns.yaml"
    spec.write_text("changes: {elbow.tau: {factor: 0.01}}\n")
    (found,), _ = of_effort(path, spec, LAW[False])
    assert "`changes: {elbow.tau: {factor: 0.01, zero: 2048}}`" in found.text
