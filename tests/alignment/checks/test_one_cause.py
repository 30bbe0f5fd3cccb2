"""A column that is wrong in all recordings of a set has one cause, whatever each recording by itself looks like."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from scipy.signal import lsim  # pyright: ignore[reportAttributeAccessIssue]

from taccorl.alignment.checks.telemetry import check_measurements, one_cause
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding

RATE_HZ = 200


def followed(name: str, low_hz: float, high_hz: float) -> Measurement:
    """A sweep of ± 0.4 rad that a joint of 0.5 kg·m², 80 N·m/rad and 8 N·m·s/rad follows, above 2 Hz nearly against it."""
    time_s = np.arange(8 * RATE_HZ) / RATE_HZ
    since = np.clip(time_s - 1.0, 0.0, None)
    target = 0.4 * np.sin(
        2 * np.pi * (low_hz * since + (high_hz - low_hz) * since**2 / 14.0)
    )
    at = lsim(([80.0], [0.5, 8.0, 80.0]), target, time_s, interp=False)[1]
    noise = np.random.default_rng(len(name)).standard_normal(len(at))
    return of_signal(
        name, RATE_HZ, target, at + 5e-5 * noise, "table", source=Path(name)
    )


CLEAN = [
    followed("slow.csv", 0.1, 0.8),
    followed("wide.csv", 0.1, 2.5),
    followed("fast_one.csv", 0.3, 5.0),
]


def turned(m: Measurement) -> Measurement:
    return dataclasses.replace(m, measured=-m.measured)


def errors(findings: dict[str, list[Finding]]) -> dict[str, set[str]]:
    return {
        name: {f.check for f in own if f.severity == "error"}
        for name, own in findings.items()
    }


@pytest.mark.parametrize("field", ["measured", "target"])
def test_a_turned_sign_is_one_cause_although_a_fast_motion_looks_early(field: str):
    wrong = [dataclasses.replace(m, **{field: -getattr(m, field)}) for m in CLEAN]
    alone = check_measurements(wrong)
    assert errors(alone)["fast_one.csv"] == {"measured_before_command"}
    found = one_cause(alone, wrong)
    assert (
        set(map(frozenset, errors(found).values())) == {frozenset({"reversed"})}
        and len(found) == 3
    )
    assert not any("target_rows_late" in f.text for own in found.values() for f in own)
    assert any("slow.csv" in f.text for f in found["fast_one.csv"])


def test_efforts_that_oppose_the_acceleration_as_well_say_which_column_is_turned():
    wrong = [turned(m) for m in CLEAN]
    found = check_measurements(wrong)
    found["slow.csv"].append(Finding("reversed_effort", "error", "table", "effort"))
    said = one_cause(found, wrong)
    assert errors(said)["slow.csv"] == {"reversed"} and any(
        f.text.endswith("table.q") for f in said["slow.csv"]
    )


def test_late_targets_of_one_recording_explain_efforts_that_seem_to_answer_them_in_all():
    early = dataclasses.replace(
        CLEAN[2], measured=np.roll(CLEAN[2].measured, -50, axis=0)
    )
    found = check_measurements([*CLEAN[:2], early])
    for name, signal in (
        ("slow.csv", "table"),
        ("fast_one.csv", "table"),
        ("wide.csv", "other"),
    ):
        found[name].append(Finding("effort_time", "error", signal, "effort"))
    said = errors(one_cause(found, [*CLEAN[:2], early]))
    assert said == {
        "slow.csv": set(),
        "wide.csv": {"effort_time"},
        "fast_one.csv": {"measured_before_command"},
    }


def test_exchanged_columns_are_one_cause():
    wrong = [
        dataclasses.replace(m, measured=m.target, target=m.measured) for m in CLEAN
    ]
    alone = check_measurements(wrong)
    found = one_cause(alone, wrong)
    assert {"exchanged_target"} in errors(alone).values()
    assert all(checks <= {"exchanged_target"} for checks in errors(found).values())


def test_a_recording_with_another_fault_keeps_it_and_sound_ones_keep_all():
    early = dataclasses.replace(
        CLEAN[2], measured=np.roll(CLEAN[2].measured, -50, axis=0)
    )
    wrong = [turned(CLEAN[0]), turned(CLEAN[1]), early]
    found = errors(one_cause(check_measurements(wrong), wrong))
    assert found == {
        "slow.csv": {"reversed"},
        "wide.csv": {"reversed"},
        "fast_one.csv": {"measured_before_command"},
    }
    alone = check_measurements(CLEAN)
    assert one_cause(alone, CLEAN) == alone and not any(errors(alone).values())


def test_columns_of_two_joints_that_are_exchanged_are_one_cause_in_every_recording():
    """hand rests at 0.4 rad, shaken by 8 % of table's motion: alone, that looks like a dead channel or another unit; effort and
    offset of either joint are judged against the other's position."""
    wrong, rng, names = (
        [],
        np.random.default_rng(1),
        {"signals": ("table", "hand"), "units": ("rad", "rad")},
    )
    for m in CLEAN:
        rests = 0.4 + 0.08 * m.measured + 2e-4 * rng.standard_normal(m.measured.shape)
        columns = {
            "measured": np.hstack([rests, m.measured]),
            "target": np.hstack([m.target, 0.4 + 0.0 * m.target]),
        }
        wrong.append(
            Measurement(
                name=m.name, source=m.source, time_s=m.time_s, **names, **columns
            )
        )
    alone = check_measurements(wrong)
    assert "swapped_joints" in set().union(*errors(alone).values())
    for name in alone:
        alone[name].append(
            Finding("effort_unit", "error", "table", "efforts", topic="effort unit")
        )
    found = one_cause(alone, wrong)
    said = {
        (f.check, f.topic, f.text[:44])
        for own in found.values()
        for f in own
        if f.feature
    }
    assert said == {
        (
            "swapped_joints",
            "hand ↔ table",
            "table does not follow its command, hand does",
        )
    }
