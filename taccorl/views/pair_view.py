"""Two episodes in one Rerun view, on one time line: A above B, each joint's curves of both in one plot, and B − A on the pads.

    /a, /b                           pictures, pads, events, arms and provenance of each, as ``episode.py`` logs them
    /a/touch/{sum,peak,active}/<pad>, /b/…
    /a/curves/<feature>/<element>, /b/…
    /difference/<pad>                counts of B − counts of A, where both have the pad
    /pair                            which is which, where they are from, how they are aligned, what one of them lacks

A is white and B is magenta in every plot. Time line: ``time`` [s] since the first row of each, or since its first contact.
"""

import itertools
import re
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from taccorl.data.episode import Episode
from taccorl.views.blueprint import (
    arranged,
    figure_view,
    heatmap_places,
    plot,
    time_panel,
)
from taccorl.views.colors import GROUND_COLOR, NOISE_COLOR, PAIR_COLORS
from taccorl.views.episode import (
    at_one_time,
    curve_style,
    log_events,
    log_heat_scale,
    log_heatmaps,
    log_page,
    log_pictures,
    log_touch_curves,
    place,
    save_episode,
    write,
)
from taccorl.views.figure import arms_of, log_figure
from taccorl.views.outputs import check_free, replacing
from taccorl.views.pair import NAMES, Curve, Pair, cameras_of, elements_of, page_of
from taccorl.views.rrd import EpisodeLog, Progress, no_progress, recording_to
from taccorl.views.touch import Pad

ROOTS = ("a/", "b/")
"""Prefixes of the entities of A and B."""
WIDTHS = (3.0, 2.0)
"""Widths of the curves of A and B [points]: where both are equal, A is visible on either side of B."""
PLOTS_IN_A_ROW, PLOTS_IN_A_TAB = 3, 15
LABEL_TAXELS = 5.0
"""Height of the names above a row of pads [taxels]."""
TOUCH_KINDS = {
    "sum": "touch sum of active taxels [counts]",
    "peak": "touch peak [counts]",
    "active": "active taxels",
}


def save_shown(
    shown: Episode | Pair,
    rrd: Path,
    *,
    at_s: float | None = None,
    progress: Progress = no_progress,
) -> None:
    """Write an episode or a pair and its blueprint as one .rrd file; arguments and errors as ``save_episode``."""
    if isinstance(shown, Episode):
        save_episode(shown, rrd, at_s=at_s, progress=progress)
        return
    check_free(rrd)
    with (
        replacing(rrd) as part,
        recording_to(part, pair_blueprint(shown, at_s=at_s)) as rec,
    ):
        rec.send_recording_name(shown.name)
        _log_pair(rec, shown, at_s, progress)


def _log_pair(
    rec: rr.RecordingStream,
    pair: Pair,
    at_s: float | None,
    progress: Progress = no_progress,
) -> None:
    rec.log(
        "pair",
        rr.TextDocument(page_of(pair), media_type=rr.MediaType.MARKDOWN),
        static=True,
    )
    places = _places(pair)
    for k, (episode, pads) in enumerate(zip(pair.episodes, pair.pads, strict=True)):
        log = EpisodeLog(rec, episode, ROOTS[k], pair.begins_s[k], progress)
        seen = log if at_s is None else at_one_time(log, at_s)
        log_page(log)
        log_pictures(seen)
        for curve, key, i in elements_of(episode):
            path = _entity(key, curve)
            name = f"{NAMES[k]} action" if key == "action" else NAMES[k]
            log.static(path, curve_style(key, [PAIR_COLORS[k]], [name], WIDTHS[k]))
            log.send(
                path,
                rr.Scalars.columns(scalars=episode.arrays[key][:, i].astype(float)),
            )
        for pad in pads:
            log_touch_curves(log, pad, PAIR_COLORS[k], NAMES[k], WIDTHS[k])
        if pads:
            place(log, "observation/tactile", 0.0, _row_y(pair, k))
            log_heatmaps(seen, places, [NOISE_COLOR])
            _write_row_name(
                log, "observation/tactile", NAMES[k], PAIR_COLORS[k], pads[0]
            )
        log_events(log, pads)
        log_figure(log, pads)
    _log_scale(rec, pair, places)
    _log_difference(rec, pair, places, at_s)


def _places(pair: Pair) -> dict[str, float]:
    """Left edge of every pad of either episode [taxels]: the same for both."""
    pads = {pad.name: pad for pad in (*pair.pads[1], *pair.pads[0])}
    names = dict.fromkeys(pad.name for pad in (*pair.pads[0], *pair.pads[1]))
    return heatmap_places([pads[name] for name in names])


def _row_y(pair: Pair, row: int) -> float:
    """Upper edge of a row of pads [taxels]: A, B and difference, as far as they are there."""
    above = sum(bool(pads) for pads in pair.pads[:row])
    return above * (
        max(pad.sensor.rows for pads in pair.pads for pad in pads) + LABEL_TAXELS + 2.0
    )


def _write_row_name(
    log: EpisodeLog, path: str, text: str, color: tuple[int, int, int], pad: Pad
) -> None:
    """Left of the row's first pad."""
    write(
        log,
        f"{path}/row_name",
        -3.0 - len(text) / 2,
        pad.sensor.rows / 2 - 2.0,
        text,
        color,
    )


def _log_scale(rec: rr.RecordingStream, pair: Pair, places: dict[str, float]) -> None:
    """One colour scale for both rows of pads."""
    for k, pads in enumerate(pair.pads):
        if pads:
            height = 2.0 if all(pair.pads) else 1.0
            log_heat_scale(
                EpisodeLog(rec, pair.episodes[k], ROOTS[k]),
                pads,
                places["scale"],
                height,
            )
            return


def _log_difference(
    rec: rr.RecordingStream, pair: Pair, places: dict[str, float], at_s: float | None
) -> None:
    shared = pair.shared_pads()
    rows_a, rows_b = pair.common_rows()
    if not shared or not len(rows_a):
        return
    log = EpisodeLog(rec, pair.episodes[0], "difference/", pair.begins_s[0])
    if at_s is not None:
        last = max(
            int(
                np.searchsorted(log.begins_s + log.episode.time_s[rows_a], at_s + 1e-6)
            ),
            1,
        )
        rows_a, rows_b = rows_a[last - 1 : last], rows_b[last - 1 : last]
    place(log, "pads", 0.0, _row_y(pair, 2))
    full = pair.full_difference
    for pad_a, pad_b in shared:
        path = f"pads/{pad_a.name}"
        place(log, path, places[pad_a.name])
        counts = pad_b.counts[rows_b].astype(np.int32) - pad_a.counts[rows_a]
        image = difference_colors(counts / full)
        size = rr.components.ImageFormat(
            width=image.shape[2],
            height=image.shape[1],
            color_model="RGB",
            channel_datatype="U8",
        )
        log.static(
            path, rr.Image.from_fields(format=size, magnification_filter="nearest")
        )
        log.send(
            path,
            rr.Image.columns(buffer=image.reshape(len(image), -1)),
            rows_a.tolist(),
        )
    _write_row_name(log, "pads", "B − A", NOISE_COLOR, shared[0][0])


def difference_colors(share: np.ndarray) -> np.ndarray:
    """(…, 3) uint8 RGB of differences B − A, ``share`` (…), −1 … 1: A's colour where A has more, B's where B has more, dark at
    0."""
    share = np.clip(np.asarray(share, dtype=float), -1.0, 1.0)[..., None]
    ground, a, b = (np.array(c, dtype=float) for c in ((30, 38, 56), *PAIR_COLORS))
    return np.round(
        ground + np.abs(share) * (np.where(share < 0, a, b) - ground)
    ).astype(np.uint8)


def pair_blueprint(pair: Pair, *, at_s: float | None = None) -> rrb.Blueprint:
    """Pictures and arms on the left, pads in the middle, curves on the right; ``at_s`` as in ``episode_blueprint``."""
    columns = [(_scene(pair), 0.95), (_middle(pair), 0.7), (_over_time(pair), 1.4)]
    kept = [(part, share) for part, share in columns if part is not None]
    parts, shares = zip(*kept, strict=True)
    return arranged(rrb.Horizontal(*parts, column_shares=[*shares]), time_panel(at_s))


def _scene(pair: Pair) -> rrb.Container | None:
    """Cameras of A above those of B, and the arms of both."""
    rows, shares = [], []
    for k, episode in enumerate(pair.episodes):
        views = [
            rrb.Spatial2DView(
                origin=f"/{ROOTS[k]}observation/images/{name}",
                name=f"{NAMES[k]} {name}",
            )
            for name in cameras_of(episode)
        ]
        if views:
            rows.append(rrb.Horizontal(*views))
            shares.append(0.85)
    figures = [
        figure_view(episode, f"/{ROOTS[k]}", f"{NAMES[k]} arms (schematic)", 1.35)
        for k, episode in enumerate(pair.episodes)
        if arms_of(episode)
    ]
    if figures:
        rows.append(rrb.Horizontal(*figures))
        shares.append(1.3)
    return rrb.Vertical(*rows, row_shares=shares) if rows else None


def _middle(pair: Pair) -> rrb.Container:
    """Which is which, and the pads."""
    page = rrb.Tabs(
        rrb.TextDocumentView(origin="/pair", name="A and B"),
        *[
            rrb.TextDocumentView(origin=f"/{r}provenance", name=f"{n} provenance")
            for r, n in zip(ROOTS, NAMES, strict=True)
        ],
        active_tab=0,
    )
    if not any(pair.pads):
        return rrb.Vertical(page)
    places, rows = (
        _places(pair),
        max(pad.sensor.rows for pads in pair.pads for pad in pads),
    )
    bottom = _row_y(pair, 2) + (rows + 2.0 if pair.shared_pads() else 0.0)
    pads = rrb.Spatial2DView(
        origin="/",
        contents=[
            *(f"/{root}observation/tactile/**" for root in ROOTS),
            "/difference/**",
        ],
        name="touch: counts above baseline",
        background=GROUND_COLOR,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-11.0, places["scale"] + 32.0), y_range=(-LABEL_TAXELS, bottom)
        ),
    )
    return rrb.Vertical(page, pads, row_shares=[1.0, 1.8])


def _over_time(pair: Pair) -> rrb.Container | None:
    parts, shares = [], []
    lanes = sum(
        sum((bool(pads), bool(e.stages), e.success is not None))
        for e, pads in zip(pair.episodes, pair.pads, strict=True)
    )
    if lanes:
        events = [f"/{root}events/**" for root in ROOTS]
        parts.append(
            rrb.StateTimelineView(
                origin="/", contents=events, name=f"events · {pair.origin}"
            )
        )
        shares.append(0.55 + 0.25 * lanes)
    names = list(dict.fromkeys(pad.name for pads in pair.pads for pad in pads))
    if names:
        tabs = [
            rrb.Horizontal(
                *[
                    plot(
                        name,
                        [f"/{root}touch/{kind}/{name}" for root in ROOTS],
                        rrb.Corner2D.LeftTop if k == 0 else None,
                    )
                    for k, name in enumerate(names)
                ],
                name=title,
            )
            for kind, title in TOUCH_KINDS.items()
        ]
        parts.append(rrb.Tabs(*tabs, active_tab=0))
        shares.append(1.2)
    curves = dict.fromkeys(c for own in pair.curves for c in own)
    tabs = []
    for family, own in itertools.groupby(
        sorted(curves, key=lambda c: c.family != "joints"), key=lambda c: c.family
    ):
        for k, some in enumerate(itertools.batched(own, PLOTS_IN_A_TAB)):
            name = family + (f", from {k * PLOTS_IN_A_TAB + 1}" if k else "")
            tabs.append(
                rrb.Grid(
                    *[_curve_plot(pair, c) for c in some],
                    grid_columns=PLOTS_IN_A_ROW,
                    name=name,
                )
            )
    if tabs:
        parts.append(rrb.Tabs(*tabs, active_tab=0))
        shares.append(5.0)
    return rrb.Vertical(*parts, row_shares=shares) if parts else None


def _curve_plot(pair: Pair, curve: Curve) -> rrb.TimeSeriesView:
    contents = []
    for episode, root in zip(pair.episodes, ROOTS, strict=True):
        contents += [
            f"/{root}{_entity(key, c)}"
            for c, key, _ in elements_of(episode)
            if c == curve
        ]
    return plot(
        curve.title, contents, None
    )  # the page and the plots of touch say which colour is which


def _entity(key: str, curve: Curve) -> str:
    return (
        f"curves/{key.replace('.', '/')}/{re.sub(r'\W+', '_', curve.title).strip('_')}"
    )
