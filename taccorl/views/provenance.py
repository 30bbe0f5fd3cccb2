"""Provenance of an episode as a page of text."""

import re

import numpy as np

from taccorl.data.episode import ChannelTiming, Episode
from taccorl.report.markdown import escaped, markdown
from taccorl.report.section import Section
from taccorl.views.touch import CONTACT_THRESHOLD, MIN_ACTIVE_TAXELS, pads_of

TIMING_COLUMNS = "rate, gaps, longest gap (ms); age of the sample that a row shows, median and oldest (ms)"


def outcome(episode: Episode) -> str:
    """Return ``success``, ``failure`` or ``not stated``."""
    return {True: "success", False: "failure", None: "not stated"}[episode.success]


def provenance(episode: Episode) -> str:
    """Return the provenance page in Markdown: origin first, then contents, the sensor's numbers, the channels' timing, and all
    other stored facts."""
    spec = episode.spec
    facts = [
        (name.replace("_", " "), _short(v))
        for name, v in episode.provenance.items()
        if v is not None
    ]
    lines = [
        f"instruction: *{escaped(episode.instruction)}*",
        f"outcome: {outcome(episode)}",
        f"{episode.num_rows} rows, {episode.num_rows / spec.fps:.2f} s at {spec.fps} fps",
        f"data spec {escaped(spec.name)}, robot {escaped(spec.robot_type)}",
        *(f"{escaped(name)}: {escaped(value)}" for name, value in facts),
        *_touch(episode),
    ]
    return markdown(
        Section(text=[f"data: {escaped(episode.origin)}"], style="data"),
        Section(text=[escaped(episode.name)], style="data"),
        Section(text=lines),
        *([_timing(episode.timing)] if episode.timing else []),
    )


def _short(value: object) -> str:
    """Digests by their first 12 digits, as `taccorl lineage` shows them."""
    text = str(value)
    return text[:12] if re.fullmatch(r"[0-9a-f]{32,}", text) else text


def _touch(episode: Episode) -> list[str]:
    pads = pads_of(episode)
    lines = []
    for sensor in {pad.sensor.name: pad.sensor for pad in pads}.values():
        own = [pad for pad in pads if pad.sensor.name == sensor.name]
        lines.append(
            f"sensor {escaped(sensor.name)}: {len(own)} pads of {sensor.rows} × {sensor.columns} taxels, counts above "
            f"baseline up to {sensor.max_count}, noise floor {sensor.noise_count:g}"
        )
        lines.append(
            f"scheme {escaped(sensor.scheme)}: reading = counts × {sensor.gain_per_count:.4g}; contact gate: "
            f"≥ {MIN_ACTIVE_TAXELS} taxel beyond {CONTACT_THRESHOLD} ({own[0].gate_count:.3g} counts)"
        )
    for key, counts in episode.baselines.items():
        lines.append(
            f"baseline of {escaped(key)}: median {np.median(counts):.0f}, {counts.min():.0f} … {counts.max():.0f} counts"
        )
    return lines


def _timing(timing: tuple[ChannelTiming, ...]) -> Section:
    rows = []
    for t in timing:
        numbers = (
            f"{t.rate_hz:.1f}",
            str(t.gaps),
            *(f"{1e3 * s:.0f}" for s in (t.longest_gap_s, t.age_median_s, t.age_max_s)),
        )
        rows.append([t.channel, str(t.align), *numbers])
    notes = []
    for name in ("duplicates", "out_of_order", "zero_stamps"):
        odd = [
            f"{escaped(t.channel)} {getattr(t, name)}"
            for t in timing
            if getattr(t, name)
        ]
        notes += [f"{name.replace('_', ' ')}: {', '.join(odd)}"] * bool(odd)
    heads = ("channel", "align", "Hz", "gaps", "ms", "age", "oldest")
    title = [Section(notes=[f"**timing**: {TIMING_COLUMNS}"])]
    return Section(
        parts=[*title, Section(heads=heads, rows=rows, right=range(2, 7), notes=notes)]
    )
