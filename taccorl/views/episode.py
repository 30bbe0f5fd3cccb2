"""Write an episode for Rerun, column by column: pictures, touch, states, commands, events and provenance.

    /observation/images/<camera>     pictures as JPEG, which every viewer decodes
    /observation/tactile/<pad>       heatmaps, counts above baseline, one fixed colour scale
    /touch_values/<feature>/<pad>    heatmaps of touch of unknown layout and unit, one colour scale for an episode
    /observation/state/<group>, /action/<group>, and every other feature of a few numbers
    /touch/{sum,peak,active}/<pad>, /touch/…/<line>
    /events/{contact_gate,outcome,stage}
    /figure                          the arms in 3-D
    /provenance                      description, origin, and timing of its samples

Time lines: ``time`` (seconds since row 0) and ``frame_index``. ``blueprint.py`` arranges the views.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr

from taccorl.data.episode import Episode
from taccorl.data.sensor_spec import SensorSpec
from taccorl.views.blueprint import PAD_GAP_TAXELS, episode_blueprint, heatmap_places
from taccorl.views.colors import (
    CONTACT_COLOR,
    HEATMAP,
    LINE_COLORS,
    NOISE_COLOR,
    PAD_COLORS,
)
from taccorl.views.figure import log_figure
from taccorl.views.groups import groups_of, short_name, vector_keys
from taccorl.views.outputs import check_free, replacing
from taccorl.views.part import part_of
from taccorl.views.provenance import provenance
from taccorl.views.rrd import EpisodeLog, Progress, no_progress, recording_to
from taccorl.views.touch import OtherTouch, Pad, contact_gate, other_touch_of, pads_of

JPEG_QUALITY = 90
PICTURES_AT_ONCE = 64  # rows; more would only hold more decoded pictures
EVENT_COLORS = (0x2563EBFF, 0x0D9488FF, 0xCA8A04FF, 0x9333EAFF, 0xDB2777FF, 0x65A30DFF)


def log_episode(log: EpisodeLog, *, at_s: float | None = None) -> None:
    """Log all data of the episode; missing features are left out. ``at_s``: log only those pictures and pads that are shown at
    this time [s], so that a program that draws one picture need not load a long recording. Raises DatasetError: a video file
    differs from the dataset's description."""
    episode, pads = log.episode, pads_of(log.episode)
    seen = log if at_s is None else at_one_time(log, at_s)
    log_page(log)
    log_pictures(seen)
    for key in vector_keys(episode):
        _log_vector(log, key)
    if pads:
        places = heatmap_places(pads)
        log_heatmaps(seen, places, PAD_COLORS)
        log_heat_scale(log, pads, places["scale"])
        _log_touch(log, pads)
    log_other_touch(seen, other_touch_of(episode))
    log_events(log, pads)
    log_figure(log, pads)


def save_episode(
    episode: Episode,
    rrd: Path,
    *,
    at_s: float | None = None,
    progress: Progress = no_progress,
) -> None:
    """Write the episode and its blueprint as one .rrd file; ``at_s`` as in ``episode_blueprint``. Raises OutputError: ``rrd``
    exists and was not written by taccorl, or the disk is full."""
    check_free(rrd)
    with (
        replacing(rrd) as part,
        recording_to(part, episode_blueprint(episode, at_s=at_s)) as rec,
    ):
        rec.send_recording_name(episode.name)
        log_episode(EpisodeLog(rec, episode, progress=progress), at_s=at_s)


def at_one_time(log: EpisodeLog, at_s: float) -> EpisodeLog:
    """The one row of an episode that a screenshot at ``at_s`` [s] shows: the last row that is not later, or the first row if all
    are. It keeps its time."""
    fps = log.episode.spec.fps
    row = min(
        max(math.floor((at_s - log.begins_s) * fps + 1e-6), 0), log.episode.num_rows - 1
    )
    part = part_of(log.episode, row / fps, (row + 1) / fps)
    return dataclasses.replace(log, episode=part, begins_s=log.begins_s + row / fps)


def log_page(log: EpisodeLog) -> None:
    log.static(
        "provenance",
        rr.TextDocument(provenance(log.episode), media_type=rr.MediaType.MARKDOWN),
    )


def log_pictures(log: EpisodeLog) -> None:
    """Log the pictures of all cameras; errors as ``log_episode``."""
    keys = log.episode.picture_keys
    for batch in itertools.batched(
        enumerate(log.episode.pictures()) if keys else (), PICTURES_AT_ONCE
    ):
        for key in keys:
            blobs = [_jpeg(pictures[key]) for _, pictures in batch]
            columns = rr.EncodedImage.columns(
                blob=blobs, media_type=["image/jpeg"] * len(blobs)
            )
            log.send(
                f"observation/images/{short_name(key)}",
                columns,
                [row for row, _ in batch],
            )
        log.progress(log.episode.name, batch[-1][0] + 1, log.episode.num_rows)


def _jpeg(rgb: np.ndarray) -> bytes:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[
        1
    ].tobytes()


def _log_vector(log: EpisodeLog, key: str) -> None:
    """State: thick; action: the same colours, thin and pale."""
    for group in groups_of(log.episode.spec.features[key]):
        path = f"{key.replace('.', '/')}/{group.path}"
        colors = [LINE_COLORS[i % len(LINE_COLORS)] for i in range(len(group.columns))]
        # same names: the legend lists a joint once
        log.static(path, curve_style(key, colors, group.labels))
        log.send(
            path,
            rr.Scalars.columns(scalars=log.episode.arrays[key][:, list(group.columns)]),
        )


def curve_style(
    key: str,
    colors: Sequence[tuple[int, int, int]],
    names: Sequence[str],
    width: float = 2.0,
) -> rr.SeriesLines:
    """Style of the curves of feature ``key``: those of the action are thin and pale."""
    is_action = key == "action"
    return rr.SeriesLines(
        colors=[(*c, 130) if is_action else c for c in colors],
        widths=[1.0 if is_action else width] * len(colors),
        names=list(names),
    )


def log_heatmaps(
    log: EpisodeLog, places: dict[str, float], colors: Sequence[tuple[int, int, int]]
) -> None:
    """The pads side by side, each with its name. Negative counts are drawn as 0; the dataset is not changed. ``places``:
    positions from ``heatmap_places``. ``colors``: colours of the names, in turn."""
    for i, pad in enumerate(pads_of(log.episode)):
        image = np.clip(pad.counts, 0, pad.sensor.max_count).astype(
            np.uint8 if pad.sensor.max_count <= 255 else np.uint16
        )
        path = f"observation/tactile/{pad.name}"
        place(log, path, places[pad.name])
        log.static(path, _heatmap_style(pad.sensor, image[0]))
        log.send(
            path,
            rr.DepthImage.columns(buffer=image.reshape(len(image), -1).view(np.uint8)),
        )
        write(
            log,
            f"{path}/name",
            pad.sensor.columns / 2,
            -3.5,
            pad.name,
            colors[i % len(colors)],
        )


def log_other_touch(log: EpisodeLog, touch: Sequence[OtherTouch]) -> None:
    """Log touch that no sensor spec describes: the pads of a feature side by side, values unchanged. ``touch``: of the whole
    episode, whose range the colours have; ``log`` may be a part of it."""
    for whole, shown in zip(touch, other_touch_of(log.episode), strict=True):
        num_rows, num_pads, rows, columns = shown.values.shape
        for pad in range(num_pads):
            path = f"{shown.path}/{pad}"
            place(log, path, pad * (columns + PAD_GAP_TAXELS))
            log.static(
                path,
                depth_style(
                    rows,
                    columns,
                    np.float32,
                    (whole.low, max(whole.high, whole.low + 1e-6)),
                ),
            )
            image = np.ascontiguousarray(shown.values[:, pad])
            log.send(
                path,
                rr.DepthImage.columns(
                    buffer=image.reshape(num_rows, -1).view(np.uint8)
                ),
            )


def log_heat_scale(
    log: EpisodeLog, pads: list[Pad], x: float, height: float = 1.0
) -> None:
    """Log the colour scale of the heatmaps at position ``x`` [taxels], ``height`` times as high as a pad."""
    sensor = max((pad.sensor for pad in pads), key=lambda s: s.max_count)
    bar = np.repeat(
        np.linspace(sensor.max_count, 0, 4 * sensor.rows).astype(np.uint16)[:, None],
        8,
        axis=1,
    )
    path = "observation/tactile/scale"
    place(log, path, x, scale=0.25 * height)
    log.static(path, _heatmap_style(sensor, bar))
    log.static(path, rr.DepthImage.from_fields(buffer=bar.tobytes()))
    for count, text in (
        (sensor.noise_count, f"noise floor {sensor.noise_count:g}"),
        (pads[0].gate_count, f"contact {pads[0].gate_count:.3g}"),
        (sensor.max_count / 2, f"{sensor.max_count / 2:g}"),
        (sensor.max_count, f"{sensor.max_count}"),
    ):
        y = bar.shape[0] * (1 - count / sensor.max_count)
        write(
            log,
            f"{path}/{text.split()[0]}",
            12 + 2.0 * len(text),
            y - 5,
            text,
            NOISE_COLOR,
        )


def place(
    log: EpisodeLog, path: str, x: float, y: float = 0.0, scale: float = 1.0
) -> None:
    """Place the entity at ``path`` in a 2-D view, at ``x`` and ``y`` [taxels, y down], enlarged by ``scale``."""
    log.static(path, rr.Transform3D(translation=(x, y, 0.0), scale=scale))


def write(
    log: EpisodeLog,
    path: str,
    x: float,
    y: float,
    text: str,
    color: tuple[int, int, int],
) -> None:
    """Write a text into a 2-D view, centred at ``x``, below ``y`` [taxels]."""
    log.static(
        path,
        rr.Points2D(
            [(x, y)], labels=[text], colors=[color], radii=0.001, show_labels=True
        ),
    )


def _heatmap_style(sensor: SensorSpec, image: np.ndarray) -> rr.DepthImage:
    """Everything but the counts."""
    rows, columns = image.shape
    return depth_style(rows, columns, image.dtype, (0.0, float(sensor.max_count)))


def depth_style(
    rows: int, columns: int, dtype: Any, value_range: tuple[float, float]
) -> rr.DepthImage:
    """Everything of a heatmap but its values of ``dtype``; ``value_range``: of the colours."""
    kind = rr.ChannelDatatype.from_np_dtype(np.dtype(dtype))
    return rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(
            width=columns, height=rows, channel_datatype=kind
        ),
        meter=1.0,
        colormap=HEATMAP,
        depth_range=value_range,
        magnification_filter="nearest",
    )


def _log_touch(log: EpisodeLog, pads: list[Pad]) -> None:
    for i, pad in enumerate(pads):
        log_touch_curves(log, pad, PAD_COLORS[i % len(PAD_COLORS)], pad.name)
    for sensor, gate_count in {
        pad.sensor.name: (pad.sensor, pad.gate_count) for pad in pads
    }.values():
        for name, count, color in (
            (f"noise floor {sensor.noise_count:g}", sensor.noise_count, NOISE_COLOR),
            (f"contact {gate_count:.3g}", gate_count, CONTACT_COLOR),
        ):
            path = f"touch/peak/{name.replace(' ', '_').replace('.', '_')}"
            log.static(path, rr.SeriesLines(colors=color, names=name, widths=1.0))
            log.send(
                path,
                rr.Scalars.columns(scalars=np.full(len(pads[0].counts), float(count))),
            )


def log_touch_curves(
    log: EpisodeLog,
    pad: Pad,
    color: tuple[int, int, int],
    name: str,
    width: float = 1.5,
) -> None:
    """Log sum, peak and number of active taxels of one pad over time, as curves named ``name``."""
    for kind, values in (
        ("sum", pad.sum_count),
        ("peak", pad.peak_count),
        ("active", pad.num_active),
    ):
        path = f"touch/{kind}/{pad.name}"
        log.static(path, rr.SeriesLines(colors=color, names=name, widths=width))
        log.send(path, rr.Scalars.columns(scalars=values.astype(float)))


def log_events(log: EpisodeLog, pads: list[Pad]) -> None:
    """Log events as one lane each: contact gate, stage, success; a state is logged only when it changes. ``pads`` are those of
    the contact gate."""
    episode = log.episode
    if pads:
        gate = contact_gate(pads)
        rows = [0, *(np.flatnonzero(np.diff(gate)) + 1)]
        states = ["contact" if gate[row] else "no contact" for row in rows]
        _log_lane(
            log,
            "contact gate",
            rows,
            states,
            {"contact": 0xDC2626FF, "no contact": 0x475569FF},
        )
    if episode.stages:
        names = [name for _, name in episode.stages]
        colors = {
            name: EVENT_COLORS[i % len(EVENT_COLORS)]
            for i, name in enumerate(dict.fromkeys(names))
        }
        _log_lane(log, "stage", [row for row, _ in episode.stages], names, colors)
    if episode.success is not None:
        word = "success" if episode.success else "failure"
        _log_lane(
            log, "outcome", [0], [word], {"success": 0x16A34AFF, "failure": 0xB91C1CFF}
        )


def _log_lane(
    log: EpisodeLog,
    lane: str,
    rows: Sequence[int],
    states: list[str],
    colors: dict[str, int],
) -> None:
    path = f"events/{lane.replace(' ', '_')}"
    names = list(colors)
    log.static(
        path,
        rr.StateConfiguration(
            values=names,
            labels=names,
            colors=np.array(list(colors.values()), np.uint32),
        ),
    )
    log.send(path, rr.StateChange.columns(state=states), rows)
