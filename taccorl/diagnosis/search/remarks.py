"""Sentences about the result of a search that its errors do not show."""

from collections.abc import Sequence

import numpy as np

from taccorl.diagnosis.search.evidence import gain_of, standard_score
from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.refits import Refits
from taccorl.diagnosis.search.rounds import Rounds

REFIT_WORSE = 1.3
"""Factor on the validation error from which on a refit of the always fitted numbers is a finding: more than the noise of another
motion causes."""
GAINS_MOVED = 2.0
"""Factor between the twin's gains and refitted ones from which on the refit is a finding of its own, caused by late positions, a
wrong unit of time, or gains other than the commanded ones."""


def entangled(refits: Refits, model: Fit, name: str, without: Fit) -> str:
    """Sentence on an effect whose strength is not known, although it removes most of the error."""
    frees, spread = model.frees, model.covariance()
    strengths = {f"{name}.{p.name}" for p in refits.problem.candidates[name].cls.parameters() if p.absent is not None}
    own = next(k for k, f in enumerate(frees) if f.name in strengths)
    size = np.sqrt(np.diag(spread))
    other = max((k for k in range(len(frees)) if k != own), key=lambda k: abs(spread[own, k]) / size[k], default=own)
    low, high = model.intervals()[frees[own].name]
    return (
        f"{frees[own].name} {model.values[frees[own].name]:.3g} is open (95 % {low:.3g} … {high:.3g}), although "
        f"{refits.error(without):.2f} noise floors remain without {name}: {frees[other].name} makes up for a change of it "
        f"(correlation {spread[own, other] / size[own] / size[other]:+.2f})."
    )


def of_refit(refits: Refits, model: Fit) -> list[str]:
    """Sentence where no effect was added and the refit of the always fitted numbers is worse than the twin as it was."""
    before = refits.error(refits.as_it_was)
    if model.names != refits.present or refits.first_error <= REFIT_WORSE * max(before, 1.0):
        return []
    return [
        f"refitted to the fit recordings, the twin's numbers raise the validation error from {before:.2f} to "
        f"{refits.first_error:.2f} noise floors: the twin lacks something that both kinds of recordings show differently, such "
        "as an effect of the speed, the pose or a warm gear."
    ]


def moved_gains(refits: Refits, model: Fit) -> dict[str, tuple[float, float]]:
    """Gain → (the twin's, fitted) of those that are more than ``GAINS_MOVED`` times off."""
    pairs = {g: (refits.given[g], model.values[g]) for g in ("kp", "kd") if g in model.values and refits.given.get(g)}
    return {g: (old, new) for g, (old, new) in pairs.items() if not 1 / GAINS_MOVED <= new / old <= GAINS_MOVED}


def of_pairs(refits: Refits, rounds: Rounds, model: Fit) -> list[str]:
    """Sentence where an effect was refused that may be one of two missing ones, and only one was to be added."""
    if not rounds.refused or refits.config.max_effects > 1 or model.names != refits.present:
        return []
    removed = 1.0 - rounds.refused[0].error ** 2 / model.error**2
    return [
        f"{rounds.refused[0].names[-1]} alone takes away {removed:.0%} of the squared fit error and fails on validation "
        "recordings, as one of two missing effects may: --until=noise_floor tries pairs."
    ]


def of_gains(refits: Refits, model: Fit) -> list[str]:
    """Sentences on gains that had to move far."""
    units = {f.name: f.unit for f in model.frees}
    fits = {
        "with the effects added": moved_gains(refits, model),
        "before any effect was considered": moved_gains(refits, refits.first),
    }
    moved = {gain: (when, *change) for when, found in fits.items() for gain, change in found.items()}
    return [
        f"{gain} had to move from the twin's {old:.4g} to {new:.4g} {units[gain]} (× {new / old:.2g}) {when}. Check the time "
        "stamps (positions reported late, wrong unit of time) and which gains were commanded (kp, kd of the recording in "
        "measurements.yaml)."
        for gain, (when, old, new) in moved.items()
    ]


def better_than_present(refits: Refits, rounds: Rounds, model: Fit, names: Sequence[str]) -> list[str]:
    """Remarks on effects of the twin in whose place others do much better, where the search ended above the floor: such an
    effect may have been added while another was missing. None where the other one does still better beside the twin's: then
    only the other one is missing."""
    remarks, here = [], refits.squares(model)
    for name in refits.present if not refits.at_floor(model) else ():
        found, instead = rounds.exchange(model, name, names)
        there = refits.squares(instead)
        if found is None or gain_of(here - there, here) < refits.config.sure_gain:
            continue
        if not refits.at_floor(instead):
            starts = [model.values | instead.values, instead.values | model.values]
            both = refits.fitted((*model.names, str(found.added)), starts, refits.config.steps)
            better = there - refits.squares(both)
            if not refits.config.too_little(gain_of(better, there), standard_score(better)):
                continue
        remarks.append(
            f"{found.added} in place of {name}, which the twin has, would leave {found.validation_error:.2f} instead of "
            f"{refits.error(model):.2f} noise floors, and beside it no less: if a diagnosis added {name}, remove it from the "
            "twin's file and diagnose again."
        )
    return remarks
