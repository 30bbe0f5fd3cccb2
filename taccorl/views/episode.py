"""Write an episode for Rerun, column by column: pictures, touch, states, commands, events and provenance.

    /observation/images/<camera>     pictures: the dataset's own mp4 packets, or JPEG where there is no mp4 (a recording)
    /observation/tactile/<pad>       heatmaps, counts above baseline, one fixed colour scale
    /observation/state/<group>, /action/<group>, and every other feature of a few numbers
    /touch/{sum,peak,active}/<pad>, /touch/…/<line>
    /events/{contact_gate,outcome,stage}
    /figure                          the arms in 3-D
    /provenance                      what it is, where it is from, how its samples met its rows

Time lines: ``time`` (seconds since row 0) and ``frame_index``. ``blueprint.py`` arranges the views.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import rerun as rr

from taccorl.data.episode import Episode
from taccorl.data.spec import SensorSpec
from taccorl.views.blueprint import episode_blueprint, heatmap_places
from taccorl.views.colors import CONTACT_COLOR, HEATMAP, LINE_COLORS, NOISE_COLOR, PAD_COLORS
from taccorl.views.figure import log_figure
from taccorl.views.groups import groups_of, short_name, vector_keys
from taccorl.views.outputs import check_free, replacing
from taccorl.views.provenance import provenance
from taccorl.views.rrd import recording_to
from taccorl.views.touch import Pad, contact_gate, pads_of
from taccorl.views.video import Clip, cut
from taccorl.views.viewer import can_decode

JPEG_QUALITY = 90
PICTURES_AT_ONCE = 64  # rows; more would only hold more decoded pictures
EVENT_COLORS = (0x2563EBFF, 0x0D9488FF, 0xCA8A04FF, 0x9333EAFF, 0xDB2777FF, 0x65A30DFF)


def log_episode(rec: rr.RecordingStream, episode: Episode, *, native: bool = False) -> None:
    """Log all data of the episode; missing features are left out.

    Args:
        native: for the Rerun program on this machine: a video that it cannot decode here is logged as JPEG pictures.

    Raises:
        DatasetError: a video file that is not what the dataset says.
    """
    indexes = time_columns(episode)
    rec.send_recording_name(episode.name)
    document = rr.TextDocument(provenance(episode), media_type=rr.MediaType.MARKDOWN)
    rec.log("provenance", document, static=True)
    clips = {key: cut(episode.videos[key], episode.spec.fps) for key in episode.picture_keys if key in episode.videos}
    if native:
        clips = {key: clip for key, clip in clips.items() if can_decode(clip.codec)}
    for key, clip in clips.items():
        _log_video(rec, episode, key, clip, indexes)
    _log_pictures(rec, episode, [key for key in episode.picture_keys if key not in clips])
    for key in vector_keys(episode):
        _log_vector(rec, episode, key, indexes)
    pads = pads_of(episode)
    if pads:
        _log_heatmaps(rec, pads, indexes)
        _log_touch(rec, pads, indexes)
    _log_events(rec, episode, pads)
    log_figure(rec, episode, pads, indexes)


def save_episode(episode: Episode, rrd: Path, *, at_s: float | None = None, native: bool = False) -> None:
    """The episode and its blueprint as one .rrd file; ``at_s`` as in ``episode_blueprint``, ``native`` as above.

    Raises:
        OutputError: ``rrd`` is somebody else's file, or the disk is full.
    """
    check_free(rrd)
    with replacing(rrd) as part, recording_to(part, episode_blueprint(episode, at_s=at_s)) as rec:
        log_episode(rec, episode, native=native)


def time_columns(episode: Episode, rows: Sequence[int] | None = None) -> list[rr.TimeColumn]:
    """Both time lines, for all rows or some."""
    rows = range(episode.num_rows) if rows is None else rows
    index = np.asarray(rows, dtype=np.int64)
    time_ns = np.round(1e9 * episode.time_s[index]).astype("timedelta64[ns]")  # Rerun itself would round down
    return [rr.TimeColumn("time", duration=time_ns), rr.TimeColumn("frame_index", sequence=index)]


def _log_video(rec: rr.RecordingStream, episode: Episode, key: str, clip: Clip, indexes: list[rr.TimeColumn]) -> None:
    asset = rr.AssetVideo(contents=clip.mp4, media_type="video/mp4")
    path = f"observation/images/{short_name(key)}"
    rec.log(path, asset, static=True)
    frames_ns = asset.read_frame_timestamps_nanos()[clip.first_frame :][: episode.num_rows]
    rr.send_columns(path, indexes, rr.VideoFrameReference.columns_nanos(frames_ns), recording=rec)


def _log_pictures(rec: rr.RecordingStream, episode: Episode, keys: list[str]) -> None:
    if not keys:
        return
    for batch in itertools.batched(enumerate(episode.pictures()), PICTURES_AT_ONCE):
        indexes = time_columns(episode, [row for row, _ in batch])
        for key in keys:
            blobs = [_jpeg(pictures[key]) for _, pictures in batch]
            columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
            rr.send_columns(f"observation/images/{short_name(key)}", indexes, columns, recording=rec)


def _jpeg(rgb: np.ndarray) -> bytes:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _log_vector(rec: rr.RecordingStream, episode: Episode, key: str, indexes: list[rr.TimeColumn]) -> None:
    """State: thick; action: the same colours, thin and pale."""
    is_action = key == "action"
    for group in groups_of(episode.spec.features[key]):
        path = f"{key.replace('.', '/')}/{group.path}"
        colors = [LINE_COLORS[i % len(LINE_COLORS)] for i in range(len(group.columns))]
        style = rr.SeriesLines(  # same names: the legend lists a joint once
            colors=[(*c, 130) if is_action else c for c in colors],
            widths=[1.0 if is_action else 2.0] * len(colors),
            names=group.labels,
        )
        rec.log(path, style, static=True)
        values = episode.arrays[key][:, list(group.columns)]
        rr.send_columns(path, indexes, rr.Scalars.columns(scalars=values), recording=rec)


def _log_heatmaps(rec: rr.RecordingStream, pads: list[Pad], indexes: list[rr.TimeColumn]) -> None:
    """The pads side by side, each with its name, and the colour scale. Negative counts are drawn as 0; the dataset keeps them."""
    places = heatmap_places(pads)
    for i, pad in enumerate(pads):
        image = np.clip(pad.counts, 0, pad.sensor.max_count).astype(
            np.uint8 if pad.sensor.max_count <= 255 else np.uint16
        )
        path = f"observation/tactile/{pad.name}"
        _place(rec, path, places[pad.name])
        rec.log(path, _heatmap_style(pad.sensor, image[0]), static=True)
        buffers = rr.DepthImage.columns(buffer=image.reshape(len(image), -1).view(np.uint8))
        rr.send_columns(path, indexes, buffers, recording=rec)
        _text(rec, f"{path}/name", pad.sensor.columns / 2, -3.5, pad.name, PAD_COLORS[i % len(PAD_COLORS)])
    sensor = max((pad.sensor for pad in pads), key=lambda s: s.max_count)
    bar = np.repeat(np.linspace(sensor.max_count, 0, 4 * sensor.rows).astype(np.uint16)[:, None], 8, axis=1)
    path = "observation/tactile/scale"
    _place(rec, path, places["scale"], scale=0.25)
    rec.log(path, _heatmap_style(sensor, bar), static=True)
    rec.log(path, rr.DepthImage.from_fields(buffer=bar.tobytes()), static=True)
    for count, text in (
        (sensor.noise_count, f"noise floor {sensor.noise_count:g}"),
        (pads[0].gate_count, f"contact {pads[0].gate_count:.3g}"),
        (sensor.max_count / 2, f"{sensor.max_count / 2:g}"),
        (sensor.max_count, f"{sensor.max_count}"),
    ):
        y = bar.shape[0] * (1 - count / sensor.max_count)
        _text(rec, f"{path}/{text.split()[0]}", 12 + 2.0 * len(text), y - 5, text, NOISE_COLOR)


def _place(rec: rr.RecordingStream, path: str, x: float, scale: float = 1.0) -> None:
    rec.log(path, rr.Transform3D(translation=(x, 0.0, 0.0), scale=scale), static=True)


def _text(rec: rr.RecordingStream, path: str, x: float, y: float, text: str, color: tuple[int, int, int]) -> None:
    point = rr.Points2D([(x, y)], labels=[text], colors=[color], radii=0.001, show_labels=True)
    rec.log(path, point, static=True)


def _heatmap_style(sensor: SensorSpec, image: np.ndarray) -> rr.DepthImage:
    """Everything but the counts."""
    rows, columns = image.shape
    kind = rr.ChannelDatatype.from_np_dtype(image.dtype)
    return rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(width=columns, height=rows, channel_datatype=kind),
        meter=1.0,
        colormap=HEATMAP,
        depth_range=(0.0, float(sensor.max_count)),
        magnification_filter="nearest",
    )


def _log_touch(rec: rr.RecordingStream, pads: list[Pad], indexes: list[rr.TimeColumn]) -> None:
    for i, pad in enumerate(pads):
        for name, values in (("sum", pad.sum_count), ("peak", pad.peak_count), ("active", pad.num_active)):
            path = f"touch/{name}/{pad.name}"
            rec.log(
                path, rr.SeriesLines(colors=PAD_COLORS[i % len(PAD_COLORS)], names=pad.name, widths=1.5), static=True
            )
            columns = rr.Scalars.columns(scalars=values.astype(float))
            rr.send_columns(path, indexes, columns, recording=rec)
    for sensor, gate_count in {pad.sensor.name: (pad.sensor, pad.gate_count) for pad in pads}.values():
        for name, count, color in (
            (f"noise floor {sensor.noise_count:g}", sensor.noise_count, NOISE_COLOR),
            (f"contact {gate_count:.3g}", gate_count, CONTACT_COLOR),
        ):
            path = f"touch/peak/{name.replace(' ', '_').replace('.', '_')}"
            rec.log(path, rr.SeriesLines(colors=color, names=name, widths=1.0), static=True)
            values = np.full(len(pads[0].counts), float(count))
            rr.send_columns(path, indexes, rr.Scalars.columns(scalars=values), recording=rec)


def _log_events(rec: rr.RecordingStream, episode: Episode, pads: list[Pad]) -> None:
    """One lane each: contact gate, stage, success; a new state only where it changes."""
    if pads:
        gate = contact_gate(pads)
        rows = [0, *(np.flatnonzero(np.diff(gate)) + 1)]
        states = ["contact" if gate[row] else "no contact" for row in rows]
        _log_lane(rec, episode, "contact gate", rows, states, {"contact": 0xDC2626FF, "no contact": 0x475569FF})
    if episode.stages:
        names = [name for _, name in episode.stages]
        colors = {name: EVENT_COLORS[i % len(EVENT_COLORS)] for i, name in enumerate(dict.fromkeys(names))}
        _log_lane(rec, episode, "stage", [row for row, _ in episode.stages], names, colors)
    if episode.success is not None:
        word = "success" if episode.success else "failure"
        _log_lane(rec, episode, "outcome", [0], [word], {"success": 0x16A34AFF, "failure": 0xB91C1CFF})


def _log_lane(
    rec: rr.RecordingStream, episode: Episode, lane: str, rows: Sequence[int], states: list[str], colors: dict[str, int]
) -> None:
    path = f"events/{lane.replace(' ', '_')}"
    names = list(colors)
    rec.log(
        path,
        rr.StateConfiguration(values=names, labels=names, colors=np.array(list(colors.values()), np.uint32)),
        static=True,
    )
    columns = rr.StateChange.columns(state=states)
    rr.send_columns(path, time_columns(episode, rows), columns, recording=rec)
