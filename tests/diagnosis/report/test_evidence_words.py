"""What a diagnosis says in words, of diagnoses of problems whose answers can be written down."""

from made_problem import MadeProblem, Ripple, record

from taccorl.diagnosis.report.evidence_words import unjudged
from taccorl.diagnosis.search.search import diagnose


def test_what_only_the_fitted_recordings_show_is_said():
    """A ripple of 0.3 in the fitted recording alone, noise 0.1: √(1 + (0.3 / √2 / 0.1)²) = 2.35 floors there, else 1."""
    found = diagnose(MadeProblem(), [record(0, Ripple(strength=0.3))], [record(1)])
    assert found.status == "something_else"  # nothing that the search knows explains it
    words = unjudged(found)
    assert words.startswith("the recordings that were fitted keep 2.3"), words


def test_what_only_the_validation_recordings_show_is_said_too():
    found = diagnose(MadeProblem(), [record(0)], [record(1, Ripple(strength=0.3))])
    words = unjudged(found)
    assert words.startswith("the recordings that validate keep 2.3"), words


def test_equal_recordings_have_nothing_to_say():
    assert unjudged(diagnose(MadeProblem(), [record(0)], [record(1)])) == ""
    both = [record(k, Ripple(strength=0.3)) for k in (0, 1)]
    assert unjudged(diagnose(MadeProblem(), both[:1], both[1:])) == ""  # seen by those that judge, too
