"""An episode made by arithmetic: two arms close their grippers on something for a while. Every number is known beforehand.

Contact begins at 40 % and ends at 80 % of the episode; its peak is at 60 %. Nothing here is a robot, and it says so.
"""

import dataclasses
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np

from taccorl.data.episode import ChannelTiming, Episode, Pictures, Video
from taccorl.data.origin import Origin
from taccorl.data.spec import DatasetSpec, data_specs_folder, load_dataset_spec

os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder is talkative
ORIGIN = Origin("surrogate", "made by tests/views, not a robot")
TOUCH = "observation.tactile"
HOME_RAD = np.array([0.0, 1.35, -1.30, 0.0, 0.85, 0.0])
CAMERA_COLORS = {
    "front": (230, 150, 60),
    "left_wrist": (70, 190, 130),
    "right_wrist": (80, 130, 240),
}


def bimanual_spec(picture_size: int = 224) -> DatasetSpec:
    """The shipped spec without its optional window, with small pictures for speed where asked for."""
    spec = load_dataset_spec(data_specs_folder() / "taccorl_bimanual.yaml")
    features = {key: f for key, f in spec.features.items() if not f.optional}
    for key, feature in features.items():
        if feature.dtype == "video":
            features[key] = dataclasses.replace(
                feature, shape=(picture_size, picture_size, 3)
            )
    sensors = {key: s for key, s in spec.sensors.items() if key in features}
    return dataclasses.replace(spec, features=features, sensors=sensors)


def grip(num_rows: int) -> np.ndarray:
    """(T,) 0 … 1: how firmly something is held."""
    return np.clip(1.0 - np.abs(np.linspace(0.0, 1.0, num_rows) - 0.6) / 0.2, 0.0, 1.0)


def touch_counts(num_rows: int) -> np.ndarray:
    """(T, 4, 32, 12) int16: a stripe of 120 counts at full grip on the right pads, a patch of 80 on the left ones; noise ±6."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[0:32, 0:12].astype(float)
    stripe = (
        120 * np.exp(-0.5 * ((column - 5.5) / 1.3) ** 2) / (1 + np.exp((9 - row) / 0.8))
    )
    patch = 80.0 * ((row > 15) & (column > 1) & (column < 10))
    pads = np.stack([patch, patch[:, ::-1], stripe, stripe[:, ::-1]])
    noise = rng.integers(-6, 7, size=(num_rows, 4, 32, 12))
    return np.round(grip(num_rows)[:, None, None, None] * pads + noise).astype(np.int16)


def joints(num_rows: int, fps: int) -> np.ndarray:
    """(T, 14) rad and m: a slow reach of both arms; the grippers go from 65 mm to 20 mm as they grip."""
    time_s = np.arange(num_rows) / fps
    reach = np.sin(np.pi * np.linspace(0.0, 1.0, num_rows))[:, None]
    arm = (
        HOME_RAD
        + reach * np.array([0.35, 0.35, -0.15, 0.1, 0.15, 0.3])
        + 0.01 * np.sin(5 * time_s)[:, None]
    )
    opening_m = (0.065 - 0.045 * np.clip(2 * grip(num_rows), 0, 1))[:, None]
    mirrored = arm * np.array([-1, 1, 1, -1, 1, -1])
    return np.concatenate([mirrored, opening_m, arm, opening_m], axis=1).astype(
        np.float32
    )


def draw(key: str, row: int, num_rows: int, size: int) -> np.ndarray:
    """(size, size, 3) uint8: a table, two grippers that meet, and the row's number."""
    camera = key.rsplit(".", 1)[1]
    image = np.zeros((size, size, 3), np.uint8)
    image[: size // 3] = (58, 66, 78)
    image[size // 3 :] = (176, 158, 136)
    reach = np.sin(np.pi * row / max(num_rows - 1, 1))
    x, y, r = int(size * (0.15 + 0.28 * reach)), int(size * 0.6), size // 10
    color = CAMERA_COLORS.get(camera, (200, 200, 200))
    cv2.rectangle(
        image,
        (size // 2 - r // 2, y - r),
        (size // 2 + r // 2, y + 2 * r),
        (200, 60, 60),
        -1,
    )
    cv2.circle(image, (x, y), r, color, -1, cv2.LINE_AA)
    cv2.circle(image, (size - x, y), r, color, -1, cv2.LINE_AA)
    cv2.putText(
        image,
        str(row),
        (4, size // 8),
        cv2.FONT_HERSHEY_SIMPLEX,
        size / 320,
        (255, 255, 255),
        1,
        cv2.LINE_AA,
    )
    return image


def pictures_of(
    keys: tuple[str, ...], num_rows: int, size: int
) -> Callable[[], Iterator[Pictures]]:
    """What ``Episode.pictures`` wants."""

    def stream() -> Iterator[Pictures]:
        for row in range(num_rows):
            yield {key: draw(key, row, num_rows, size) for key in keys}

    return stream


def made_episode(num_rows: int = 120, picture_size: int = 224) -> Episode:
    """As if cut from a recording: pictures, no video files."""
    spec = bimanual_spec(picture_size)
    keys = tuple(spec.keys("video"))
    state = joints(num_rows, spec.fps)
    return Episode(
        name="made.mcap, episode 0",
        spec=spec,
        start_ns=1_700_000_000_000_000_000,
        arrays={
            "observation.state": state,
            "action": np.concatenate([state[3:], np.repeat(state[-1:], 3, axis=0)]),
            TOUCH: touch_counts(num_rows).reshape(num_rows, -1),
        },
        pictures=pictures_of(keys, num_rows, picture_size),
        picture_keys=keys,
        instruction="put the test tube into the rack",
        success=True,
        origin=ORIGIN,
        timing=tuple(
            ChannelTiming(channel, feature, "asof", rate, gaps, longest, median, worst)
            for channel, feature, rate, gaps, longest, median, worst in (
                ("left_state", "observation.state", 200.0, 0, 0.005, 0.002, 0.005),
                ("front", "observation.images.front", 29.97, 1, 0.067, 0.016, 0.049),
                ("left_a", TOUCH, 99.6, 0, 0.011, 0.005, 0.010),
            )
        ),
        baselines={TOUCH: np.full(1536, 22, np.int16)},
        stages=(
            (0, "reach"),
            (int(0.4 * num_rows), "hold"),
            (int(0.8 * num_rows), "release"),
        ),
    )


def without(episode: Episode, *keys: str) -> Episode:
    """The same episode as a robot without these features would have left it."""
    spec = episode.spec
    spec = dataclasses.replace(
        spec,
        features={k: f for k, f in spec.features.items() if k not in keys},
        sensors={k: s for k, s in spec.sensors.items() if k not in keys},
    )
    picture_keys = tuple(k for k in episode.picture_keys if k not in keys)
    return dataclasses.replace(
        episode,
        spec=spec,
        arrays={k: a for k, a in episode.arrays.items() if k not in keys},
        picture_keys=picture_keys,
        pictures=lambda: ({k: p[k] for k in picture_keys} for p in episode.pictures()),
        baselines={k: b for k, b in episode.baselines.items() if k not in keys},
        videos={k: v for k, v in episode.videos.items() if k not in keys},
    )


def write_mp4(
    path: Path,
    images: Iterator[np.ndarray],
    *,
    fps: int,
    codec: str,
    options: dict[str, str] | None = None,
) -> None:
    """As LeRobot writes it unless told otherwise: ``libsvtav1`` or ``h264``, a keyframe every 2 frames, yuv420p."""
    options = {"g": "2", "crf": "30"} | (options or {})
    if codec == "libsvtav1":
        options |= {"preset": "12", "svtav1-params": "lp=1"}
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=fps, options=options)
        for image in images:
            stream.height, stream.width, stream.pix_fmt = (
                image.shape[0],
                image.shape[1],
                "yuv420p",
            )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))
    path.write_bytes(buffer.getvalue())
    if (
        os.geteuid() == 0
    ):  # SVT-AV1 has made this thread real-time: see taccorl/views/viewer.py
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def in_dataset(
    episode: Episode, folder: Path, *, codec: str = "libsvtav1", rows_before: int = 7
) -> Episode:
    """The episode as a dataset holds it: in the middle of a longer mp4, from an odd frame on (not a keyframe)."""
    videos = {}
    for key in episode.picture_keys:
        path = folder / f"{key}.mp4"
        own = [pictures[key] for pictures in episode.pictures()]
        other = np.full_like(own[0], 255)
        images = [other] * rows_before + own + [other] * 5
        write_mp4(path, iter(images), fps=episode.spec.fps, codec=codec)
        videos[key] = Video(path, rows_before / episode.spec.fps, episode.num_rows)
    return dataclasses.replace(episode, videos=videos, picture_rows={})
