"""What a diagnosis says in words, of diagnoses of problems whose answers can be written down."""

import dataclasses

import pytest
from made_problem import Bump, MadeProblem, Ripple, record

from taccorl.diagnosis.search.search import diagnose
from taccorl.report.evidence_words import evidence_words, may_be_two, may_stand_in, unjudged
from taccorl.report.verdict import verdict
from taccorl.sim.effects import make_effect


def test_an_effect_that_acts_in_one_half_second_of_twenty_is_not_called_strong():
    """One of 20 equal blocks improves: mean 1/20, standard error √(1 − 1/20) / 20 · √(20/19), so that z = 1."""
    found = diagnose(MadeProblem(Bump, Ripple), [record(0, Bump(strength=3.0))], [record(1, Bump(strength=3.0))])
    row = next(e for e in found.rounds[0].evidence if e.name == "bump")
    assert found.names == ("bump",) and 0.8 < row.score < 1.6
    assert evidence_words(row) == "few places" and f"{row.score:.1f}" in row.verdict


def test_what_only_fitted_or_only_validation_recordings_show_is_said():
    """A ripple of 0.3 in one recording alone, noise 0.1: √(1 + (0.3 / √2 / 0.1)²) = 2.35 floors there, else 1."""
    found = diagnose(MadeProblem(), [record(0, Ripple(strength=0.3))], [record(1)])
    assert found.status == "something_else"  # nothing that the search knows explains it
    words, covered = unjudged(found), unjudged(found, {"fit": (), "validation": ()})
    assert words.startswith("the recordings that were fitted keep 2.3") and "of each kind" in words
    assert covered.startswith("the recordings that were fitted keep 2.3") and "mark" not in covered
    slower = unjudged(found, {"fit": (), "validation": ("velocity",)})
    assert "velocity" in slower and "for validation" in slower
    for strengths, words in (((0.0, 0.3), "the recordings that validate keep 2.3"), ((0.3, 0.3), ""), ((0.0, 0.0), "")):
        both = [record(k, Ripple(strength=s)) for k, s in enumerate(strengths)]
        assert unjudged(diagnose(MadeProblem(), both[:1], both[1:]))[: len(words) or None] == words


def test_effects_that_leave_an_error_may_stand_in_for_another():
    found = diagnose(MadeProblem(Ripple), *([record(k, Ripple(strength=1.0))] for k in range(3)))
    assert found.status == "at_floor" and may_stand_in(found) == ""
    short = dataclasses.replace(found, status="something_else", errors=found.errors | {"after": {"validation": 5.69}})
    assert "5.69 noise floors" in may_stand_in(short) and found.names[0] in may_stand_in(short)
    assert may_stand_in(dataclasses.replace(short, effects=())) == ""


@pytest.mark.parametrize(
    ("gain", "rivals", "doubted"), [(0.88, (), True), (0.5, (), False), (0.88, ("coulomb_friction",), False)]
)
def test_an_effect_whose_simpler_near_twin_does_nearly_all_may_be_two_effects(gain, rivals, doubted):
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
            own, name="coulomb_friction", values=friction, gain=gain, verdict=f"explains less than {name}"
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
        assert "coulomb_friction" in words and "88%" in words and f"--without=[{name}] --until=noise_floor" in words
        assert verdict("slide", d).level == "moderate"
