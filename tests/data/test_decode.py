"""Decoding: numbers by name in any order, pad frames in the pad's own order, pictures to the pixel, and no silent guesses."""

import base64
import dataclasses
import zlib
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from taccorl.data import decode, pictures
from taccorl.data.sensor_spec import SensorSpec, load_sensor_spec
from taccorl.data.spec import ChannelSpec, data_specs_folder
from taccorl.errors import RecordingError

FLEXITAC = load_sensor_spec(data_specs_folder() / "sensors" / "flexitac_v2.yaml")
NAMES = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper"]


def channel(**options: Any) -> ChannelSpec:
    return ChannelSpec(topic="/t", rate_hz=100.0, **options)


def sensor(
    rows: int,
    columns: int,
    *,
    dtype: Any = "uint8",
    transpose: bool = False,
    adc_bits: int = 8,
) -> SensorSpec:
    on_wire = (
        {"rows": columns, "columns": rows}
        if transpose
        else {"rows": rows, "columns": columns}
    )
    wire = dataclasses.replace(
        FLEXITAC.wire, **on_wire, dtype=dtype, transpose=transpose
    )
    bits = {"adc_bits": adc_bits, "wire_shift_bits": 0}
    return dataclasses.replace(
        FLEXITAC, name="pad", rows=rows, columns=columns, wire=wire, **bits
    )


def joints(names: list[str], position: list[float], **more: Any) -> SimpleNamespace:
    """sensor_msgs/JointState as mcap_ros2 decodes it: attributes and lists."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=34), frame_id="")
    return SimpleNamespace(header=header, name=names, position=position, **more)


# --- names


def test_numbers_in_names_sort_as_numbers():
    assert sorted(["e_10", "e_9", "e_2", "e"], key=decode.natural_key) == [
        "e",
        "e_2",
        "e_9",
        "e_10",
    ]
    assert sorted(["10", "9", "a1", "1a", "²", "x²3"], key=decode.natural_key)[:3] == [
        "1a",
        "9",
        "10",
    ]


def test_a_type_is_the_same_with_and_without_msg_in_the_middle():
    assert decode.type_key("sensor_msgs/msg/JointState") == decode.type_key(
        "sensor_msgs/JointState"
    )
    assert decode.type_key("sensor_msgs/msg/JointState") != decode.type_key(
        "sensor_msgs/msg/Joy"
    )


def test_a_missing_field_names_the_nearest():
    for value in (
        SimpleNamespace(package=1, syntax=2),
        {"package": 1, "syntax": 2},
        FileDescriptorProto(),
    ):
        with pytest.raises(
            RecordingError, match="no field 'pakage'; did you mean 'package'"
        ):
            decode.get(value, "pakage")


# --- stamps


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (joints([], []), 12 * 10**9 + 34),
        (
            {"header": {"stamp": {"sec": 1_700_000_000, "nanosec": 999_999_999}}},
            1_700_000_000_999_999_999,
        ),
        ({"header": {"stamp": {"sec": 1, "nsec": 2}}}, 1_000_000_002),
        ({"header": {"stamp": {"secs": 1, "nsecs": 2}}}, 1_000_000_002),
        ({"timestamp": {"seconds": 3, "nanos": 4}}, 3_000_000_004),
        (SimpleNamespace(timestamp=SimpleNamespace(sec=3, nanosec=4)), 3_000_000_004),
        ({"header": {"stamp": {"sec": 0, "nanosec": 0}}}, 0),
        ({"data": [1]}, None),
        ([1, 2], None),
        (3.5, None),
        ({"header": {"stamp": 12.5}}, None),
        ({"header": {"stamp": {"sec": "soon", "nanosec": 0}}}, None),
        (
            {"timestamp": {"seconds": 10**12, "nanos": 0}},
            None,
        ),  # 31,709 years: no time that int64 nanoseconds can hold
        ({"timestamp": {"sec": float("inf"), "nsec": 0}}, None),
        ({"timestamp": "2025-10-09T08:53:20Z"}, 1_760_000_000_000_000_000),
        (
            {"header": {"stamp": "2025-10-09T08:53:20.123456789Z"}},
            1_760_000_000_123_456_789,
        ),
        ({"timestamp": "2025-10-09 08:53:20.5"}, 1_760_000_000_500_000_000),
        ({"timestamp": "2025-10-09T10:53:20.25+02:00"}, 1_760_000_000_250_000_000),
        ({"timestamp": "2025-13-09T10:53:20Z"}, None),
        ({"header": {"stamp": "yesterday"}}, None),
    ],
)
def test_stamps_of_every_kind_of_header(value, expected):
    assert decode.stamp_ns(value) == expected


# --- texts


@pytest.mark.parametrize("value", ["go", {"data": "go"}, SimpleNamespace(data="go")])
def test_a_text_is_read_from_a_string_or_its_data(value):
    assert decode.text(value, "/episode") == "go"


@pytest.mark.parametrize(
    "value", [{"data": 3}, {"text": "go"}, SimpleNamespace(), 4, None, {"data": b"go"}]
)
def test_anything_else_is_no_text_and_names_the_topic(value):
    with pytest.raises(
        RecordingError, match=r"^/episode: expected a text \(std_msgs/String\), found "
    ):
        decode.text(value, "/episode")


# --- vectors


def test_joints_are_picked_by_name_in_any_order():
    extract = decode.VectorExtractor(
        channel(field="position", pick=("joint1", "joint2", "gripper"))
    )
    assert extract(joints(["joint1", "joint2", "gripper"], [1, 2, 3])).tolist() == [
        1,
        2,
        3,
    ]
    assert extract(
        joints(["gripper", "spare", "joint2", "joint1"], [3, 9, 2, 1])
    ).tolist() == [1, 2, 3]
    assert extract(
        {"name": ["joint2", "joint1", "gripper"], "position": [2, 1, 3]}
    ).tolist() == [1, 2, 3]


def test_scale_multiplies_after_picking_and_must_fit_the_values():
    extract = decode.VectorExtractor(
        channel(field="position", pick=("gripper", "joint1"), scale=(0.001, 2.0))
    )
    assert extract(joints(["joint1", "gripper"], [10.0, 70.0])).tolist() == [0.07, 20.0]
    one_for_all = decode.VectorExtractor(channel(field="position", scale=(2.0,)))
    assert one_for_all(joints([], [1, 2, 3])).tolist() == [2, 4, 6]
    with pytest.raises(RecordingError, match=r"3 values,.*spec.*2"):
        decode.VectorExtractor(channel(field="p", scale=(1.0, 2.0)))({"p": [1, 2, 3]})


def test_names_that_do_not_fit_their_values_or_the_spec_are_refused():
    message = joints(NAMES, [0.0] * 7, velocity=[0.1] * 6)
    extract = decode.VectorExtractor(channel(field="velocity", pick=("joint1",)))
    with pytest.raises(RecordingError, match="6 values for 7 names in 'velocity'"):
        extract(message)
    with pytest.raises(RecordingError, match="8 values for 7 names"):
        decode.VectorExtractor(channel(field="position", pick=("joint1",)))(
            joints(NAMES, [0.0] * 8)
        )
    with pytest.raises(
        RecordingError, match="'joint7' is not among its names; did you mean 'joint6'"
    ):
        decode.VectorExtractor(channel(field="position", pick=("joint7",)))(
            joints(NAMES, [0.0] * 7)
        )
    message = joints([*NAMES, *NAMES], [float(k) for k in range(14)])
    with pytest.raises(RecordingError, match="'joint1' stands twice among its names"):
        decode.VectorExtractor(channel(field="position", pick=("joint1",)))(message)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ({"position": [1.0]}, "no field 'name'"),
        ({"name": "joint1", "position": [1.0]}, "list.*names"),
        ({"name": None, "position": [1.0]}, "list.*names"),
        ({"name": [{"a": 1}], "position": [1.0]}, "is not among its names"),
        ({"name": ["a"], "position": "1.5"}, "is not a list of numbers"),
        ({"name": ["a"], "position": ["1.5"]}, "is not a list of numbers"),
        ({"name": ["a"], "position": [None]}, "is not a list of numbers"),
        ({"name": ["a"], "position": None}, "is not a list of numbers"),
        ({"name": ["a"], "position": {"a": "1"}}, "is not a list of numbers"),
        ({"name": ["a", "b"], "position": [[1, 2], [3]]}, "is not a list of numbers"),
        ({"name": ["a"], "position": b"\x01\x02"}, "is not a list of numbers"),
        ({"name": [], "position": []}, "position is empty"),
    ],
)
def test_what_is_no_list_of_named_numbers_is_refused(message, reason):
    with pytest.raises(RecordingError, match=reason):
        decode.VectorExtractor(channel(field="position", pick=("a",)))(message)


def test_a_vector_without_a_field_is_the_message_itself():
    assert decode.VectorExtractor(channel())(
        np.arange(3, dtype=np.float32)
    ).tolist() == [0, 1, 2]
    assert decode.VectorExtractor(channel(field="x"))({"x": 2}).tolist() == [2.0]


# --- pads


def test_the_wires_12_by_32_frame_becomes_the_pads_32_by_12():
    """Taxel (row r, column c) of the pad is value c · 32 + r on the wire: the board scans 12 rows of 32."""
    wire = np.arange(12 * 32) % 251
    pad = decode.pad_extractor(channel(field="data"), FLEXITAC)(
        SimpleNamespace(data=wire.astype(np.uint8).tobytes())
    )
    assert pad.shape == (384,)
    for row, column in [(0, 0), (0, 1), (1, 0), (31, 11), (17, 5)]:
        assert pad.reshape(32, 12)[row, column] == (column * 32 + row) % 251


@pytest.mark.parametrize(
    "frame",
    [
        bytes([0, 1, 254, 255]),
        bytearray([0, 1, 254, 255]),
        memoryview(bytes([0, 1, 254, 255])),
        [0, 1, 254, 255],
        [0.0, 1.0, 254.0, 255.0],
        np.array([0, 1, 254, 255], dtype=np.int64),
        np.array([[0, 1], [254, 255]], dtype=np.uint8),
        base64.b64encode(bytes([0, 1, 254, 255])).decode(),
    ],
    ids=lambda f: type(f).__name__,
)
def test_counts_are_the_same_from_bytes_lists_arrays_and_base64(frame):
    counts = decode.pad_extractor(channel(), sensor(2, 2))(frame)
    assert counts.tolist() == [0, 1, 254, 255] and counts.dtype == np.uint8


def test_sixteen_bit_counts_come_little_endian_and_no_others_are_taken():
    pad = sensor(1, 2, dtype="uint16", adc_bits=12)
    assert decode.pad_extractor(channel(), pad)(b"\x01\x00\xff\x0f").tolist() == [
        1,
        4095,
    ]
    # 1 and 4095 with their bytes swapped: 256 and 65295.
    with pytest.raises(RecordingError, match=r"count.*65295,.*pad sends at most 4095"):
        decode.pad_extractor(channel(), pad)(b"\x00\x01\x0f\xff")
    with pytest.raises(RecordingError, match=r"3 bytes.*whole number.*uint16 counts"):
        decode.pad_extractor(channel(), pad)(bytes(3))


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (
            [0.0, 0.5, 1.0, 0.2],
            "counts that are not uint8 .normalised by the driver.*: record raw counts",
        ),
        ([0.0, float("nan"), 1.0, 0.2], "normalised by the driver"),
        ([0, 1, 2, 256], "counts that are not uint8"),
        ([0, 1, 2, -1], "counts that are not uint8"),
        (np.array([0, -61, 2, -1], np.int8), "uint8: -61 .taxel 1. is below 0.*int8"),
        (
            [0, 1, 2],
            "3 taxels,.*sensor pad.*2×2; other layouts:.*file.*data_specs/sensors/",
        ),
        (bytes(5), "5 taxels,.*sensor pad.*2×2"),
        ([], "0 taxels"),
        (b"", "0 taxels"),
        (
            np.zeros((1, 4), np.uint8),
            "frame.*1×4 taxels,.*wire.*pad.*2×2:.*transposed already",
        ),
        (["a", "b", "c", "d"], "list.*counts"),
        ([None] * 4, "list.*counts"),
        ([[0, 1], [2]], "list.*counts"),
        ({"a": 1}, "list.*counts"),
        (None, "list.*counts"),
        ("not base64!", "text that is not base64"),
        ("é", "text that is not base64"),
        (
            "AAEC!/w==",
            "text that is not base64",
        ),  # lenient readers would drop the mark and go on
    ],
)
def test_what_is_no_frame_of_counts_is_refused(frame, reason):
    with pytest.raises(RecordingError, match=reason):
        decode.pad_extractor(channel(), sensor(2, 2))(frame)


# --- pictures


def rainbow(rows: int = 8, columns: int = 12) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB, every pixel different."""
    grid = np.arange(rows * columns, dtype=np.uint8).reshape(rows, columns)
    return np.stack([grid, 255 - grid, grid[::-1]], axis=2)


def encoded(image: np.ndarray, ending: str) -> bytes:
    return cv2.imencode(ending, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def test_png_comes_back_to_the_pixel_and_red_stays_red():
    image = rainbow()
    message = SimpleNamespace(format="png", data=encoded(image, ".png"))
    assert np.array_equal(pictures.picture(message, channel()), image)


def test_a_picture_is_not_turned_by_its_exif_note():
    image = rainbow(16, 24)
    jpeg = encoded(image, ".jpg")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # orientation 6: turned by 90°
    turned = (
        jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    )
    assert pictures.picture(turned, channel()).shape == (16, 24, 3)


RAW = {
    "rgb8": lambda rgb: rgb,
    "bgr8": lambda rgb: rgb[..., ::-1],
    "rgba8": lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 7, np.uint8)]),
    "bgra8": lambda rgb: np.dstack(
        [rgb[..., ::-1], np.full(rgb.shape[:2], 7, np.uint8)]
    ),
    "mono8": lambda rgb: rgb[..., :1],
}


@pytest.mark.parametrize("encoding", RAW)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_pictures_with_and_without_padded_rows(encoding, padding):
    image = rainbow(4, 6)
    wire = np.ascontiguousarray(RAW[encoding](image)).reshape(4, -1)
    rows = np.hstack([wire, np.full((4, padding), 99, np.uint8)])
    message = SimpleNamespace(
        height=4, width=6, encoding=encoding, step=rows.shape[1], data=rows.tobytes()
    )
    expected = np.repeat(image[..., :1], 3, axis=2) if encoding == "mono8" else image
    found = pictures.picture(message, channel())
    assert np.array_equal(found, expected) and found.flags.c_contiguous
    if not padding:
        as_json = {
            "height": 4,
            "width": 6,
            "encoding": encoding,
            "data": base64.b64encode(rows.tobytes()).decode(),
        }
        assert np.array_equal(pictures.picture(as_json, channel()), expected)


def test_stored_arrays_and_raw_pictures_without_an_order_follow_that_of_the_spec():
    image = rainbow()
    unordered = SimpleNamespace(
        height=8, width=12, encoding="8UC3", step=36, data=image.tobytes()
    )
    for value in (image, unordered):
        assert np.array_equal(pictures.picture(value, channel()), image)
        assert np.array_equal(
            pictures.picture(value, channel(channel_order="bgr")), image[..., ::-1]
        )
    stored = np.frombuffer(encoded(image, ".png"), np.uint8)
    assert np.array_equal(
        pictures.picture(np.concatenate([stored, np.zeros(40, np.uint8)]), channel()),
        image,
    )


@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_compressed_pictures_follow_the_channel_order(ending):
    image = np.full((32, 32, 3), (220, 20, 60), np.uint8)
    found = pictures.picture(encoded(image, ending), channel(channel_order="bgr"))
    assert np.abs(found.astype(int) - image[..., ::-1]).max() <= 3


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "bayer_rggb8", "yuv422"])
def test_an_encoding_that_states_its_colours_admits_no_channel_order(encoding):
    with pytest.raises(
        RecordingError, match=f"{encoding}.*`channel_order: bgr` has no effect"
    ):
        pictures.picture(raw(encoding=encoding), channel(channel_order="bgr"))


def test_grey_and_planar_arrays_are_read():
    image = rainbow(8, 12)
    assert np.array_equal(pictures.picture(image.transpose(2, 0, 1), channel()), image)
    grey = np.repeat(image[..., :1], 3, axis=2)
    for form in (image[..., 0], image[..., :1], image[None, ..., 0]):
        assert np.array_equal(pictures.picture(form, channel()), grey)
    opaque = np.dstack([image, np.full((8, 12), 255, np.uint8)])
    assert np.array_equal(pictures.picture(opaque, channel()), image)
    encoded = cv2.imencode(".png", cv2.cvtColor(opaque, cv2.COLOR_RGBA2BGRA))[
        1
    ].tobytes()
    assert np.array_equal(pictures.picture(encoded, channel()), image)


def test_a_palette_gives_its_colours():
    """2 × 1 pixels, PNG colour type 3: the first is entry 1 of the palette, the second entry 0."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            len(body).to_bytes(4, "big")
            + kind
            + body
            + zlib.crc32(kind + body).to_bytes(4, "big")
        )

    head = (2).to_bytes(4, "big") + (1).to_bytes(4, "big") + bytes([8, 3, 0, 0, 0])
    pixels = chunk(b"IDAT", zlib.compress(b"\0\1\0"))
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"PLTE", bytes([10, 20, 30, 200, 100, 50]))
        + pixels
    )
    assert pictures.picture(png + chunk(b"IEND", b""), channel()).tolist() == [
        [[200, 100, 50], [10, 20, 30]]
    ]


def yuv_of(image: np.ndarray) -> np.ndarray:
    """BT.601, studio swing: Y = 16 + 65.5 R + 128.6 G + 25 B (of 0 … 1) …"""
    r, g, b = (image[..., k] / 255 for k in range(3))
    y = 16 + 65.481 * r + 128.553 * g + 24.966 * b
    u, v = (
        128 - 37.797 * r - 74.203 * g + 112 * b,
        128 + 112 * r - 93.786 * g - 18.214 * b,
    )
    return np.round(np.stack([y, u, v], axis=2)).astype(np.uint8)


def wire_of(image: np.ndarray, encoding: str) -> np.ndarray:
    """Rows of bytes of a picture of 2 × 2 blocks of one colour."""
    yuv = yuv_of(image)
    if encoding.startswith("bayer"):  # RGGB: red at even rows and columns …
        order = {c: k for k, c in enumerate("rgb")}
        out = np.empty(image.shape[:2], np.uint8)
        for k, c in enumerate(encoding[6:10]):
            out[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, order[c]]
        return out
    if encoding.startswith("nv"):
        pairs = yuv[::2, ::2, 1:] if encoding == "nv12" else yuv[::2, ::2, :0:-1]
        return np.vstack([yuv[..., 0], pairs.reshape(len(pairs), -1)])
    chroma = np.where(np.arange(image.shape[1]) % 2 == 0, yuv[..., 1], yuv[..., 2])
    first, second = (
        (chroma, yuv[..., 0])
        if encoding in ("yuv422", "uyvy")
        else (yuv[..., 0], chroma)
    )
    return np.stack([first, second], axis=2).reshape(len(image), -1)


BAYER = [f"bayer_{order}8" for order in ("rggb", "bggr", "gbrg", "grbg")]


@pytest.mark.parametrize(
    "encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21", *BAYER]
)
def test_raw_encodings_of_cameras_give_their_colours(encoding):
    colours = np.array([(220, 20, 60), (20, 160, 40), (30, 40, 200)], np.uint8)
    image = np.repeat(np.repeat(colours[None], 16, axis=0), 16, axis=1)
    rows = wire_of(image, encoding)
    padded = np.hstack([rows, np.full((len(rows), 6), 99, np.uint8)])
    message = SimpleNamespace(
        height=16,
        width=48,
        encoding=encoding,
        step=padded.shape[1],
        data=padded.tobytes(),
    )
    found = pictures.picture(message, channel())
    inside = [
        slice(16 * k + 3, 16 * k + 13) for k in range(3)
    ]  # demosaicing blends at edges
    for part in inside:
        assert np.abs(found[2:-2, part].astype(int) - image[2:-2, part]).max() <= 4


DEPTH_PNG = cv2.imencode(".png", np.full((4, 6), 4700, np.uint16))[1].tobytes()


def raw(**changes: Any) -> dict[str, Any]:
    data = base64.b64encode(bytes(72)).decode()
    return {
        "height": 4,
        "width": 6,
        "encoding": "rgb8",
        "step": 18,
        "data": data,
        **changes,
    }


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ({"format": "jpeg", "data": ""}, "a picture of format 'jpeg' that OpenCV cannot decode"),
        ({"format": "jpeg", "data": base64.b64encode(b"\xff\xd8no").decode()}, "OpenCV cannot decode"),
        (encoded(rainbow(64, 64), ".jpg")[:900], "OpenCV cannot decode"),
        (encoded(rainbow(64, 64), ".png")[:900], "OpenCV cannot decode"),
        ({"data": 5}, "a picture as int"),
        ({"data": None}, "a picture as NoneType"),
        ({"data": [1, 2]}, "a picture as list"),
        ({"data": "é"}, "not base64"),
        ({"format": "jpeg"}, "no field 'data'"),
        (np.zeros((4, 4), bool), "a picture of bool"),
        (np.zeros((3, 4, 4), np.uint8), r"a picture of uint8 \(3, 4, 4\)"),  # four pixels of RGBA in a row, or three planes?
        (np.zeros((9, 9, 4), np.uint8), "transparent pixels"),
        (np.zeros((2, 9, 9, 3), np.uint8), "a picture of uint8"),
        (DEPTH_PNG, "uint16 values: depth"),
        (cv2.imencode(".png", np.full((4, 4, 4), 99, np.uint8))[1].tobytes(), "transparent pixels"),
        (raw(encoding="32FC1"), "'32FC1'.*depth"),
        (raw(encoding="mono16"), "'mono16'.*depth"),
        (raw(encoding="yuv411"), "raw pictures.*'yuv411'.*did you mean 'yuv422'"),
        (raw(encoding="yuv422_yuy2", width=5, step=10), "a raw picture of 4×5 yuv422_yuy2"),
        (raw(encoding="rgb"), "did you mean 'rgb8'"),
        (raw(data=base64.b64encode(bytes(71)).decode()), "71 bytes for a picture of 4×18 bytes"),
        (raw(step=17), "raw picture.*4×6 rgb8.*17 bytes.*row"),
        (raw(height=0), "a raw picture of 0×6"),
        (raw(height=-4), "a raw picture of -4×6"),
        (raw(width=None), "without whole numbers for its size"),
        (raw(height=10**9), "18 bytes"),
    ],
)  # fmt: skip
def test_what_is_no_picture_is_refused(value, reason, capfd):
    with pytest.raises(RecordingError, match=reason):
        pictures.picture(value, channel())
    capfd.readouterr()  # libjpeg and libpng complain on their own


# --- letterbox


def test_letterbox_averages_when_it_shrinks_and_blends_when_it_grows():
    image = np.zeros((6, 6, 3), np.uint8)
    image[::3, ::3] = 180  # one pixel of every 3 × 3 block, off its centre: mean 20
    assert (pictures.letterbox(image, 2, 2) == 20).all()
    step = np.zeros((2, 2, 3), np.uint8)
    step[:, 1] = 200
    assert pictures.letterbox(step, 4, 4)[0, :, 0].tolist() == [0, 50, 150, 200]
    assert pictures.letterbox(np.full((2, 4, 3), 9, np.uint8), 8, 8)[2:6].min() == 9


@pytest.mark.parametrize(
    "size",
    [
        (1, 1),
        (1, 500),
        (500, 1),
        (333, 777),
        (225, 223),
        (1080, 1920),
        (223, 224),
        (480, 640),
    ],
)
def test_letterbox_keeps_the_aspect_and_centres(size):
    out = pictures.letterbox(np.full((*size, 3), 255, np.uint8), 224, 224)
    assert out.shape == (224, 224, 3)
    lit = out[..., 0] == 255
    rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
    factor = 224 / max(size)
    assert abs(len(rows) - size[0] * factor) <= max(0.5, 1 - size[0] * factor)
    assert abs(len(columns) - size[1] * factor) <= max(0.5, 1 - size[1] * factor)
    assert lit.sum() == len(rows) * len(columns)  # one solid rectangle
    assert rows[0] == (224 - len(rows)) // 2
    assert columns[0] == (224 - len(columns)) // 2


# --- fields of lists and objects


def test_a_number_in_a_field_takes_an_element_of_a_list():
    """A JointTrajectory: names in joint_names, positions in its first point."""
    points = [
        SimpleNamespace(positions=[0.1, 0.2, 0.3]),
        SimpleNamespace(positions=[9.0, 9.0, 9.0]),
    ]
    message = SimpleNamespace(joint_names=["a", "b", "c"], points=points)
    extract = decode.VectorExtractor(
        channel(field="points.0.positions", pick=("c", "a"))
    )
    assert extract(message).tolist() == [0.3, 0.1]
    as_json = {"joint_names": ["a", "b", "c"], "points": [{"positions": [1, 2, 3]}]}
    assert extract(as_json).tolist() == [3.0, 1.0]
    with pytest.raises(decode.NoSample, match="no element 0"):
        extract({"joint_names": ["a"], "points": []})
    with pytest.raises(RecordingError, match="no field 'positoin'"):
        decode.VectorExtractor(channel(field="points.0.positoin"))(as_json)


def test_an_object_of_numbers_is_a_vector_with_names():
    extract = decode.VectorExtractor(channel(field="joints", pick=("grip", "pan")))
    assert extract({"joints": {"pan": 0.5, "lift": 1, "grip": 0.02}}).tolist() == [
        0.02,
        0.5,
    ]
    whole = decode.VectorExtractor(channel(pick=("b", "a")))
    assert whole({"a": 1, "b": 2}).tolist() == [2.0, 1.0]
    with pytest.raises(
        RecordingError, match=r"pan, lift.*`pick`"
    ):  # their order is not promised
        decode.VectorExtractor(channel(field="joints"))(
            {"joints": {"pan": 0.5, "lift": 1}}
        )
    with pytest.raises(RecordingError, match="not a list of numbers"):
        decode.VectorExtractor(channel(field="joints", pick=("a",)))(
            {"joints": {"a": True}}
        )
