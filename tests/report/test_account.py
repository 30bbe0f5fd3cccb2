"""Facts of a diagnosis, by their ids and values; and the table of their texts."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
from made_problem import Added, Bump, MadeProblem, Ripple, Square, Squire, record
from made_traces import FLOOR_RAD, comparison, floor, trace

from taccorl.data.finding import Finding
from taccorl.diagnosis.comparison.regimes import RegimeError
from taccorl.diagnosis.machines.machine import as_written
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Identified, Known
from taccorl.diagnosis.search.problem import EFFORT_SCALE
from taccorl.diagnosis.search.result import (
    Changed,
    Diagnosis,
    Offer,
    SearchConfig,
    gains_nothing,
    of_test,
)
from taccorl.diagnosis.search.search import diagnose
from taccorl.diagnosis.search.solve import PartFinding
from taccorl.report.account import account, is_explained, moved, share_gone, with_moved
from taccorl.report.diagnosed import account_section
from taccorl.report.evidence import Seen, added, grade, simpler_twin
from taccorl.report.fact import (
    MOST_NAMES,
    Account,
    Fact,
    Quantity,
    Severity,
    fact,
    texts,
    unit_words,
)
from taccorl.report.next_recording import excite_command
from taccorl.report.report import Report
from taccorl.report.terminal import show
from taccorl.sim.effects import make_effect

PART = "left_joint5"


def changed(d: Diagnosis, **fields: Any) -> Diagnosis:
    return dataclasses.replace(d, **fields)


def searched(*kinds: type[Added], of: Any, parts: int = 3, **how: Any) -> Diagnosis:
    """A search for ``kinds`` in one fit, one validation and one test recording."""
    recordings = [record(k, *of) for k in range(parts)]
    split = (recordings[:1], recordings[1:2], recordings[2:])
    return as_stated(diagnose(MadeProblem(*kinds), *split, **how))


def as_stated(d: Diagnosis) -> Diagnosis:
    """The result of a machine whose file has the refitted numbers."""
    return changed(d, start=d.base, errors=d.errors | {"before": d.errors["fitted"]})


@pytest.fixture(scope="module")
def one() -> Diagnosis:
    """A ripple, and nothing like it."""
    return searched(Ripple, Bump, of=[Ripple(strength=1.0)])


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return searched(Ripple, of=[])


@pytest.fixture(scope="module")
def short() -> Diagnosis:
    """Most of the error is of an effect that is not known."""
    return searched(Square, Squire, of=[Bump(strength=3.0), Ripple(strength=1.0)])


def named(d: Diagnosis, name: str, **values: float) -> Diagnosis:
    """The result with another effect in place of what was found."""
    return changed(d, effects=(make_effect(name, **values),))


OFF = Changed(
    name="coulomb_friction.torque_nm",
    before=0.052,
    after=0.252,
    unit="N·m",
    without=12.3,
)


def off(d: Diagnosis, *numbers: Changed, **fields: Any) -> Diagnosis:
    """The result with numbers of the file that are off."""
    ends = {n.name: (0.99 * n.after, 1.01 * n.after) for n in numbers}
    intervals = d.intervals | ends
    return changed(d, changed=numbers, intervals=intervals, **fields)


def with_errors(d: Diagnosis, **stages: Any) -> Diagnosis:
    """The result with other errors: stage → value of all uses, or use → value."""
    errors = {stage: dict(of) for stage, of in d.errors.items()}
    for stage, own in stages.items():
        every = dict.fromkeys(errors[stage], own) if isinstance(own, float) else own
        errors[stage] |= every
    return changed(d, errors=errors)


def moved_gains(d: Diagnosis, status: str = "nothing_missing") -> Diagnosis:
    """kp 394 → 241, as by the fit: 180 → 1 floors."""
    kp = dataclasses.replace(d.after.frees[0], name="kp", unit="N·m/rad", high=1e3)
    after = dataclasses.replace(d.after, frees=(kp,), jacobian=d.after.jacobian[:, :1])
    return with_errors(
        changed(
            d,
            status=status,
            base={"kp": 241.0},
            start={"kp": 394.0},
            intervals={"kp": (240.0, 242.0)},
            after=after,
        ),
        before=180.0,
    )


KNOWN = Known(
    identifiable=(
        Identified(
            name="ripple.strength/kp", value=0.002, low=0.0019, high=0.0021, unit="rad"
        ),
    ),
    absolute=(
        Identified(name="kp", value=151.0, low=110.0, high=152.0, unit="N·m/rad"),
    ),
    pinned_by=(),
)
HIDDEN = Identifiability(
    visible={"backlash": 0.1, "cogging": 0.2, "armature": 9.0}, pairs=(), ridges=()
)
WORST = RegimeError(
    recording="fast.csv", use="validation", regime="high speed", error=12.3, n=100
)


# ---- the table of texts: each id has a text, a label, and a case below ----

SAMPLES: dict[str, Any] = {
    "numbers": ["torque_nm 0.03 N·m"],
    "gravity": "[0, 0, -9.81]",
    "after": Quantity(value=60.2, unit="N·m/rad", low=60.0, high=60.4),
    "quantity": Quantity(value=0.002, unit="rad", low=0.0019, high=0.0021),
}


def made(id: str) -> Fact:
    """A fact of this id with any values: numbers where the text asks for digits."""
    text = texts()[id].text
    numbers = {*re.findall(r"{(\w+):", text), "led", "n"}
    values = {f: 2.5 if f in numbers else SAMPLES.get(f, f) for f in texts()[id].fields}
    return fact(id, **values)


@pytest.mark.parametrize("id", list(texts()))
def test_each_text_is_one_line_of_named_fields(id: str):
    entry, own = texts()[id], made(id)
    assert entry.severity in get_args(Severity)
    assert own.text.strip() and not {*"\n{}"} & {*own.text}
    assert own.as_json()["values"] == own.values


def test_each_id_of_the_table_is_made_by_the_package_and_no_other():
    """Ids in the sources of the facts: no text without a fact, no fact without a text."""
    root = Path(__file__).parents[2] / "taccorl"
    sources = [root / "report" / f"{n}.py" for n in ("account", "interim")]
    sources += [root / "report" / "next_recording.py", root / "cli" / "diagnose.py"]
    machines = root / "diagnosis" / "machines"
    sources += [machines / "machine.py", machines / "robot.py"]
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    unused = [id for id in texts() if f'"{id}"' not in text]
    assert unused == []
    made_here = set(re.findall(r'(?:fact|Remark)\(\s*"(\w+)"', text))
    assert made_here <= {*texts()}


def test_the_worst_line_makes_the_confidence():
    title = made("effects")
    for ids, level in (
        ([], "high"),
        (["record_test"], "high"),
        (["tie"], "moderate"),
        (["tie", "remains_much"], "low"),
    ):
        assert Account.of_facts(PART, [*map(made, ids), title]).level == level


def test_the_page_on_confidence_names_each_line_that_lowers_it():
    page = Path(__file__).parents[2] / "docs" / "diagnosis.md"
    rule = page.read_text(encoding="utf-8").split("**Confidence**")[1]
    for column, severity in ((2, "error"), (3, "warning")):
        cells = [row.split("|")[column] for row in rule.splitlines() if row[:2] == "| "]
        named = {id for text in cells for id in re.findall(r"`(\w+)`", text)}
        assert named == {
            id for id, text in texts().items() if text.severity == severity
        }


def test_lines_stand_in_the_order_of_the_table():
    ids = ("next", "effects", "tie", "error", "missing")
    a = Account.of_facts(PART, [made(id) for id in ids])
    assert a.ids == ("effects", "error", "missing", "tie", "next")
    assert (a.kind, a.title) == ("effects", a.facts[0].text)


def test_numbers_are_shown_with_the_digits_that_are_known():
    assert str(Quantity(value=0.0285, unit="N·m", low=0.0278, high=0.0292)) == (
        "0.0285 N·m (0.0278 … 0.0292)"
    )
    assert str(Quantity(value=3.0)) == "3"
    error = fact("error_untested", before=100.0, after=2.412, share=0.9994).text
    assert "100 → 2.41" in error and "99.9 %" in error
    many = [f"effect_{k}" for k in range(MOST_NAMES + 2)]
    assert "and 2 more" in fact("stands_in", effects=many).text
    assert (unit_words("1"), unit_words("s/m")) == ("", " s/m")


# ---- facts of results ----

CASES: dict[str, Any] = {}
"""Id of a fact → (result of the fixtures, what is known of the recordings)."""


def case(*ids: str):
    """A function that makes a result in whose account these ids are."""

    def keep(make: Any) -> Any:
        CASES.update(dict.fromkeys(ids, make))
        return make

    return keep


@case("effects", "error", "refit", "missing", "floor", "over_kp", "record_torques")
@case("fitted", "judged")
def _(one, nothing, short):
    d = with_errors(one, before=20.0)
    return d, Seen(known=KNOWN, floor="0.3 mrad", numbers="gains", judged_by=["a.csv"])


@case("error_untested")
def _(one, nothing, short):
    after = {use: one.errors["after"][use] for use in ("fit", "validation")}
    return changed(one, errors=one.errors | {"after": after}), Seen()


@case("data_first", "data_error", "record_data")
def _(one, nothing, short):
    return one, Seen(errors=["a.csv: positions are 5 ms late"])


@case("not_converged", "trouble")
def _(one, nothing, short):
    return changed(nothing, status="not_converged", trouble="still moving"), Seen()


def with_rival(one, ratio: float) -> Diagnosis:
    """Coulomb friction, 1.2 floors, and asymmetric friction, ``ratio`` times as many."""
    d = named(one, "coulomb_friction", torque_nm=0.25)
    offer = Offer(
        added=("asymmetric_friction",),
        effects=(),
        base={},
        intervals={},
        errors={"fit": 1.2, "validation": 1.2 * ratio},
        at_bound=(),
        undetermined=(),
    )
    errors = {**d.errors, "after": {**d.errors["after"], "validation": 1.2}}
    rivals = {"coulomb_friction": offer.added}
    return changed(d, rivals=rivals, offers=(offer,), errors=errors)


@case("tie_more")
def _(one, nothing, short):
    return with_rival(one, 1.55**0.5), Seen()


@case("ties", "tie", "record_efforts")
def _(one, nothing, short):
    friction = named(one, "coulomb_friction", torque_nm=0.2)
    tied = {"coulomb_friction": ("asymmetric_friction",)}
    return changed(friction, rivals=tied, base={"torque_ff": 0.01}), Seen()


@case("record_either")
def _(one, nothing, short):
    d, _ = CASES["record_efforts"](one, nothing, short)
    return d, Seen(has_effort=True)


@case("may_be_two")
def _(one, nothing, short):
    return of_two(one, gain=0.88), Seen()


def of_two(d: Diagnosis, gain: float) -> Diagnosis:
    """Friction by direction, of which plain dry friction alone takes ``gain``."""
    name, own = "asymmetric_friction", d.rounds[0].evidence[0]
    two = {f"{name}.torque_nm": 12.0, f"{name}.asymmetry": 0.4}
    friction = {"coulomb_friction.torque_nm": 11.0}
    rows = (
        dataclasses.replace(own, name=name, values=two, gain=1.0),
        dataclasses.replace(own, name="coulomb_friction", values=friction, gain=gain),
    )
    rounds = (dataclasses.replace(d.rounds[0], evidence=rows, added=name),)
    return changed(named(d, name, torque_nm=12.0, asymmetry=0.4), rounds=rounds)


@case("more", "remains_much", "stands_in")
def _(one, nothing, short):
    d = changed(one, status="too_many")
    return with_errors(d, before=10.0, after=5.0), Seen(worst=WORST)


@case("something_else", "tried")
def _(one, nothing, short):
    d = changed(one, status="something_else")
    return with_errors(d, before=10.0, fitted=10.0, after=9.0), Seen()


@case("gains_moved", "record_gains")
def _(one, nothing, short):
    return moved_gains(nothing, "gains_moved"), Seen()


@case("numbers_off", "changed", "record_test")
def _(one, nothing, short):
    return moved_gains(nothing), Seen()


@case("some_numbers_off", "remains", "worst", "record_regime", "record_repeat")
def _(one, nothing, short):
    d = moved_gains(nothing, "something_else")
    return with_errors(d, before=100.0, after=2.41), Seen(worst=WORST)


@case("size")
def _(one, nothing, short):
    size = {"kind": "position", "before": "2 mrad", "after": "1 mrad", "nrmse": 4e-4}
    return with_errors(one, before=10.0, after=2.0), Seen(size=size)


@case("gains")
def _(one, nothing, short):
    d = moved_gains(nothing)
    return changed(d, start={"kp": 241.5}, errors=nothing.errors), Seen()


def test_fitted_gains_stand_in_one_line_with_those_of_the_file(nothing):
    """They are listed once: among the numbers that change, or here."""
    kept = changed(moved_gains(nothing), start={"kp": 241.5}, errors=nothing.errors)
    (line,) = account(PART, kept).get("gains")
    assert line.values["gains"] == ["kp 241 N·m/rad (240 … 242), in the file 241.5"]
    assert "gains" not in account(PART, moved_gains(nothing)).ids


def test_a_period_of_the_loop_is_not_listed_beside_its_rate(nothing):
    """The file has loop_hz, which ``changed`` states."""
    frees = [dataclasses.replace(nothing.after.frees[0], name="loop_s", unit="s")]
    after = dataclasses.replace(nothing.after, frees=frees)
    d = changed(moved_gains(nothing), base={"loop_s": 2e-3}, start={"loop_s": 1e-3})
    assert moved(changed(d, after=after, intervals={"loop_s": (1.9e-3, 2.1e-3)})) == {}


@case("nothing_missing", "record_nothing")
def _(one, nothing, short):
    return nothing, Seen()


@case("record_hidden", "plan")
def _(one, nothing, short):
    return nothing, Seen(can_tell=HIDDEN, options=["--twin=a.yaml"])


@case("reads_as")
def _(one, nothing, short):
    friction = named(one, "power_law_friction", torque_nm=0.2, exponent=0.05)
    return friction, Seen()


@case("replaces", "record_check")
def _(one, nothing, short):
    less = dataclasses.replace(OFF, after=0.0035)
    d = off(named(one, "backlash", play_rad=0.01), less)
    return changed(d, twins={"backlash": {"joint_compliance": ""}}), Seen()


@case("changed_open", "tie_effect", "tie_change", "record_wider")
def _(one, nothing, short):
    tied = dataclasses.replace(OFF, instead=("payload",), ties=("kd 1 → 2",))
    return off(nothing, tied, status="numbers_off", undetermined=(OFF.name,)), Seen()


@case("not_stated")
def _(one, nothing, short):
    rate = dataclasses.replace(OFF, name="loop_hz", before=np.inf, after=500.0)
    d = off(nothing, rate, status="numbers_off")
    return changed(d, intervals=d.intervals | {"loop_s": (1e-3, 3e-3)}), Seen()


@case("in_effect")
def _(one, nothing, short):
    late = dataclasses.replace(OFF, name="speed_delay_s")
    return off(nothing, late, status="numbers_off"), Seen()


@case("in_effect", "early_speed")
def _(one, nothing, short):
    early = dataclasses.replace(OFF, name="speed_delay_s", after=-3e-4)
    return off(nothing, early, status="numbers_off"), Seen()


@case("scale_efforts", "tie_efforts", "record_load")
def _(one, nothing, short):
    scale = dataclasses.replace(OFF, name=EFFORT_SCALE, instead=(EFFORT_SCALE,))
    return off(nothing, scale, status="numbers_off"), Seen()


@case("tie_weight")
def _(one, nothing, short):
    weight = dataclasses.replace(OFF, name="torque_ff")
    return off(nothing, weight, status="numbers_off"), Seen()


@case("best_tried", "record_apart")
def _(one, nothing, short):
    last = short.rounds[-1]
    near = tuple(
        dataclasses.replace(e, gain=gain)
        for e, gain in zip(last.evidence, (0.08, 0.06), strict=True)
    )
    rounds = (*short.rounds[:-1], dataclasses.replace(last, evidence=near))
    return changed(short, rounds=rounds), Seen()


@case("record_kinds")
def _(one, nothing, short):
    return short, Seen()


@case("record_shown")
def _(one, nothing, short):
    d = named(one, "backlash", play_rad=0.01)
    d = changed(d, status="something_else", rounds=())
    return with_errors(d, before=10.0, fitted=10.0, after=9.0), Seen()


@case("tie_place")
def _(one, nothing, short):
    return changed(named(one, "payload", mass_kg=0.5), or_in=("l5",)), Seen()


@case("tie_number", "record_gain")
def _(one, nothing, short):
    return changed(one, or_number=("kd", 1.6)), Seen()


@case("tie_clock", "tie_lead")
def _(one, nothing, short):
    return named(one, "command_delay", delay_s=0.012), Seen(led=(2, 3))


@case("floor_unknown", "record_third")
def _(one, nothing, short):
    return one, Seen(floor_unknown="2 mrad; not known")


@case("floor_unknown_nothing")
def _(one, nothing, short):
    return nothing, Seen(floor_unknown="2 mrad; not known")


@case("floor_wide")
def _(one, nothing, short):
    return with_errors(one, after=0.31), Seen()


@case("test_keeps")
def _(one, nothing, short):
    return with_errors(one, after={"test": 2.34}), Seen()


@case("untested")
def _(one, nothing, short):
    return changed(one, test_without={"ripple": 1.0}), Seen()


@case("untested_little", "little_gain")
def _(one, nothing, short):
    little = with_errors(one, before=1.3, fitted=1.3)
    return changed(little, test_without={"ripple": 1.0}), Seen()


@case("fit_differs", "mark_kinds")
def _(one, nothing, short):
    return with_errors(one, after={"fit": 1.47, "validation": 0.92}), Seen()


@case("mark_range")
def _(one, nothing, short):
    seen = Seen(short={"fit": (), "validation": ("velocity",)})
    return with_errors(one, after={"fit": 1.47, "validation": 0.92}), seen


@case("one_pose", "record_pose")
def _(one, nothing, short):
    d = named(one, "unbalance", torque_nm=0.1)
    return changed(d, one_pose={"unbalance": ("lift",)}), Seen()


@case("at_bound")
def _(one, nothing, short):
    return changed(one, at_bound=("ripple.strength",)), Seen()


@case("undetermined")
def _(one, nothing, short):
    own = tuple(name for name in one.intervals if name.startswith("ripple."))
    return changed(one, undetermined=own), Seen()


@case("remark")
def _(one, nothing, short):
    return changed(one, remarks=("the log ends early",)), Seen()


@case("record_simpler")
def _(one, nothing, short):
    """Friction over speed to the power 0 is dry friction."""
    ends = one.intervals | {"power_law_friction.exponent": (0.0, 0.3)}
    tied = {"coulomb_friction": ("power_law_friction",)}
    d = named(one, "coulomb_friction", torque_nm=0.4)
    return changed(d, rivals=tied, intervals=ends), Seen()


def with_plain(d: Diagnosis, error: float) -> Diagnosis:
    """The result beside a plain fit that leaves ``error`` [floors]."""
    d = with_errors(d, before=20.0, after=1.0)
    object.__setattr__(d, "plain", SimpleNamespace(errors={"validation": error}))
    return d


@case("plain")
def _(one, nothing, short):
    return with_plain(one, 4.0), Seen()


@case("plain_as_good")
def _(one, nothing, short):
    stretchy = named(one, "joint_compliance", compliance_rad_per_nm=0.01)
    return with_plain(stretchy, 1.01), Seen()


@case("error_rose")
def _(one, nothing, short):
    return with_errors(short, before=2.08, after=2.99), Seen()


def test_a_plain_fit_of_what_was_added_speaks_not_against_it(one):
    """Dry friction is one of its numbers: it leaves as little, which is no news."""
    friction = named(one, "coulomb_friction", torque_nm=0.2)
    ids = [f.id for f in account(PART, with_plain(friction, 1.01)).facts]
    assert not {"plain", "plain_as_good"} & {*ids}
    better = [f.id for f in account(PART, with_plain(friction, 0.4)).facts]
    assert "plain_as_good" in better  # with numbers that were not added


def drift_of(number: str, second: str = "warm.csv") -> SimpleNamespace:
    return SimpleNamespace(
        number=number,
        as_good=(),
        unit="N·m·s/rad",
        before=3.0,
        after=1.0,
        before_interval=(2.9, 3.1),
        after_interval=(0.9, 1.1),
        first="cold.csv",
        second=second,
        share=0.99,
    )


DAMPING = "viscous_friction.damping_nms_per_rad"


@case("drift")
def _(one, nothing, short):
    return nothing, Seen(drifts=[drift_of(DAMPING)])


@case("drift_likewise")
def _(one, nothing, short):
    return nothing, Seen(drifts=[drift_of(DAMPING), drift_of(DAMPING, "hot.csv")])


@case("drifting", "record_steady")
def _(one, nothing, short):
    return short, Seen(drifts=[drift_of(DAMPING)])


@pytest.mark.parametrize(
    ("number", "kind"), [(DAMPING, "more"), ("{}.strength", "drifting")]
)
def test_a_number_that_changed_hides_no_other_effect(number, kind, one):
    """Only where the added effect is that of the changed number, the change is all."""
    (name,) = added(one)
    above = changed(one, status="something_else")
    a = account(PART, above, Seen(drifts=[drift_of(number.format(name))]))
    assert a.kind == kind
    assert "drift" in a.ids


ELSEWHERE = {
    "stands_out",  # test_what_stands_out_in_one_regime_…
    "nearest",
    "unfinished",  # tests/cli/test_unfinished_diagnosis.py
    "error_so_far",
    "next",  # tests/cli/test_printed_commands.py
    "next_data",
    "shared",  # tests/diagnosis/machines/test_robot_payload.py
    "shared_without",  # tests/diagnosis/machines/test_tilted_base.py
    "tilt",
}
"""Ids that tests beside this table make."""


def test_each_id_has_a_case():
    assert {*CASES} | ELSEWHERE == {*texts()}
    assert not {*CASES} & ELSEWHERE


@pytest.mark.parametrize("id", list(CASES))
def test_a_result_gives_the_fact_and_each_field_of_its_text(id, one, nothing, short):
    d, seen = CASES[id](one, nothing, short)
    a = account(PART, d, seen)
    assert id in a.ids
    assert all(f.text and texts()[f.id].fields <= {*f.values} for f in a.facts)


KINDS = [
    ("effects", "high"),
    ("nothing_missing", "high"),
    ("numbers_off", "high"),
    ("ties", "moderate"),
    ("gains_moved", "moderate"),
    ("some_numbers_off", "moderate"),
    ("more", "low"),
    ("something_else", "low"),
    ("data_first", "low"),
    ("not_converged", "low"),
]


@pytest.mark.parametrize(("kind", "level"), KINDS)
def test_the_kind_of_a_result_and_its_confidence(kind, level, one, nothing, short):
    d, seen = CASES[kind](one, nothing, short)
    seen = dataclasses.replace(seen, known=None)
    a = account(PART, d, seen)
    assert (a.kind, a.level, a.part) == (kind, level, PART)


def test_gains_alone_are_the_first_facts_and_explain_the_error(nothing):
    """180² → 1² floors by kp 394 → 241: nothing is missing, and kp is off."""
    d = moved_gains(nothing)
    a = account("drive", d)
    (kp,) = a.get("changed")
    assert a.ids[:3] == ("numbers_off", "error", "changed")
    assert (kp.values["name"], kp.values["before"]) == ("kp", 394.0)
    assert kp.values["after"] == moved(d)["kp"]
    assert a.facts[0].values["changes"] == ["kp 394 → 241 N·m/rad"]
    assert with_moved(d).status == "numbers_off", "kp of the file changes"
    assert with_moved(nothing).status == "nothing_missing"
    assert is_explained(d) and share_gone(d) > 0.999
    rest = with_errors(changed(d, status="something_else"), before=100.0, after=2.41)
    assert share_gone(rest) == pytest.approx(1.0 - 0.0241**2) and is_explained(rest)
    little = with_errors(rest, after=80.0)  # 36 % of the squared error
    assert not is_explained(little)
    assert account("drive", little).kind == "something_else"
    same = changed(d, start={"kp": 241.5})
    assert moved(same) == {}, "within its interval"
    assert moved(with_errors(d, before=1.02)) == {}, "the refit removes nothing"


@pytest.mark.parametrize(
    ("angle_deg", "kd", "listed"),
    [
        (90.0, 2.004, ["kp"]),  # 100 · ln(2.004 / 2) = 0.2 floors: 0.04 of a square
        (90.0, 2.02, ["kp", "kd"]),  # 0.995 floors
        (0.2, 1.275, ["kp"]),  # ln(1.275 / 2) = -0.45: kp, 0.49 off, makes up for it
    ],
)
def test_a_number_whose_return_costs_nothing_is_not_off(nothing, angle_deg, kd, listed):
    """The 95 % intervals of kp and kd exclude the values of the file. Changing either by
    the factor e, the other fixed, adds an error of 100 noise floors. ``angle_deg`` is the
    angle between the errors of the two: near 0 one makes up for the other."""
    d, n = moved_gains(nothing), 3600
    angles = np.deg2rad([0.0, angle_deg])
    (kp,) = d.after.frees
    both = dataclasses.replace(
        d.after,
        frees=(kp, dataclasses.replace(kp, name="kd")),
        jacobian=np.outer(np.cos(2 * np.pi * np.arange(n) / n), np.cos(angles))
        + np.outer(np.sin(2 * np.pi * np.arange(n) / n), np.sin(angles)),
        residuals=np.zeros(n),
    )
    both = dataclasses.replace(both, jacobian=100.0 * 2**0.5 * both.jacobian)
    ends = {"kp": (240.0, 242.0), "kd": (0.999 * kd, 1.001 * kd)}
    d = changed(
        d,
        base={"kp": 241.0, "kd": kd},
        start={"kp": 394.0, "kd": 2.0},
        intervals=ends,
        after=both,
    )
    assert [*moved(d)] == listed


def test_an_error_is_that_of_the_twin_as_it_was_and_what_the_refit_left(one):
    d = with_errors(one, before={"validation": 20.0, "test": 18.0})
    (error,), (refit,) = (account(PART, d).get(id) for id in ("error", "refit"))
    after = one.errors["after"]
    assert error.values == {
        "before": 20.0,
        "after": after["validation"],
        "test_before": 18.0,
        "test_after": after["test"],
        "share": pytest.approx(1.0 - (after["validation"] / 20.0) ** 2),
    }
    assert refit.values["error"] == one.errors["fitted"]["validation"]


def test_absolute_torques_are_advised_only_if_nothing_fixes_their_scale(one):
    a = account(PART, one, Seen(known=KNOWN))
    assert a.values("over_kp", "name") == ["ripple.strength/kp"]
    assert (a.get("record_torques")[0].values["low"]) == 110.0
    pinned = dataclasses.replace(KNOWN, pinned_by=("recorded effort",))
    a = account(PART, one, Seen(known=pinned))
    assert not {"over_kp", "record_torques"} & {*a.ids}


def test_a_mass_that_may_be_in_two_bodies_is_said_of_both(one):
    mass = (make_effect("payload", mass_kg=0.5, link="l6"),)
    tied = found(changed(one, effects=mass, present=(), or_in=("l5",)))
    a = account("a4", tied.diagnosis)
    assert a.values("missing", "effect") == ["payload in l6"]
    assert a.values("tie_place", "body") == ["l5"] and a.level == "moderate"


def test_nothing_missing_is_said_with_what_the_recordings_would_not_show(nothing):
    seen = Seen(can_tell=HIDDEN, options=("--twin=a.yaml",))
    a = account(PART, nothing, seen)
    assert a.values("record_hidden", "effects") == [["backlash", "cogging"]]
    planned = f"taccorl excite {PART} --effects=backlash,cogging --twin=a.yaml"
    assert a.command == planned
    assert account(PART, nothing).command == ""


def test_what_stands_out_in_one_regime_is_not_nothing_although_the_whole_is_at_the_floor():
    """6 floors about 0.6 s of 10 s: √(1 + 36 · 0.1 √(π / 2) / 10) = 1.2 floors in all."""

    def seen(kind: type[Added], size: float, seed: int) -> Diagnosis:
        early = np.abs(np.arange(2000) / 200 - 0.6) < 0.1
        regimes = {"all rows": (early | True, 1.0), "early": (early, 1.0)}
        of = (record(3 * seed + k, Bump(strength=size)) for k in range(3))
        recordings = [dataclasses.replace(r, regimes=regimes) for r in of]
        split = (recordings[:1], recordings[1:2], recordings[2:])
        return as_stated(diagnose(MadeProblem(kind), *split))

    d = seen(Ripple, 0.6, 0)
    a = account(PART, d)
    assert max(d.errors["after"].values()) < SearchConfig().floor
    assert (a.kind, a.level) == ("something_else", "low") and not is_explained(d)
    (out,) = a.get("stands_out")
    assert out.values["place"].endswith(", early") and 4.0 < out.values["error"] < 6.5
    assert "nearest" not in a.ids
    least = dataclasses.replace(d, nearest=(("ripple", 1.0),))
    assert account(PART, least).values("nearest", "effect") == ["ripple"]
    assert seen(Bump, 0.6, 0).names == ("bump",), "tried because of the regime"
    assert {seen(Ripple, 0.0, seed).status for seed in range(20)} == {"nothing_missing"}


def test_a_wrong_number_of_the_file_is_said_with_both_values_and_what_ties(nothing):
    a = account(PART, off(nothing, OFF, status="numbers_off"))
    (number,) = a.get("changed")
    after = number.values["after"]
    assert (number.values["before"], after.value, after.unit) == (0.052, 0.252, "N·m")
    assert number.values["without"] == 12.3
    weight = dataclasses.replace(
        OFF, name="torque_ff", instead=("gravity_mismatch", "payload")
    )
    a = account(PART, off(nothing, weight, status="numbers_off"))
    assert a.values("tie_effect", "other") == ["gravity_mismatch", "payload"]
    assert a.command == f"taccorl excite {PART} --effects=gravity_mismatch,payload"
    assert "tie_weight" in a.ids and a.level == "moderate"


@pytest.mark.parametrize(("after", "replaced"), [(0.0035, True), (0.035, False)])
def test_an_effect_of_which_the_refit_leaves_little_is_replaced(one, after, replaced):
    """0.0035 of 0.052 N·m is 7 % of what the file has."""
    d = off(one, dataclasses.replace(OFF, after=after))
    assert ("replaces" in account(PART, d).ids) == replaced


def test_effects_that_do_as_well_are_named_with_the_recording_that_decides():
    d = searched(Square, Squire, of=[Square(strength=1.0)])
    a = account(PART, d)
    assert (a.kind, a.level) == ("ties", "moderate")
    both = {*a.values("tie", "effect"), *a.values("tie", "other")}
    assert both == {"square", "squire"}
    assert a.command == f"taccorl excite {PART} --effects=square,squire"


@pytest.mark.parametrize(("low", "same"), [(0.0, True), (0.2, False)])
def test_no_motion_is_planned_for_an_effect_and_the_same_with_a_number_at_its_end(
    one, low, same
):
    d, _ = CASES["record_simpler"](one, None, None)
    ends = d.intervals | {"power_law_friction.exponent": (low, 0.3)}
    a = account(PART, changed(d, intervals=ends))
    assert ("record_simpler" in a.ids) == same == (a.command == "")
    assert ("power_law_friction" in a.command) != same


def test_what_no_effect_explains_leads_to_a_recording_of_the_nearest(short):
    assert max(e.gain for e in short.rounds[-1].evidence) < 0.05, "neither takes any"
    where = account(PART, short, Seen(worst=WORST))
    assert where.values("record_regime", "place") == ["high speed (fast.csv)"]
    assert where.command == ""
    d, seen = CASES["best_tried"](None, None, short)
    a = account(PART, d, dataclasses.replace(seen, worst=WORST))
    near = [e.name for e in d.rounds[-1].evidence]
    assert a.command == f"taccorl excite {PART} --effects={','.join(near)}"
    again = account(PART, d, Seen(repeated=True))  # a motion was repeated already
    assert "record_repeat" in a.ids and "record_repeat" not in again.ids


def test_one_effect_where_more_is_missing_is_not_called_the_answer():
    config = SearchConfig(max_effects=1)
    hidden = [Bump(strength=5.0), Ripple(strength=1.0)]
    d = searched(Bump, Ripple, of=hidden, parts=2, config=config)
    assert d.status == "too_many"
    a = account(PART, d)
    assert a.kind == "more" and {"missing", "stands_in"} <= {*a.ids}
    assert not [id for id in a.ids if id.startswith("record")], "the search goes on"
    own = tuple(name for name in d.intervals if name.startswith(f"{d.names[0]}."))
    unknown = account(PART, changed(d, undetermined=own))
    assert (unknown.kind, unknown.level) == ("something_else", "low")
    assert unknown.values("undetermined", "effect") == [d.names[0]]
    before = d.errors["before"]["validation"]
    little = account(PART, with_errors(d, after={"validation": 0.8 * before}))
    assert little.kind == "something_else" and "tried" in little.ids
    hidden = [Square(strength=5.0), Ripple(strength=1.0)]
    kinds = (Square, Squire, Ripple)
    d = searched(*kinds, of=hidden, parts=2, config=config)
    assert d.status == "too_many" and d.rounds[0].ties == ("squire",)
    assert account(PART, d).values("tie", "other") == ["squire"]


def test_an_effect_that_test_recordings_do_not_show_is_said_with_both_errors():
    """Bump and ripple act in two recordings; in the test recording only ripple acts."""
    hidden, ripple = Bump(strength=3.0), Ripple(strength=1.0)
    of = [record(0, hidden, ripple), record(1, hidden, ripple), record(2, ripple)]
    d = diagnose(MadeProblem(Bump, Ripple), of[:1], of[1:2], of[2:])
    assert {*d.names} == {"bump", "ripple"}
    after = d.errors["after"]["test"]
    assert d.test_without["bump"] < 1.3 and d.test_without["ripple"] > 2.0, "floors"
    assert d.untested == ("bump",)
    a = account(PART, d)
    (found_,) = a.get("untested")
    assert found_.values == {
        "effect": "bump",
        "without": d.test_without["bump"],
        "with_it": after,
    }
    assert a.level == "moderate"
    evidence = {e.name: e.evidence for e in d.effects}
    assert "no gain" in evidence["bump"] and "no gain" not in evidence["ripple"]


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
    """14.1² − 1 = 197.8: a tenth is 19.8; 14.1² − 13² = 29.8, 14.1² − 13.6² = 13.9.
    1.3² − 1 = 0.69 of at least one floor²."""
    assert gains_nothing(before, after) == nothing
    assert ("no gain" in of_test(before, after)) == nothing


def test_data_comes_before_any_effect(one):
    errors = ["a.csv: positions are 5 ms late", "b.csv: the same"]
    a = account(PART, one, Seen(errors=errors))
    assert (a.kind, a.level, a.command) == ("data_first", "low", "")
    assert a.values("data_error", "text") == errors and "missing" not in a.ids


def found(d: Diagnosis) -> PartFinding:
    return PartFinding(
        part=PART,
        diagnosis=d,
        can_tell=Identifiability(visible={}, pairs=(), ridges=()),
        noise="",
        numbers="",
        measured="positions",
        recordings={},
        rows_split=False,
    )


def test_the_terminal_has_one_line_for_each_fact(one, capsys):
    a = account(PART, one, Seen(options=["--twin=a.yaml"]))
    show(account_section(a))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(a.facts) and "nan" not in "".join(lines)
    assert a.title in lines[0] and f"confidence: {a.level}" in lines[0]
    for line, (label, text) in zip(lines[1:], a.rows, strict=True):
        assert line.startswith(f"  {label} ") and line.endswith(f" {text}")


@pytest.mark.parametrize(("led", "doubts"), [(1, 0), (2, 1)])
def test_a_lead_that_a_clock_explains_as_well_is_a_tie_where_most_recordings_leave_it_open(
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
    a = Report(title="made", comparison=replays, found=[found(d)]).accounts()[PART]
    own = [(f.values["led"], f.values["n"]) for f in a.get("tie_lead")]
    assert own == [(led, 3)] * doubts


@pytest.mark.parametrize(
    ("kind", "has_command"), [("position", True), ("effort", False)]
)
def test_no_motion_is_planned_for_a_part_whose_position_is_its_input(
    one, kind, has_command
):
    replays = comparison(
        trace(np.zeros(400), 0.3 * np.sin(np.arange(400) / 30), kind=kind)
    )
    d = changed(
        named(one, "coulomb_friction", torque_nm=0.25),
        base={"torque_ff": 0.01},
        twins={"coulomb_friction": {"load_friction": ""}},
    )
    report = Report(title="made", comparison=replays, found=[found(d)])
    assert bool(report.accounts()[PART].command) == has_command


@pytest.mark.parametrize(
    ("ratio", "id"), [(1.0, "tie"), (1.03, "tie"), (1.55**0.5, "tie_more")]
)
def test_a_rival_that_leaves_more_is_not_called_equal(one, ratio: float, id: str):
    ties = [f for f in account(PART, with_rival(one, ratio)).facts if "tie" in f.id]
    assert [f.id for f in ties if f.id != "ties"] == [id]
    if id == "tie_more":
        assert ties[-1].values["more"] == pytest.approx(0.55)


def test_effects_that_no_motion_separates_are_said_so_without_a_command_that_refuses(
    one,
):
    forms = dict.fromkeys(("asymmetric_friction", "load_friction"), "")
    d = changed(
        named(one, "coulomb_friction", torque_nm=0.25),
        base={"torque_ff": 0.01},
        twins={"coulomb_friction": forms},
    )
    tied = changed(d, rivals={"coulomb_friction": ("asymmetric_friction",)})
    a = account(PART, tied)
    assert (a.kind, a.command) == ("ties", "")
    assert a.values("record_efforts", "other") == ["asymmetric_friction"]
    two = {"coulomb_friction": ("asymmetric_friction", "stribeck_friction")}
    more = account(PART, changed(d, rivals=two))
    planned = f"taccorl excite {PART} --effects=coulomb_friction"
    assert more.command == f"{planned},stribeck_friction"
    assert more.values("record_efforts", "other") == ["asymmetric_friction"]
    assert account(PART, d).command == f"{planned},load_friction", "as a check"
    held = account(PART, changed(tied, base={}))  # torque_ff is known
    assert held.command == f"{planned},asymmetric_friction"


@pytest.mark.parametrize(
    ("part", "names", "command"),
    [
        ("left_joint5", "backlash,cogging", "taccorl excite left_joint5"),
        ("ax x", "backlash,cogging", "taccorl excite 'ax x'"),
        ("left pads", "touch_lag,touch_delay", "taccorl excite --pads=left"),
        ("fingertip", "touch_lag,touch_delay", "taccorl excite"),
        ("camera", "camera_pose,camera_latency", ""),
    ],
)
def test_what_to_record_is_a_command_for_joints_pads_and_cells_only(
    part, names, command
):
    planned = f"{command} --effects={names}" if command else ""
    assert excite_command(part, names.split(",")) == planned


def test_an_effect_that_acts_in_one_half_second_of_twenty_is_not_called_strong():
    """One of 20 equal blocks improves: mean 1/20, standard error
    √(1 − 1/20) / 20 · √(20/19), so that z = 1."""
    d = searched(Bump, Ripple, of=[Bump(strength=3.0)], parts=2)
    row = next(e for e in d.rounds[0].evidence if e.name == "bump")
    assert d.names == ("bump",) and 0.8 < row.score < 1.6
    assert grade(row) == "few places" and f"{row.score:.1f}" in row.verdict


@pytest.mark.parametrize(
    ("strengths", "differ"),
    [((0.3, 0.0), True), ((0.0, 0.3), True), ((0.3, 0.3), False), ((0, 0), False)],
)
def test_what_only_fitted_or_only_validation_recordings_show_is_said(strengths, differ):
    """A ripple of 0.3 in one recording alone, noise 0.1: √(1 + (0.3 / √2 / 0.1)²) = 2.35
    floors there, else 1."""
    both = [record(k, Ripple(strength=s)) for k, s in enumerate(strengths)]
    d = diagnose(MadeProblem(), both[:1], both[1:])
    own = account(PART, d).get("fit_differs")
    assert bool(own) == differ
    for f in own:
        errors = (f.values["fit"], f.values["validation"])
        assert (errors[0] > errors[1]) == (strengths[0] > strengths[1])
        assert max(errors) == pytest.approx(2.35, abs=0.1)


@pytest.mark.parametrize(
    ("gain", "rivals", "doubted"),
    [(0.88, (), True), (0.5, (), False), (0.88, ("coulomb_friction",), False)],
)
def test_an_effect_whose_simpler_near_twin_does_nearly_all_may_be_two_effects(
    one, gain, rivals, doubted
):
    """A slide with dry friction and a spring whose rest is far off is at the floor with
    friction that differs by direction."""
    name = "asymmetric_friction"
    d = changed(of_two(one, gain), rivals={name: rivals} if rivals else {})
    assert bool(simpler_twin(d)) == doubted
    assert account("slide", d).values("may_be_two", "share") == [gain] * doubted


def test_errors_are_those_of_the_files_that_are_compared_and_written(one):
    """A fit of 2 floors whose file is off by 3; without a comparison its own 8 stay. Where
    no motion was repeated and the file as it was has 5 floors in place of 10, the fit had
    other floors: all stays."""
    position = np.sin(np.arange(400) / 30)
    uses = ("fit", "validation")

    def replay(floors, **of_floor):
        off, noise = np.full(len(position), floors * FLOOR_RAD), floor(**of_floor)
        return comparison(
            *(trace(off, position, use=u, recording=u, floor=noise) for u in uses)
        )

    stated = {"before": 10.0, "fitted": 8.0, "after": 2.0}
    errors = {stage: dict.fromkeys(uses, error) for stage, error in stated.items()}
    f = dataclasses.replace(found(changed(one, errors=errors)), part="left_joint5")
    later = {"fitted": None, "after": replay(3.0)}
    (own,) = as_written([f], replay(10.0), later)
    for stage, error in (("before", 10.0), ("fitted", 8.0), ("after", 3.0)):
        assert own.diagnosis.errors[stage] == pytest.approx(dict.fromkeys(uses, error))
    (own,) = as_written([f], replay(5.0), later)
    assert own.diagnosis.errors["before"]["fit"] == pytest.approx(5.0)
    assert as_written([f], replay(5.0, lower_bound=True), later) == [f]
    split = dataclasses.replace(f, rows_split=True)
    assert as_written([split], replay(10.0), later) == [split]
