"""The first three sentences of a report, by their facts: kind, level, names, numbers, command; and its other words."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from made_problem import Added, Bump, MadeProblem, Ripple, Square, Squire, record
from made_traces import comparison, trace

from taccorl.data.finding import Finding
from taccorl.diagnosis.comparison.regimes import RegimeError
from taccorl.diagnosis.machines.changed_findings import without_numbers
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Identified, Known
from taccorl.diagnosis.search.result import (
    Changed,
    Diagnosis,
    SearchConfig,
    gains_nothing,
    of_test,
)
from taccorl.diagnosis.search.search import diagnose
from taccorl.diagnosis.search.solve import PartFinding
from taccorl.report.diagnosed import _to_add, brief
from taccorl.report.evidence_words import (
    evidence_words,
    excite_command,
    may_be_two,
    may_stand_in,
    unit_words,
    unjudged,
)
from taccorl.report.report import Report
from taccorl.report.section import cell
from taccorl.report.verdict import verdict
from taccorl.sim.effects import make_effect

PART = "left_joint5"


@pytest.fixture(scope="module")
def one() -> Diagnosis:
    """A ripple, and nothing like it."""
    kinds, hidden = (Ripple, Bump), Ripple(strength=1.0)
    recordings = [record(k, hidden) for k in range(3)]
    return diagnose(
        MadeProblem(*kinds), recordings[:1], recordings[1:2], recordings[2:]
    )


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnose(MadeProblem(Ripple), [record(0)], [record(1)], [record(2)])


def changed(d: Diagnosis, **fields: Any) -> Diagnosis:
    return dataclasses.replace(d, **fields)


def test_a_named_effect_is_said_with_its_errors_and_its_identified_size(one):
    number = Identified(
        name="ripple.strength/kp", value=0.002, low=0.0019, high=0.0021, unit="rad"
    )
    known = Known(
        identifiable=(number,),
        absolute=(
            Identified(name="kp", value=151.0, low=110.0, high=152.0, unit="N·m/rad"),
        ),
        pinned_by=(),
    )
    v = verdict(PART, one, known=known)
    assert (v.kind, v.level) == ("effects", "high")
    assert all(
        f"{one.errors[stage]['validation']:.2f}" in v.finding
        for stage in ("fitted", "after")
    )
    assert (
        PART in v.finding
        and "ripple" in v.finding
        and "0.002 rad (0.0019 … 0.0021)" in v.finding
    )
    assert f"{one.errors['after']['test']:.2f}" in v.confidence
    assert "110" in v.record_next and "152" in v.record_next, (
        "what the recordings leave of K_p"
    )
    pinned = verdict(
        PART, one, known=dataclasses.replace(known, pinned_by=("recorded effort",))
    )
    assert "K_p" not in pinned.record_next
    assert all(
        s.endswith(".") and "\n" not in s
        for s in (v.finding, v.confidence, v.record_next)
    )


def test_a_mass_that_may_be_in_two_bodies_is_said_of_both(one, nothing):
    """A joint judged with it has no numbers of the file that are off: they may make up for its place."""
    mass = (make_effect("payload", mass_kg=0.5, link="l6"),)
    tied = found(changed(one, effects=mass, present=(), or_in=("l5",)))
    v = verdict("a4", tied.diagnosis)
    assert (
        "a4 lacks payload in l6 or in l5" in v.finding
        and "l5" in v.confidence
        and v.level == "moderate"
    )
    off = Changed(
        name="torque_ff", before=0.0, after=0.12, unit="N·m", without=2.0, alone=False
    )
    other = found(changed(nothing, status="numbers_off", changed=(off,)))
    judged = without_numbers(other, tied).diagnosis
    assert (judged.status, judged.changed) == (
        "nothing_missing",
        (),
    ) and "torque_ff" in judged.remarks[-1]
    assert without_numbers(other, found(one)) is other


def test_errors_fall_from_those_of_the_twin_as_it_was_where_its_refit_is_worse(one):
    errors = {**one.errors, "before": {"fit": 9.0, "validation": 3.21, "test": 4.56}}
    assert one.errors["fitted"]["validation"] > 3.21
    finding = verdict(PART, changed(one, errors=errors)).finding
    after = one.errors["after"]
    assert f"from 3.21 (the twin as it was) to {after['validation']:.2f}" in finding
    assert f"4.56 → {after['test']:.2f}" in finding


def test_nothing_missing_is_said_with_what_the_recordings_would_not_show(nothing):
    seen = Identifiability(
        visible={"backlash": 0.1, "cogging": 0.2, "armature": 9.0}, pairs=(), ridges=()
    )
    v = verdict(PART, nothing, can_tell=seen, options=("--twin=a.yaml",))
    assert (v.kind, v.level) == ("nothing_missing", "high")
    assert (
        "backlash" in v.record_next
        and "cogging" in v.record_next
        and "armature" not in v.record_next
    )
    assert (
        v.command == f"taccorl excite {PART} --effects=backlash,cogging --twin=a.yaml"
    )
    assert verdict(PART, nothing).command == ""


def test_what_stands_out_in_one_regime_is_not_nothing_although_the_whole_is_at_the_floor():
    """6 floors about 0.6 s of 10 s: √(1 + 36 · 0.1 √(π / 2) / 10) = 1.2 floors in all."""

    def seen(kind: type[Added], size: float, seed: int) -> Diagnosis:
        early = np.abs(np.arange(2000) / 200 - 0.6) < 0.1
        regimes = {"all rows": (early | True, 1.0), "early": (early, 1.0)}
        of = (record(3 * seed + k, Bump(strength=size)) for k in range(3))
        recordings = [dataclasses.replace(r, regimes=regimes) for r in of]
        return diagnose(
            MadeProblem(kind), recordings[:1], recordings[1:2], recordings[2:]
        )

    d = seen(Ripple, 0.6, 0)
    v = verdict(PART, d)
    assert (
        max(d.errors["after"].values()) < SearchConfig().floor
        and v.kind == "something_else"
    )
    assert (
        "early, " in v.finding
        and f"{d.standing_out[0].error:.2f} noise floors" in v.finding
    )
    assert 4.0 < d.standing_out[0].error < 6.5 and "ripple" not in v.finding
    assert seen(Bump, 0.6, 0).names == ("bump",), "tried because of the regime"
    assert {seen(Ripple, 0.0, seed).status for seed in range(20)} == {"nothing_missing"}


def test_a_wrong_number_of_the_file_is_said_with_both_values_and_an_effect_in_its_place(
    nothing, one
):
    """0.0035 of 0.052 N·m is 7 % of what the file has."""
    off = Changed(
        name="coulomb_friction.torque_nm",
        before=0.052,
        after=0.252,
        unit="N·m",
        without=12.3,
        alone=False,
    )
    ends = {off.name: (0.246, 0.258)}
    found = changed(
        nothing,
        status="numbers_off",
        changed=(off,),
        intervals=nothing.intervals | ends,
    )
    v = verdict(PART, found)
    assert (v.kind, v.level) == ("numbers_off", "high")
    assert (
        "0.052 → 0.252 N·m (0.246 … 0.258)" in v.finding
        and "12.30" in v.finding
        and "nothing" not in v.finding
    )
    doubted = verdict(PART, changed(found, undetermined=(off.name,)))
    assert (
        "not determined: with other numbers any of 0.246 … 0.258 fits"
        in doubted.finding
    )
    assert doubted.level == "moderate"
    for stage in ("before", "after"):
        assert f"{nothing.errors[stage]['validation']:.2f}" in v.finding
    assert (
        not v.record_next.startswith("Nothing") and "coulomb_friction" in v.record_next
    )
    weight = dataclasses.replace(
        off, name="torque_ff", instead=("gravity_mismatch", "payload")
    )
    v = verdict(PART, changed(nothing, status="numbers_off", changed=(weight,)))
    assert (
        "torque_ff of the file is off, or gravity_mismatch or payload is missing instead"
        in v.finding
    )
    assert (
        v.command == f"taccorl excite {PART} --effects=gravity_mismatch,payload"
        and "may be a weight" in v.finding
    )
    assert (
        "friction"
        in verdict(
            PART, changed(nothing, status="numbers_off", changed=(off,), present=())
        ).command
    )
    held = changed(
        nothing, status="numbers_off", changed=(off,), present=("coulomb_friction",)
    )
    assert verdict(PART, held).command == ""
    beside = verdict(
        PART,
        changed(
            one,
            changed=(off,),
            intervals=one.intervals | ends,
            undetermined=(off.name,),
        ),
    )
    assert (
        beside.level == "low"
        and "may stand in for an effect that is not known" in beside.confidence
    )
    for after, instead in ((0.0035, True), (0.035, False)):
        less = dataclasses.replace(off, after=after)
        finding = verdict(PART, changed(one, changed=(less,))).finding
        assert f"0.052 → {after:.4g} N·m" in finding
        assert ("ripple in place of the file's coulomb_friction" in finding) == instead


def test_a_delay_is_said_to_look_like_columns_that_are_logged_late(one):
    v = verdict(
        PART, changed(one, effects=(make_effect("command_delay", delay_s=0.012),))
    )
    assert (
        "or its positions and efforts are logged late by as much" in v.finding
        and v.level == "moderate"
    )


def test_a_gain_of_a_few_tenths_of_a_floor_is_a_doubt(one):
    errors = {**one.errors, "fitted": {"fit": 1.4, "validation": 1.4, "test": 1.4}}
    v = verdict(PART, changed(one, errors=errors))
    assert (
        v.level == "moderate"
        and f"{1.4 - one.errors['after']['validation']:.2f} noise floors"
        in v.confidence
    )


def test_effects_that_do_as_well_are_named_with_the_recording_that_decides():
    hidden = Square(strength=1.0)
    recordings = [record(k, hidden) for k in range(3)]
    d = diagnose(
        MadeProblem(Square, Squire), recordings[:1], recordings[1:2], recordings[2:]
    )
    v = verdict(PART, d)
    assert (v.kind, v.level) == ("ties", "moderate")
    assert "square" in v.finding and "squire" in v.finding
    assert v.command == f"taccorl excite {PART} --effects=square,squire"


@pytest.mark.parametrize(("low", "same"), [(0.0, True), (0.2, False)])
def test_no_motion_is_planned_for_an_effect_and_the_same_with_a_number_at_its_end(
    one, low, same
):
    """Friction over speed to the power 0 is dry friction."""
    tied = {"coulomb_friction": ("power_law_friction",)}
    ends = one.intervals | {"power_law_friction.exponent": (low, 0.3)}
    v = verdict(
        PART,
        changed(
            one,
            effects=(make_effect("coulomb_friction", torque_nm=0.4),),
            rivals=tied,
            intervals=ends,
        ),
    )
    assert (v.command == "") == same == ("exponent" in v.record_next) and (
        "power_law_friction" in v.command
    ) != same


def test_what_no_effect_explains_is_low_and_leads_to_a_recording_of_the_nearest():
    recordings = [record(k, Bump(strength=3.0), Ripple(strength=1.0)) for k in range(3)]
    d = diagnose(
        MadeProblem(Square, Squire), recordings[:1], recordings[1:2], recordings[2:]
    )
    assert d.status == "something_else"
    v = verdict(PART, d)
    assert (v.kind, v.level) == (
        "something_else",
        "low",
    ) and f"{d.errors['after']['validation']:.2f}" in v.finding
    assert max(e.gain for e in d.rounds[-1].evidence) < 0.05, (
        "neither takes away anything"
    )
    worst = RegimeError(
        recording="fast.csv", use="validation", regime="high speed", error=12.3, n=100
    )
    where = verdict(PART, d, worst=worst)
    assert (
        all(word in where.record_next for word in ("high speed", "fast.csv", "12.30"))
        and where.command == ""
    )
    last = d.rounds[-1]
    near = tuple(
        dataclasses.replace(e, gain=gain)
        for e, gain in zip(last.evidence, (0.08, 0.06), strict=True)
    )
    d = changed(d, rounds=(*d.rounds[:-1], dataclasses.replace(last, evidence=near)))
    v = verdict(PART, d, worst=worst)
    assert (
        v.command == f"taccorl excite {PART} --effects={','.join(e.name for e in near)}"
    )
    again = verdict(PART, d, repeated=True)  # a motion was repeated already
    assert (
        "repeat_of" in v.record_next
        and "repeat_of" not in again.record_next
        and again.command == v.command
    )


def test_one_effect_where_more_is_missing_is_not_called_the_answer():
    recordings = [record(k, Bump(strength=5.0), Ripple(strength=1.0)) for k in range(2)]
    one = SearchConfig(max_effects=1)
    d = diagnose(MadeProblem(Bump, Ripple), recordings[:1], recordings[1:], config=one)
    assert d.status == "too_many"
    v = verdict(PART, d)
    assert (v.kind, v.level) == ("more", "low")
    assert d.names[0] in v.finding and "--until=noise_floor" in v.record_next
    own = tuple(name for name in d.intervals if name.startswith(f"{d.names[0]}."))
    unknown = verdict(PART, changed(d, undetermined=own))
    assert (
        own
        and unknown.kind == "something_else"
        and f"determine {d.names[0]}" in unknown.confidence
    )
    assert (
        f"lacks {d.names[0]}" in v.finding
        and f"lacks {d.names[0]}" not in unknown.finding
    )
    errors = d.errors | {
        "after": d.errors["after"]
        | {"validation": 0.8 * d.errors["fitted"]["validation"]}
    }
    little = verdict(PART, changed(d, errors=errors))  # 36 % of the squared error go
    assert little.kind == "something_else"
    assert (
        "no known effect alone explains" in little.finding
        and f"{d.names[0]}, the nearest" in little.finding
    )
    recordings = [
        record(k, Square(strength=5.0), Ripple(strength=1.0)) for k in range(2)
    ]
    d = diagnose(
        MadeProblem(Square, Squire, Ripple), recordings[:1], recordings[1:], config=one
    )
    assert d.status == "too_many" and d.rounds[0].ties == ("squire",)
    v = verdict(PART, d)
    assert "square or squire" in v.finding and v.level == "low"


def test_gains_that_moved_and_fits_that_did_not_converge_name_no_effect(nothing):
    base, start = {"kp": 41.0, "kd": 10.0}, {"kp": 151.0, "kd": 12.0}
    v = verdict(PART, changed(nothing, status="gains_moved", base=base, start=start))
    assert (v.kind, v.level, v.command) == ("gains_moved", "low", "")
    assert "151" in v.finding and "41" in v.finding and "0.27" in v.finding
    v = verdict(
        PART,
        changed(
            nothing,
            status="not_converged",
            trouble="not converged: still improving after 9 steps",
        ),
    )
    assert (v.kind, v.level) == ("not_converged", "low")
    assert "still improving after 9 steps" in v.confidence


def test_remarks_of_the_search_are_repeated_and_lower_the_confidence(one):
    remark = "kp had to move from 151 to 41 N·m/rad (× 0.27)."
    v = verdict(PART, changed(one, remarks=(remark,)))
    assert (v.level, v.remarks) == ("moderate", (remark,))


def test_an_effect_that_test_recordings_do_not_show_is_said_with_both_errors():
    """The effects bump and ripple act in the fit and the validation recording; in the test recording only ripple acts."""
    hidden, ripple = Bump(strength=3.0), Ripple(strength=1.0)
    recordings = [
        record(0, hidden, ripple),
        record(1, hidden, ripple),
        record(2, ripple),
    ]
    d = diagnose(
        MadeProblem(Bump, Ripple), recordings[:1], recordings[1:2], recordings[2:]
    )
    assert {*d.names} == {"bump", "ripple"}
    after = d.errors["after"]["test"]
    assert d.test_without["bump"] < 1.3 and d.test_without["ripple"] > 2.0, "floors"
    assert d.untested == ("bump",)
    v = verdict(PART, d)
    assert f"{d.errors['fitted']['test']:.2f} → {after:.2f}" in v.finding
    assert (
        f"bump ({d.test_without['bump']:.2f} without it, {after:.2f} with it)"
        in v.confidence
    )
    assert v.level == "moderate"
    little = {stage: {**of, "validation": 1.2} for stage, of in d.errors.items()}
    assert verdict(PART, changed(d, errors=little)).level == "low", (
        "as little as noise may leave, and no test shows a gain"
    )
    evidence = {e.name: e.evidence for e in d.effects}
    assert (
        f"{d.test_without['bump']:.2f} → {after:.2f} floors: no gain"
        in evidence["bump"]
    )
    assert "no gain" not in evidence["ripple"]


@pytest.mark.parametrize(
    ("before", "after", "nothing"),
    [
        (14.1, 14.1, True),
        (14.1, 13.0, False),
        (14.1, 13.6, True),
        (1.02, 1.0, True),
        (1.3, 1.0, False),
    ],
)
def test_a_gain_of_less_than_a_tenth_of_what_lies_above_the_floor_is_none(
    before, after, nothing
):
    """14.1² − 1 = 197.8: a tenth is 19.8; 14.1² − 13² = 29.8, 14.1² − 13.6² = 13.9. 1.3² − 1 = 0.69 of at least one floor²."""
    assert (
        gains_nothing(before, after) == nothing
        and ("no gain" in of_test(before, after)) == nothing
    )


def test_data_comes_before_any_effect(one):
    v = verdict(PART, one, data=["a.csv: positions are 5 ms late", "b.csv: the same"])
    assert (v.kind, v.level, v.command) == ("data_first", "low", "")
    assert (
        "5 ms late" in v.finding and "1 more" in v.finding and "ripple" not in v.finding
    )


def test_nothing_is_missing_is_not_sure_where_the_noise_floor_is_not_known(
    one, nothing
):
    for d, level in ((one, "moderate"), (nothing, "low")):
        v = verdict(PART, d, floor="2 mrad; not known")
        assert (
            v.level == level
            and "2 mrad; not known" in v.confidence
            and "a third time" in v.record_next
        )


@pytest.mark.parametrize(
    "reason", ["test", "no test", "bound", "doubt", "disagree", "repeats"]
)
def test_every_reason_to_doubt_lowers_the_confidence_and_is_said(one, reason):
    after = one.errors["after"]
    errors = {
        "test": after | {"test": 2.34},
        "no test": {k: v for k, v in after.items() if k != "test"},
        "disagree": after | {"fit": 1.47, "validation": 0.92},
        "repeats": after | {"fit": 0.31, "validation": 0.31},
    }
    d = changed(one, errors=one.errors | {"after": errors.get(reason, after)})
    d = changed(d, at_bound=("ripple.strength",)) if reason == "bound" else d
    v = verdict(
        PART, d, doubts=["velocity: not validated"] if reason == "doubt" else []
    )
    said = {
        "repeats": "at 0.31",
        "test": "2.34",
        "no test": "no test rec",
        "bound": "strength",
        "doubt": "velocity",
        "disagree": "1.47",
    }
    assert v.level == "moderate" and said[reason] in " ".join(
        (v.confidence, *v.remarks)
    )
    assert reason != "doubt" or "1 remark below" in v.confidence


def found(d: Diagnosis) -> PartFinding:
    nothing_said = {
        "noise": "",
        "numbers": "",
        "measured": "positions",
        "recordings": {},
        "rows_split": False,
    }
    return PartFinding(
        part=PART,
        diagnosis=d,
        can_tell=Identifiability(visible={}, pairs=(), ridges=()),
        **nothing_said,
    )


def test_the_terminal_has_verdict_numbers_and_command_first_and_few_lines(one):
    """Six remarks; no interval of a number that was not fitted."""
    for interval, words in (
        ({"strength": (0.9, 1.1)}, "(0.9 … 1.1)"),
        ({}, "(not fitted)"),
    ):
        effect = dataclasses.replace(one.effects[0], interval=interval)
        d = changed(one, effects=(effect,), remarks=tuple("abcdef"))
        (section,) = brief(found(d), verdict(PART, d), ["--twin=a.yaml"]).parts
        lines = [cell(value).text for value in section.text]
        assert [
            f"{d.errors[stage]['validation']:.2f}" in lines[0]
            for stage in ("fitted", "after")
        ] == [True, True]
        assert words in lines[1] and lines[2].endswith(
            f"taccorl add-effect {effect.name} --twin=a.yaml"
        )
        assert any(line.startswith("Record next: ") for line in lines), "as on the page"
        assert (
            len(lines) <= 15
            and "3 more" in "".join(lines)
            and "nan" not in "".join(lines)
        )


@pytest.mark.parametrize(("led", "doubts"), [(1, 0), (2, 1)])
def test_a_lead_that_a_clock_explains_as_well_is_a_doubt_where_most_recordings_leave_it_open(
    one, led, doubts
):
    names, position = ("a.csv", "b.csv", "c.csv"), 0.3 * np.sin(np.arange(400) / 30)
    open_ = {
        n: (Finding("clock_or_effect", "warning", PART, "leads"),) for n in names[:led]
    }
    replays = comparison(
        *(trace(0 * position, position, recording=n) for n in names), clock=open_
    )
    effect = make_effect("velocity_feedforward", joints=["joint5"], share=0.5)
    d = changed(one, effects=(effect,))
    v = Report(title="made", comparison=replays, found=[found(d)]).verdicts()[PART]
    own = [
        r for r in v.remarks if "clock" in r and effect.name in r and f"{led} of 3" in r
    ]
    assert len(own) == doubts


@pytest.mark.parametrize(
    ("kind", "has_command"), [("position", True), ("effort", False)]
)
def test_no_motion_is_planned_for_a_part_whose_position_is_its_input(
    one, kind, has_command
):
    replays = comparison(
        trace(np.zeros(400), 0.3 * np.sin(np.arange(400) / 30), kind=kind)
    )
    twins = {"coulomb_friction": {"load_friction": ""}}
    d = changed(
        one,
        effects=(make_effect("coulomb_friction", torque_nm=0.25),),
        base={"torque_ff": 0.01},
        twins=twins,
    )
    assert (
        bool(
            Report(title="made", comparison=replays, found=[found(d)])
            .verdicts()[PART]
            .command
        )
        == has_command
    )


def test_effects_that_no_motion_separates_are_said_so_without_a_command_that_refuses(
    one,
):
    friction = make_effect("coulomb_friction", torque_nm=0.25)
    twins = {
        "coulomb_friction": dict.fromkeys(("asymmetric_friction", "load_friction"), "")
    }
    d = changed(one, effects=(friction,), base={"torque_ff": 0.01}, twins=twins)
    tied = changed(d, rivals={"coulomb_friction": ("asymmetric_friction",)})
    v = verdict(PART, tied)
    assert (v.kind, v.command) == ("ties", "")
    assert (
        "coulomb_friction from asymmetric_friction" in v.record_next
        and "effort" in v.record_next
    )
    more = verdict(
        PART,
        changed(
            d, rivals={"coulomb_friction": ("asymmetric_friction", "stribeck_friction")}
        ),
    )
    assert (
        more.command
        == f"taccorl excite {PART} --effects=coulomb_friction,stribeck_friction"
    )
    assert "coulomb_friction from asymmetric_friction" in more.record_next
    assert verdict(PART, d).command.endswith(
        "--effects=coulomb_friction,load_friction"
    ), "the check of one effect"
    held = verdict(PART, changed(tied, base={}))  # torque_ff is known
    assert held.command.endswith("--effects=coulomb_friction,asymmetric_friction")


def test_what_to_record_is_a_command_for_joints_pads_and_cells_only():
    for part, names, command in (
        (
            "left_joint5",
            ("backlash", "cogging"),
            "taccorl excite left_joint5 --effects=backlash,cogging",
        ),
        (
            "ax x",
            ("backlash", "cogging"),
            "taccorl excite 'ax x' --effects=backlash,cogging",
        ),
        (
            "left pads",
            ("touch_lag", "touch_delay"),
            "taccorl excite --pads=left --effects=touch_lag,touch_delay",
        ),
        (
            "fingertip",
            ("touch_lag", "touch_delay"),
            "taccorl excite --effects=touch_lag,touch_delay",
        ),
        ("camera", ("camera_pose", "camera_latency"), ""),
    ):
        assert excite_command(part, names) == command
    quoted = _to_add(
        "ax", ["backlash"], ["'--measurements=data set'", "'--twin=my robot.yaml'"]
    )
    assert quoted == "taccorl add-effect backlash '--twin=my robot.yaml'"
    assert unit_words("1") == "" and unit_words("s/m") == " s/m"


def test_an_effect_that_acts_in_one_half_second_of_twenty_is_not_called_strong():
    """One of 20 equal blocks improves: mean 1/20, standard error √(1 − 1/20) / 20 · √(20/19), so that z = 1."""
    found = diagnose(
        MadeProblem(Bump, Ripple),
        [record(0, Bump(strength=3.0))],
        [record(1, Bump(strength=3.0))],
    )
    row = next(e for e in found.rounds[0].evidence if e.name == "bump")
    assert found.names == ("bump",) and 0.8 < row.score < 1.6
    assert evidence_words(row) == "few places" and f"{row.score:.1f}" in row.verdict


def test_what_only_fitted_or_only_validation_recordings_show_is_said():
    """A ripple of 0.3 in one recording alone, noise 0.1: √(1 + (0.3 / √2 / 0.1)²) = 2.35 floors there, else 1."""
    found = diagnose(MadeProblem(), [record(0, Ripple(strength=0.3))], [record(1)])
    assert found.status == "something_else"  # nothing that the search knows explains it
    words, covered = unjudged(found), unjudged(found, {"fit": (), "validation": ()})
    assert (
        words.startswith("the recordings that were fitted keep 2.3")
        and "of each kind" in words
    )
    assert (
        covered.startswith("the recordings that were fitted keep 2.3")
        and "mark" not in covered
    )
    slower = unjudged(found, {"fit": (), "validation": ("velocity",)})
    assert "velocity" in slower and "for validation" in slower
    for strengths, words in (
        ((0.0, 0.3), "the recordings that validate keep 2.3"),
        ((0.3, 0.3), ""),
        ((0.0, 0.0), ""),
    ):
        both = [record(k, Ripple(strength=s)) for k, s in enumerate(strengths)]
        assert (
            unjudged(diagnose(MadeProblem(), both[:1], both[1:]))[: len(words) or None]
            == words
        )


def test_effects_that_leave_an_error_may_stand_in_for_another():
    found = diagnose(
        MadeProblem(Ripple), *([record(k, Ripple(strength=1.0))] for k in range(3))
    )
    assert found.status == "at_floor" and may_stand_in(found) == ""
    short = dataclasses.replace(
        found,
        status="something_else",
        errors=found.errors | {"after": {"validation": 5.69}},
    )
    assert "5.69 noise floors" in may_stand_in(short) and found.names[
        0
    ] in may_stand_in(short)
    assert may_stand_in(dataclasses.replace(short, effects=())) == ""


@pytest.mark.parametrize(
    ("gain", "rivals", "doubted"),
    [(0.88, (), True), (0.5, (), False), (0.88, ("coulomb_friction",), False)],
)
def test_an_effect_whose_simpler_near_twin_does_nearly_all_may_be_two_effects(
    gain, rivals, doubted
):
    """A slide with dry friction and a spring whose rest is far off is at the floor with friction that differs by direction."""
    ripple = [[record(k, Ripple(strength=1.0))] for k in range(3)]
    d = diagnose(MadeProblem(Ripple), *ripple)
    assert verdict("slide", d).level == "high"
    name = "asymmetric_friction"
    (own,) = d.rounds[0].evidence
    values = {f"{name}.torque_nm": 12.0, f"{name}.asymmetry": 0.4}
    friction = {"coulomb_friction.torque_nm": 11.0}
    rows = (
        dataclasses.replace(own, name=name, values=values, gain=1.0),
        dataclasses.replace(
            own,
            name="coulomb_friction",
            values=friction,
            gain=gain,
            verdict=f"explains less than {name}",
        ),
    )
    d = dataclasses.replace(
        d,
        effects=(make_effect(name, torque_nm=12.0, asymmetry=0.4),),
        rounds=(dataclasses.replace(d.rounds[0], evidence=rows, added=name),),
        rivals={name: rivals} if rivals else {},
    )
    words = may_be_two(d)
    assert bool(words) == doubted
    if doubted:
        assert (
            "coulomb_friction" in words
            and "88%" in words
            and f"--without=[{name}] --until=noise_floor" in words
        )
        assert verdict("slide", d).level == "moderate"
