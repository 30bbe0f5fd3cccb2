"""Layout of an episode in Rerun: pictures and touch on the left, curves over time on the right, on one linked time axis."""

import itertools

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from taccorl.data.episode import Episode
from taccorl.views.colors import GROUND_COLOR
from taccorl.views.figure import BASE_POS_WORLD, arms_of, floor_z_m, tool_paths
from taccorl.views.groups import groups_of, short_name, vector_keys
from taccorl.views.touch import OtherTouch, Pad, other_touch_of, pads_of

FIGURE_NAME = "arms (schematic): joints in the plots' colours"
PAD_GAP_TAXELS = 3.0
"""Distance of neighbouring pads in the view [taxels]."""
MOST_IN_A_ROW, MOST_ROWS = 3, 6
EYE_SIZES, EYE_M = 1.1, 1.15
"""Distance of the viewer's eye from the figure: multiples of the figure's size, and the least distance [m]."""


def episode_blueprint(episode: Episode, *, at_s: float | None = None) -> rrb.Blueprint:
    """Rerun layout with a view for each kind of data in the episode. ``at_s``: the time that a screenshot shows [s], without
    playing; None: it plays from the start."""
    pads = pads_of(episode)
    parts = [
        part
        for part in (_space(episode, pads), _over_time(episode, pads))
        if part is not None
    ]
    return arranged(rrb.Horizontal(*parts), time_panel(at_s))


def arranged(root: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    """Blueprint of the views ``root``, without Rerun's own panels."""
    hidden = rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden")
    return rrb.Blueprint(root, time, *hidden, auto_views=False)


def time_panel(at_s: float | None) -> rrb.TimePanel:
    """Time panel that plays from the start, or stops at ``at_s`` [s]."""
    if at_s is None:
        return rrb.TimePanel(
            state="collapsed", timeline="time", play_state="playing", loop_mode="all"
        )
    # A blueprint cannot set the cursor. A loop one nanosecond long, reached in the first frame, holds it there.
    at_ns = round(at_s * 1e9)
    return rrb.TimePanel(
        state="collapsed",
        timeline="time",
        play_state="playing",
        playback_speed=1e4,
        loop_mode="selection",
        time_selection=rrb.components.AbsoluteTimeRange(min=at_ns, max=at_ns + 1),
    )


def _space(episode: Episode, pads: list[Pad]) -> rrb.Container:
    """The arms, the pictures, the pads; and the page that says what all this is."""
    page = rrb.TextDocumentView(
        origin="/provenance", name=_with_origin("provenance", episode)
    )
    rows: list[rrb.View | rrb.Container] = [page]
    shares = [0.7]
    if arms_of(episode):
        beside = rrb.Horizontal if episode.picture_keys or pads else rrb.Vertical
        rows[0], shares[0] = (
            beside(figure_view(episode, "/", FIGURE_NAME), page),
            1.4 if pads else 1.0,
        )
    if episode.picture_keys:
        names = [short_name(key) for key in episode.picture_keys]
        rows.append(
            rrb.Horizontal(
                *[
                    rrb.Spatial2DView(origin=f"/observation/images/{n}", name=n)
                    for n in names
                ]
            )
        )
        shares.append(1.05)
    if pads:
        rows.append(_heatmaps(pads))
        shares.append(1.3)
    if other := other_touch_of(episode):
        rows.append(rrb.Horizontal(*map(_other_heatmaps, other)))
        shares.append(1.3)
    return rrb.Vertical(*rows, row_shares=shares)


def figure_view(
    episode: Episode, root: str, name: str, away: float = 1.0
) -> rrb.Spatial3DView:
    """The arms below entity ``root``, seen from the front right, near enough that arms and tool paths fill the view. ``away``:
    factor on the eye's distance; a narrow view needs a larger one."""
    points = np.concatenate(
        [*tool_paths(episode).values(), list(BASE_POS_WORLD.values())]
    )
    low, high = (
        points.min(axis=0),
        points.max(axis=0) + np.array([0, 0, 0.3]),
    )  # elbows rise above the bases
    middle, size_m = (low + high) / 2, float(np.linalg.norm(high - low))
    return rrb.Spatial3DView(
        origin=f"{root}figure",
        name=name,
        background=GROUND_COLOR,
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=0.1,
            plane=rr.components.Plane3D.XY.with_distance(floor_z_m(episode)),
            color=(71, 85, 105, 120),
        ),
        eye_controls=rrb.EyeControls3D(
            position=middle
            + away * max(EYE_SIZES * size_m, EYE_M) * np.array([0.85, -0.22, 0.45]),
            look_target=middle,
            eye_up=(0, 0, 1),
        ),
    )


def _heatmaps(pads: list[Pad]) -> rrb.Spatial2DView:
    """All pads and the colour bar side by side, as ``episode.py`` places them."""
    places = heatmap_places(pads)
    height = max(pad.sensor.rows for pad in pads)
    return rrb.Spatial2DView(
        origin="/observation/tactile",
        name=f"touch: counts above baseline, 0 … {max(pad.sensor.max_count for pad in pads)}, fixed colours",
        background=GROUND_COLOR,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-2.0, places["scale"] + 9.0), y_range=(-5.0, height + 1.5)
        ),
    )


def _other_heatmaps(touch: OtherTouch) -> rrb.Spatial2DView:
    """The pads of one feature side by side, as ``episode.py`` places them."""
    num_pads, rows, columns = touch.values.shape[1:]
    width = num_pads * (columns + PAD_GAP_TAXELS) - PAD_GAP_TAXELS
    return rrb.Spatial2DView(
        origin=f"/{touch.path}",
        name=touch.title,
        background=GROUND_COLOR,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-1.0, width + 1.0), y_range=(-1.0, rows + 1.0)
        ),
    )


def heatmap_places(pads: list[Pad]) -> dict[str, float]:
    """Name of each pad (and ``scale``) → position of its left edge in the picture of all pads, in taxels."""
    places, x = {}, 0.0
    for pad in pads:
        places[pad.name] = x
        x += pad.sensor.columns + PAD_GAP_TAXELS
    places["scale"] = x + 1.0
    return places


def _over_time(episode: Episode, pads: list[Pad]) -> rrb.Container | None:
    views, shares = [], []
    lanes = {
        "contact gate": bool(pads),
        "outcome": episode.success is not None,
        "stage": bool(episode.stages),
    }
    shown = [lane for lane, there in lanes.items() if there]
    if shown:
        views.append(
            rrb.StateTimelineView(
                origin="/events", name=_with_origin(", ".join(shown), episode)
            )
        )
        shares.append(0.35 + 0.25 * len(shown))
    if pads:
        for path, share, title in (
            ("sum", 0.9, "touch sum of active taxels [counts above baseline]"),
            (
                "peak",
                1.25,
                "touch peak [counts above baseline]",
            ),  # two more lines in its legend
            (
                "active",
                0.85,
                f"active taxels, above the noise floor [of {pads[0].counts[0].size} a pad]",
            ),
        ):
            views.append(plot(title, [f"/touch/{path}/**"], rrb.Corner2D.LeftTop))
            shares.append(share)
    plots = _joint_plots(episode)
    in_a_row = MOST_IN_A_ROW if pads or len(plots) > MOST_ROWS else 1
    for row in itertools.batched(plots, in_a_row):
        views.append(rrb.Horizontal(*row))
        shares.append(1.35)
    return rrb.Vertical(*views, row_shares=shares) if views else None


def _joint_plots(episode: Episode) -> list[rrb.TimeSeriesView]:
    """State and action of the same joints share a plot."""
    contents: dict[str, list[str]] = {}
    groups = {}
    for key in vector_keys(episode):
        for group in groups_of(episode.spec.features[key]):
            about = "joints" if key in ("observation.state", "action") else key
            title = (
                group.title
                if about == "joints"
                else f"{short_name(key)}: {group.title}"
            )
            title = (
                title.replace(": joints", ": values")
                if key.startswith("observation.tactile")
                else title
            )
            contents.setdefault(title, []).append(
                f"/{key.replace('.', '/')}/{group.path}"
            )
            groups[title] = group
    on_the_figure = set(arms_of(episode))
    plots = []
    for title, paths in contents.items():
        suffix = ": action thin" if len(paths) == 2 else ""
        # The figure's joints wear the lines' colours: no legend in the way.
        corner = (
            None
            if set(groups[title].name.split()) & on_the_figure
            else rrb.Corner2D.LeftBottom
        )
        plots.append(plot(title + suffix, paths, corner))
    return plots


def plot(
    title: str, contents: list[str], legend: rrb.Corner2D | None
) -> rrb.TimeSeriesView:
    """View of the curves ``contents`` (paths of entities) over time, on the common time axis; without a legend if no corner is
    given."""
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=title,
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        plot_legend=rrb.PlotLegend(
            legend or rrb.Corner2D.LeftTop, visible=legend is not None
        ),
    )


def _with_origin(title: str, episode: Episode) -> str:
    return f"{title} · {episode.origin}" if episode.origin else title
