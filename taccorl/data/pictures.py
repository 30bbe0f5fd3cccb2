"""Pictures of decoded messages, as (rows, columns, 3) uint8 RGB: compressed, raw, stored as arrays, or frames of a video.

What cannot become 8-bit colours without a loss (depth, 16 bits, floats, transparent pixels) is refused, never converted.
"""

from typing import Any

import numpy as np

from taccorl.data.decode import from_base64, get, maybe
from taccorl.data.h264 import FrameNumbers
from taccorl.data.spec import ChannelSpec
from taccorl.errors import RecordingError, nearest
from taccorl.extras import OnUse

av, cv2 = OnUse("av"), OnUse("cv2")
VIDEO_CODECS = {
    "h264": "h264",
    "h265": "hevc",
    "hevc": "hevc",
    "av1": "av1",
    "vp9": "vp9",
}
"""Format of a message that holds one frame of a video → FFmpeg's name of the codec."""
PACKED = {
    "rgb8": 3,
    "bgr8": 3,
    "rgba8": 4,
    "bgra8": 4,
    "8UC3": 3,
    "8UC4": 4,
    "mono8": 1,
    "8UC1": 1,
}
"""Encoding of a raw picture that holds its colours as they are → values per pixel (sensor_msgs/image_encodings.hpp)."""
CONVERTED = (
    dict.fromkeys(("yuv422", "uyvy"), (2, "COLOR_YUV2RGB_UYVY"))
    | dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "COLOR_YUV2RGB_YUY2"))
    | {
        "bayer_rggb8": (1, "COLOR_BayerRGGB2RGB"),
        "bayer_bggr8": (1, "COLOR_BayerBGGR2RGB"),
    }
    | {
        "bayer_gbrg8": (1, "COLOR_BayerGBRG2RGB"),
        "bayer_grbg8": (1, "COLOR_BayerGRBG2RGB"),
    }
    | {"nv12": (1, "COLOR_YUV2RGB_NV12"), "nv21": (1, "COLOR_YUV2RGB_NV21")}
)
"""Encoding of a raw picture that OpenCV converts → bytes per pixel of its first plane, and the name of OpenCV's conversion."""
HALF_PLANE = ("nv12", "nv21")  # Encodings with a second plane of half as many rows
DEEP = (
    "16UC1",
    "mono16",
    "16SC1",
    "32FC1",
    "64FC1",
    "rgb16",
    "bgr16",
    "rgba16",
    "bgra16",
    "16UC3",
    "32FC3",
)
NO_DEPTH = "depth and pictures of more than 8 bits are not read: leave its channel out"
UNORDERED = ("8UC3", "8UC4")  # Encodings that do not state the order of their colours


def picture(value: Any, channel: ChannelSpec) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB of a compressed or raw picture, or of a stored array. Raises RecordingError: damaged, or a
    picture that is not read, with the reason."""
    rgb = _rgb(value, channel)
    return (
        rgb if channel.channel_order == "rgb" else np.ascontiguousarray(rgb[..., ::-1])
    )


def is_stream(value: Any) -> bool:
    """Whether a message holds a frame of a video, which earlier messages are needed to decode."""
    return (
        not isinstance(value, bytes | np.ndarray)
        and str(maybe(value, "format")).lower() in VIDEO_CODECS
    )


def _rgb(value: Any, channel: ChannelSpec) -> np.ndarray:
    """RGB as far as the encoding states the order of the colours."""
    if isinstance(value, np.ndarray) and value.ndim != 1:
        return _stored(value)
    data = (
        value
        if isinstance(value, bytes | np.ndarray)
        else get(value, channel.field or "data")
    )
    if isinstance(data, str):
        data = from_base64(data)
    elif isinstance(data, bytes | bytearray | memoryview) or (
        isinstance(data, np.ndarray) and data.dtype == np.uint8
    ):
        data = bytes(data)
    else:
        raise RecordingError(
            f"a picture as {type(data).__name__}; only bytes, or base64 text in JSON, are supported"
        )
    encoding = maybe(value, "encoding")
    if encoding is not None:
        if channel.channel_order == "bgr" and encoding not in UNORDERED:
            text = f"its encoding {str(encoding)!r} states the order of the colours: `channel_order: bgr` has no "
            raise RecordingError(f"{text}effect, remove it")
        return _raw(value, data, str(encoding))
    if is_stream(value):
        raise RecordingError(
            f"a frame of {maybe(value, 'format')} that does not decode, or refers to one that was lost before it"
        )
    return _compressed(data, str(maybe(value, "format")))


def _compressed(data: bytes, form: str) -> np.ndarray:
    what = f"a picture of format {form!r}"
    if "compresseddepth" in form.lower():
        raise RecordingError(f"{what}: {NO_DEPTH}")
    # A picture is never turned by its EXIF note: the camera's frame is the pixel grid (IMREAD_UNCHANGED turns none).
    is_jpeg = data.startswith(b"\xff\xd8")
    flags = (
        cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        if is_jpeg
        else cv2.IMREAD_UNCHANGED
    )
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # no bytes, or a header that claims an absurd size
        decoded = None
    if decoded is None:
        raise RecordingError(
            f"{what} that OpenCV cannot decode (jpeg and png are supported)"
        )
    if decoded.dtype != np.uint8:
        raise RecordingError(f"{what} with {decoded.dtype} values: {NO_DEPTH}")
    if decoded.ndim == 2:
        return np.repeat(decoded[..., None], 3, axis=2)
    _check_opaque(decoded, what)
    return cv2.cvtColor(decoded[..., :3], cv2.COLOR_BGR2RGB)


def _check_opaque(pixels: np.ndarray, what: str) -> None:
    if pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        raise RecordingError(
            f"{what} with transparent pixels, of unknown colours; store it without alpha channel"
        )


def _stored(array: np.ndarray) -> np.ndarray:
    """RGB of an array with rows first, or with colours first as PyTorch has them."""
    what = f"a picture of {array.dtype} {array.shape}"
    if array.dtype != np.uint8:
        raise RecordingError(
            f"{what}: only uint8 is read; {NO_DEPTH}, or store 0 … 255 as uint8"
        )
    array = array[..., None] if array.ndim == 2 else array
    if (
        array.ndim == 3
        and array.shape[2] not in (1, 3, 4)
        and array.shape[0] in (1, 3, 4)
    ):
        array = array.transpose(1, 2, 0)
    elif (
        array.ndim != 3
        or array.shape[2] not in (1, 3, 4)
        or (array.shape[2] != 3 and array.shape[0] in (1, 3, 4))
    ):
        raise RecordingError(
            f"{what}; (rows, columns), (rows, columns, 1, 3 or 4) and (3, rows, columns) are read"
        )
    _check_opaque(array, what)
    return (
        np.repeat(array, 3, axis=2)
        if array.shape[2] == 1
        else np.ascontiguousarray(array[..., :3])
    )


def _raw(value: Any, data: bytes, encoding: str) -> np.ndarray:
    if encoding in DEEP:
        raise RecordingError(f"a raw picture with encoding {encoding!r}: {NO_DEPTH}")
    depth, conversion = CONVERTED.get(encoding, (PACKED.get(encoding, 0), None))
    if not depth:
        known = nearest(encoding, [*PACKED, *CONVERTED])
        raise RecordingError(
            f"raw pictures with encoding {encoding!r} are not supported; {known}"
        )
    try:
        rows, columns = int(get(value, "height")), int(get(value, "width"))
        step = int(maybe(value, "step") or columns * depth)
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"a raw picture without whole numbers for its size: {error}"
        ) from error
    what = f"a raw picture of {rows}×{columns} {encoding} pixels"
    if min(rows, columns) <= 0 or step < columns * depth:
        raise RecordingError(f"{what} with {step} bytes per row")
    lines = rows * 3 // 2 if encoding in HALF_PLANE else rows
    if len(data) < lines * step:
        raise RecordingError(f"{len(data)} bytes for a picture of {lines}×{step} bytes")
    pixels = np.frombuffer(data, np.uint8, lines * step).reshape(lines, step)[
        :, : columns * depth
    ]
    pixels = np.ascontiguousarray(pixels.reshape(lines, columns, depth))
    if conversion is not None:
        try:
            return cv2.cvtColor(
                pixels[..., 0] if depth == 1 else pixels, getattr(cv2, conversion)
            )
        except cv2.error as error:  # an odd number of rows or columns
            raise RecordingError(f"{what}: {error.err}") from error
    if depth == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(
        pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3]
    )


class VideoStream:
    """Decodes the messages of one topic, each with one frame of a video without frames that refer to later ones."""

    def __init__(self, form: str) -> None:
        """``form``: a key of ``VIDEO_CODECS``."""
        self._codec: Any = av.CodecContext.create(VIDEO_CODECS[form.lower()], "r")
        self._codec.thread_count = 1  # a frame comes out when its message goes in
        self._messages: dict[int, Any] = {}
        self._number = 0
        self._numbers = FrameNumbers() if VIDEO_CODECS[form.lower()] == "h264" else None
        self._remains: set[int] = set()
        """Numbers of messages whose frames may show remains of one that was lost."""

    def decode(
        self, message: Any, data: bytes | str | None
    ) -> list[tuple[Any, np.ndarray | None]]:
        """Take in the next message, any object that stands for it; return messages whose frames are decoded by now, each with
        its (rows, columns, 3) uint8 RGB, or None if it does not decode, or refers to a frame of H.264 that was lost. ``data``:
        its bytes, or base64 text; None: the last message was taken in."""
        packet = None
        if data is not None:
            try:
                packet = av.Packet(
                    from_base64(data) if isinstance(data, str) else bytes(data)
                )
            except RecordingError:
                return [(message, None)]
            if self._numbers is not None and self._numbers.take(bytes(packet)):
                self._remains.add(self._number)
            packet.pts = packet.dts = self._number
            self._messages[self._number] = message
            self._number += 1
        try:
            frames = self._codec.decode(packet)
        except (av.error.FFmpegError, ValueError):
            if packet is not None:
                return [(self._messages.pop(self._number - 1), None)]
            frames = []
        if self._numbers is not None and any(frame.key_frame for frame in frames):
            self._numbers.broken = False  # also of a key frame that is no IDR picture
            self._remains.clear()
        found: list[tuple[Any, np.ndarray | None]] = [
            (
                self._messages.pop(frame.pts),
                None
                if frame.is_corrupt or frame.pts in self._remains
                else frame.to_ndarray(format="rgb24"),
            )
            for frame in frames
            if frame.pts in self._messages
        ]
        return found + (
            [(m, None) for m in self._messages.values()] if data is None else []
        )


def letterbox(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """``image`` (h, w, 3) uint8 scaled to fit (rows, columns, 3) with its aspect kept, black bars around it (as π0.5 pads)."""
    height, width = image.shape[:2]
    if (height, width) == (rows, columns):
        return image
    factor = min(rows / height, columns / width)
    inner = (max(1, round(height * factor)), max(1, round(width * factor)))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    out = np.zeros((rows, columns, 3), np.uint8)
    top, left = (rows - inner[0]) // 2, (columns - inner[1]) // 2
    out[top : top + inner[0], left : left + inner[1]] = cv2.resize(
        image, inner[::-1], interpolation=method
    )
    return out
