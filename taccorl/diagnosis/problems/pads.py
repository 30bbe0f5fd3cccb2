"""Diagnose the pads of every arm that pressed a known object, each pair separately, and write the results into the twin. A pair
is diagnosed with matched contact replays (``TouchProblem``): measured poses of the fingers, and an object at a known pose. A
twin has one k_n and one k_d for all of its pads; effects act on the pads in which they were found.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.alignment.measurements.folder import Measurements, repeat_pairs
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.touch.motion import TouchMotion, lacking_pads
from taccorl.diagnosis.comparison.replays import matched_contact
from taccorl.diagnosis.problems.touch_problem import (
    GainStatistics,
    TouchProblem,
    odd_cells,
)
from taccorl.diagnosis.search.drift import Drift, changed
from taccorl.diagnosis.search.evidence import block_squares, gain_of, standard_score
from taccorl.diagnosis.search.fit import fit
from taccorl.diagnosis.search.problem import (
    Progress,
    Recording,
    no_progress,
    split_rows,
)
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.solve import PartFinding, solved, with_drifts
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.pads import TaxelGainMap
from taccorl.sim.twin import TwinConfig

FIELDS = {"k_n": "normal_stiffness_per_m", "k_d": "normal_damping_s_per_m"}
"""Fitted number → field of the twin's sensor. The zeros of pads belong to a recording's baseline and are not stored in a twin."""
Range = tuple[float, float]
"""(low, high)."""


def part_of(arm: str) -> str:
    """Name of the part for the pads of an arm: ``left pads``."""
    return f"{arm} pads"


def presses(m: Measurement, arm: str, config: TwinConfig) -> bool:
    """True if the recording states which object the pads of this arm pressed (``pressed`` in measurements.yaml), and these are
    pads that the twin has."""
    stated = m.pressed is not None and m.pressed.arm == arm
    return stated and not lacking_pads(m, config, arm)


def pressed_arms(measurements: Measurements, config: TwinConfig) -> tuple[str, ...]:
    """Names of the arms for which at least one fit recording states which object their pads pressed."""
    return tuple(
        arm
        for arm in ROBOT.arms
        if any(presses(m, arm, config) for m in measurements.fit)
    )


def diagnose_arm(
    config: TwinConfig,
    arm: str,
    measurements: Measurements,
    *,
    search: SearchConfig | None = None,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
) -> PartFinding:
    """Search for the effect that is missing in the pads of one arm, in the recordings that state what they pressed.

    Args:
        without: effects that are left out of the search.
        progress: function that is called with a text about the present step.

    Raises:
        TaccorlError: no fit recording states it, or no matched contact replay of the same pads can be made.
    """
    uses: dict[str, tuple[Measurement, ...]] = {
        use: tuple(m for m in getattr(measurements, use) if presses(m, arm, config))
        for use in ("fit", "validation", "test")
    }
    if not uses["fit"]:
        raise TaccorlError(
            f"{part_of(arm)}: no fit recording states what the pads pressed; state `pressed` in measurements.yaml"
        )
    motions = {use: [_motion(m, config) for m in some] for use, some in uses.items()}
    every = [motion for some in motions.values() for motion in some]
    _check_pads(every)
    problem = TouchProblem(every, config)
    drifted = drifts_of(every, config) if problem.repeats_differ else []
    if drifted:
        motions = {use: _apart(some, drifted) for use, some in motions.items()}
        problem = TouchProblem(_apart(every, drifted), config)
    problem.recordings(motions["fit"], motions["validation"], motions["test"])
    found = solved(part_of(arm), problem, search, without, progress)
    found = with_drifts(found, drifted)
    gains = None
    if not found.rows_split:
        gains = unjudged_gains(
            problem,
            found.diagnosis,
            problem.fit,
            problem.validation,
            search or SearchConfig(),
        )
    if gains is not None:
        return dataclasses.replace(found, remark=gain_words(gains, problem.not_shared))
    maps = [
        e
        for e in found.diagnosis.effects
        if isinstance(e, TaxelGainMap) and len(e.gains) > 1
    ]
    named = [
        odd_cells(np.reshape(e.gains, (len(e.pads), *ROBOT.pad.shape)), e.pads)
        for e in maps
    ]
    return dataclasses.replace(
        found, remark=f"{TaxelGainMap.name}: {named[0]}" if any(named) else ""
    )


def drifts_of(motions: Sequence[TouchMotion], config: TwinConfig) -> list[Drift]:
    """Numbers of the pads that changed between recordings of one press."""
    alone = [_repeating_none(motion) for motion in motions]
    problem, found = TouchProblem(alone, config), []
    made = {motion.name: problem.recording(motion) for motion in alone}
    for pair in repeat_pairs(motion.measurement for motion in motions):
        first, second = sorted(pair, key=lambda m: m.start_ns)
        over_s = 1e-9 * (second.start_ns - first.start_ns) or None
        recordings = made[first.name], made[second.name]
        found.append(
            changed(problem, *recordings, over_s, problem.present, problem.start)
        )
    return [drift for drift in found if drift is not None]


def _apart(
    motions: Sequence[TouchMotion], drifted: Sequence[Drift]
) -> list[TouchMotion]:
    """As ``joints.apart``."""
    names = {name for drift in drifted for name in (drift.first, drift.second)}
    return [
        _repeating_none(motion)
        if {motion.name, motion.measurement.repeat_of} <= names
        else motion
        for motion in motions
    ]


def _repeating_none(motion: TouchMotion) -> TouchMotion:
    own = dataclasses.replace(motion.measurement, repeat_of=None)
    return dataclasses.replace(motion, measurement=own)


def unjudged_gains(
    problem: TouchProblem,
    found: Diagnosis,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    config: SearchConfig,
) -> GainStatistics | None:
    """Statistics of the taxels' gains, if a gain map explains the residual after a search that could not judge it, because
    validation recordings press other taxels. The map is then validated in time instead of on other recordings: it is estimated
    from the first rows of every recording and evaluated on the last rows, with the search's own criteria. None if it does not
    meet them, or if the search could judge it: a map that the search added without common taxels only changed k_n.
    """
    name = TaxelGainMap.name
    names = tuple(n for n in found.names if n != name)
    left_over = found.status in ("something_else", "too_many")
    if not left_over or not problem.not_shared or name not in problem.candidates:
        return None
    early, late = split_rows([*fit_to, *validation])
    without = fit(problem, early, names, found.after.values)
    with_it = fit(problem, early, (*names, name), without.values)
    before = block_squares(problem, without, late)
    after = block_squares(problem, with_it, late)
    # Of a map as a whole, not of each of its numbers: what its gains are is not claimed here, only that they differ.
    if config.refusal(gain_of(after, before), standard_score(before - after), np.inf):
        return None
    return problem.gain_statistics(
        with_it.values, with_it.effects, [*fit_to, *validation]
    )


def gain_words(gains: GainStatistics, not_shared: Sequence[str]) -> str:
    """Text of a remark: the fault, why it is not a finding of the search, and what to record.

    Args:
        not_shared: names of the validation recordings that press other taxels than the fit recordings.
    """
    parts = []
    if gains.num_dead:
        share = gains.num_dead / max(gains.num_taxels, 1)
        parts.append(
            f"{gains.num_dead} of {gains.num_taxels} pressed taxels ({share:.0%}) read nothing"
        )
    parts.append(
        f"the gains of {'the others' if parts else 'taxels'} spread by {gains.log_std:.0%}"
    )
    cells = f"; {gains.odd}" * bool(gains.odd)
    return (
        f"{' and '.join(parts)} (dead_taxels, taxel_gain_spread){cells}: this explains what is left. No taxel_gain_map could be "
        f"judged, as {', '.join(not_shared)} press{'es' if len(not_shared) == 1 else ''} other taxels than the fit recordings; "
        "record a validation press at a place that a fit recording presses (excite --pads: rod_across)"
    )


def _motion(m: Measurement, config: TwinConfig) -> TouchMotion:
    assert m.pressed is not None
    return matched_contact(m, config, m.pressed)


def _check_pads(motions: Sequence[TouchMotion]) -> None:
    first = motions[0]
    other = next((m for m in motions if m.pads != first.pads), None)
    if other is not None:
        raise TaccorlError(
            f"{first.name} presses {' and '.join(first.pads)}, {other.name} {' and '.join(other.pads)}: one diagnosis needs "
            "recordings of the same pads; put them into separate folders, or correct position_m of the object that does not "
            "touch one of the pads"
        )


# the twin --------------------------------------------------------------------------------------------------------------


def set_numbers(config: TwinConfig, base: Mapping[str, float]) -> None:
    """Write fitted k_n and k_d, which hold for all its pads, into ``config``, in place."""
    fields = {field: float(base[name]) for name, field in FIELDS.items()}
    config.sensor = dataclasses.replace(config.sensor, **fields)


def agreed(
    fitted: Mapping[str, tuple[Mapping[str, float], Mapping[str, Sequence[float]]]],
) -> dict[str, float]:
    """``k_n`` and ``k_d`` for all parts: means of the fitted values, weighted by their intervals.

    Args:
        fitted: ``left pads`` → fitted numbers and their 95 % intervals.

    Raises:
        TaccorlError: the intervals of two parts do not overlap.
    """
    found = {}
    for name in FIELDS:
        values = {part: base[name] for part, (base, _) in fitted.items()}
        ends = {
            part: _ends(values[part], intervals.get(name))
            for part, (_, intervals) in fitted.items()
        }
        if max(low for low, _ in ends.values()) > min(
            high for _, high in ends.values()
        ):
            told = ", ".join(
                f"{part} {values[part]:.4g} ({low:.4g} … {high:.4g})"
                for part, (low, high) in ends.items()
            )
            arms = " or ".join(f"--pads={part.split()[0]}" for part in fitted)
            raise TaccorlError(
                f"{name} of {told}: the values differ, but a twin has one value for all of its pads. Use one arm's, {arms}; "
                "readings of the other arm's pads will be wrong in the twin"
            )
        widths = np.array(
            [max(high - low, 1e-9 * abs(low) + 1e-12) for low, high in ends.values()]
        )
        shares = widths**-2 / np.sum(widths**-2)
        found[name] = float(np.array(list(values.values())) @ shares)
    return found


def _ends(value: float, interval: Sequence[float] | None) -> Range:
    """An interval that is not known is the value alone."""
    if interval is None or not np.isfinite(np.array(interval, float)).all():
        return value, value
    return float(interval[0]), float(interval[1])
