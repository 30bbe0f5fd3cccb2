"""Two episodes on one time line: their common curves and pads, those that only one has, and the page that describes them."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.finding import listed
from taccorl.errors import TaccorlError
from taccorl.views.groups import element_names, short_name, vector_keys
from taccorl.views.provenance import outcome
from taccorl.views.touch import CONTACT_THRESHOLD, Pad, contact_gate, pads_of

Align = Literal["start", "contact"]
"""Which instants of two episodes are shown at the same time: their starts, or their first contacts."""
NAMES = ("A", "B")
"""Names of the two episodes."""
COLOR_WORDS = ("white", "magenta")
"""Names of the colours ``colors.PAIR_COLORS``."""


@dataclass(frozen=True)
class Curve:
    """One element of a feature, from all episodes that have it."""

    element: str
    """Name of the element."""
    unit: str
    family: str
    """``joints`` for state and action, whose curves share a plot; the feature's own name otherwise."""

    @property
    def title(self) -> str:
        """Name of the element and its unit."""
        return f"{self.element} [{self.unit}]" if self.unit else self.element

    @property
    def name(self) -> str:
        """Title of the curve; it includes the feature unless that is state or action."""
        return self.title if self.family == "joints" else f"{self.family} {self.title}"


class Pair:
    """Two episodes and the times at which they begin. ``align``: ``start``: row 0 of each at 0 s; ``contact``: the first
    contact of each at 0 s. Raises TaccorlError: ``align`` is ``contact``, and an episode has no touch or no contact."""

    def __init__(self, a: Episode, b: Episode, align: Align = "start") -> None:
        self.episodes = (a, b)
        self.align = align
        self.pads = (pads_of(a), pads_of(b))
        self.begins_s = (
            (0.0, 0.0)
            if align == "start"
            else tuple(-_required_contact_s(e) for e in self.episodes)
        )
        self.curves = tuple(
            list(dict.fromkeys(c for c, _, _ in elements_of(e))) for e in self.episodes
        )

    @property
    def name(self) -> str:
        """Names of both episodes."""
        return " beside ".join(e.name for e in self.episodes)

    @property
    def origin(self) -> str:
        """Origins of both episodes."""
        return "; ".join(
            f"{name}: {e.origin}" for name, e in zip(NAMES, self.episodes, strict=True)
        )

    @property
    def num_rows(self) -> int:
        """Number of rows of both episodes together."""
        return sum(e.num_rows for e in self.episodes)

    @property
    def best_time_s(self) -> float:
        """Time at which touch is strongest in A while B runs [s]; the middle of that time if A has no touch."""
        rows = (
            self.common_rows()[0]
            if len(self.common_rows()[0])
            else np.arange(self.episodes[0].num_rows)
        )
        touch = sum(pad.sum_count[rows] for pad in self.pads[0])
        row = rows[int(np.argmax(touch)) if np.any(touch) else len(rows) // 2]
        return self.begins_s[0] + float(self.episodes[0].time_s[row])

    def shared_pads(self) -> list[tuple[Pad, Pad]]:
        """Return pairs (pad of A, pad of B) of the pads that both have with the same name, shape and gain, so that counts can be
        subtracted."""
        others = {pad.name: pad for pad in self.pads[1]}
        pairs = [(pad, others[pad.name]) for pad in self.pads[0] if pad.name in others]
        return [(a, b) for a, b in pairs if _layout(a) == _layout(b)]

    def common_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of A during which B runs, and for each the newest row of B at or before it; two integer arrays (n,)."""
        a, b = self.episodes
        offset_s = self.begins_s[0] - self.begins_s[1]
        rows_b = np.floor((a.time_s + offset_s) * b.spec.fps + 1e-6).astype(int)
        common = np.flatnonzero((rows_b >= 0) & (rows_b < b.num_rows))
        return common, rows_b[common]

    @functools.cached_property
    def full_difference(self) -> float:
        """Difference of counts that gets the full colour: the largest difference, but at least the contact threshold."""
        rows_a, rows_b = self.common_rows()
        found = [
            np.abs(b.counts[rows_b].astype(np.int32) - a.counts[rows_a]).max()
            for a, b in self.shared_pads()
        ]
        return float(max(*found, self.shared_pads()[0][0].gate_count))


def elements_of(episode: Episode) -> Iterator[tuple[Curve, str, int]]:
    """Yield (curve, key of the feature, number of the element) for every element of every feature that is shown as curves."""
    for key in vector_keys(episode):
        feature = episode.spec.features[key]
        family = "joints" if key in ("observation.state", "action") else short_name(key)
        for i, (name, unit) in enumerate(
            zip(element_names(feature), feature.units, strict=True)
        ):
            yield (
                Curve(name if feature.names else f"element {name}", unit, family),
                key,
                i,
            )


def cameras_of(episode: Episode) -> list[str]:
    """Return the names of the episode's cameras, without ``observation.images.``."""
    return [short_name(key) for key in episode.picture_keys]


def page_of(pair: Pair) -> str:
    """Return a Markdown page: names and origins of both episodes, alignment, and data that one of them lacks."""
    lines = []
    for name, color, e in zip(NAMES, COLOR_WORDS, pair.episodes, strict=True):
        facts = f"outcome {outcome(e)}; {e.num_rows / e.spec.fps:.2f} s at {e.spec.fps} fps; {_contact_words(e)}"
        lines += [
            f"**{name} ({color}): {e.name}**  \ndata: **{e.origin}**  \n{facts}",
            "",
        ]
    aligned = "first contact" if pair.align == "contact" else "first row"
    facts = [
        f"0 s is the {aligned} of each; curves: state thick, action thin",
        *_lacks(pair),
    ]
    if pair.shared_pads() and len(pair.common_rows()[0]):
        more = f"{COLOR_WORDS[1]} where B has more counts, {COLOR_WORDS[0]} where A has more"
        facts.append(f"B − A: {more}; full colour at ± {pair.full_difference:.0f}")
    instructions = list(dict.fromkeys(e.instruction for e in pair.episodes))
    facts.append(f"instruction: *{'* and *'.join(instructions)}*")
    return "\n".join([*lines, *(f"- {text}" for text in facts)])


def _lacks(pair: Pair) -> list[str]:
    """What only one of them has, and pads of both whose counts cannot be subtracted."""
    found = []
    for k, other in ((0, 1), (1, 0)):
        for what, own, others in (
            ("cameras", cameras_of(pair.episodes[k]), cameras_of(pair.episodes[other])),
            (
                "pads",
                [p.name for p in pair.pads[k]],
                [p.name for p in pair.pads[other]],
            ),
            (
                "curves",
                [c.name for c in pair.curves[k]],
                [c.name for c in pair.curves[other]],
            ),
        ):
            names = [name for name in own if name not in others]
            if names:
                found.append(f"only in {NAMES[k]}: {what} {listed(names)}")
    subtracted = {pad.name for pad, _ in pair.shared_pads()}
    others = {pad.name: pad for pad in pair.pads[1]}
    for pad in pair.pads[0]:
        if pad.name in others and pad.name not in subtracted:
            kinds = [
                f"{p.sensor.rows} × {p.sensor.columns}, {p.sensor.gain_per_count:.4g} a count"
                for p in (pad, others[pad.name])
            ]
            found.append(f"no difference of {pad.name}: A has {kinds[0]}, B {kinds[1]}")
    if not len(pair.common_rows()[0]):
        found.append("no row of A and B is at the same time")
    return found


def _contact_words(episode: Episode) -> str:
    pads = pads_of(episode)
    gate = contact_gate(pads) if pads else np.zeros(1, dtype=bool)
    if not gate.any():
        return "no contact" if pads else "no touch"
    return f"first contact at {episode.time_s[int(np.argmax(gate))]:.2f} s"


def _required_contact_s(episode: Episode) -> float:
    pads = pads_of(episode)
    if not pads:
        raise TaccorlError(
            f"--align=contact: {episode.name} has no touch; give --align=start"
        )
    gate = contact_gate(pads)
    if not gate.any():
        raise TaccorlError(
            f"--align=contact: {episode.name}: no taxel beyond {CONTACT_THRESHOLD} ({pads[0].gate_count:.3g} counts) in "
            f"{episode.num_rows} rows; give --align=start, which aligns the first rows"
        )
    return float(episode.time_s[int(np.argmax(gate))])


def _layout(pad: Pad) -> tuple[int, int, float]:
    return pad.sensor.rows, pad.sensor.columns, pad.sensor.gain_per_count
