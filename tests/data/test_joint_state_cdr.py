"""The short way to a JointState gives what the decoder of any schema gives, and leaves to it what it does not know."""

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import serialize_dynamic

from taccorl.data.mcap_messages import joint_state_decoder
from taccorl.surrogate.driver_messages import JOINT_STATE, ROS2_DEFINITIONS

SCHEMA = Schema(id=1, data=ROS2_DEFINITIONS[JOINT_STATE].encode(), encoding="ros2msg", name=JOINT_STATE)
encode = serialize_dynamic(JOINT_STATE, ROS2_DEFINITIONS[JOINT_STATE])[JOINT_STATE]
NAMES = ("joint1", "b", "gripper")


def bytes_of(seed: int, names=NAMES, frame_id="base", counts=(3, 3, 3)) -> bytes:
    rng = np.random.default_rng(seed)
    numbers = [rng.normal(size=count).tolist() for count in counts]
    stamp = {"sec": int(rng.integers(-5, 2**31)), "nanosec": int(rng.integers(10**9))}
    header = {"stamp": stamp, "frame_id": frame_id}
    return encode(dict(zip(("position", "velocity", "effort"), numbers, strict=True), header=header, name=list(names)))


class Counted:
    """The general decoder, and how often it was asked."""

    def __init__(self, schema: Schema = SCHEMA) -> None:
        decoder = DecoderFactory().decoder_for("cdr", schema)
        assert decoder is not None
        self.decoder, self.asked = decoder, 0

    def __call__(self, data: bytes):
        self.asked += 1
        return self.decoder(data)


@pytest.mark.parametrize("frame_id", ["", "base", "a frame of 18 bytes"])
@pytest.mark.parametrize("names", [NAMES, ("j",), ()])
@pytest.mark.parametrize("counts", [(3, 3, 3), (3, 0, 1), (0, 0, 0), (7, 1, 0)])
def test_messages_are_those_of_the_general_decoder_which_reads_the_first_only(frame_id, names, counts):
    general = Counted()
    decode = joint_state_decoder(general)
    for seed in range(4):
        data = bytes_of(seed, names, frame_id, counts)
        assert repr(decode(data)) == repr(general.decoder(data))
    assert general.asked == 1


def test_other_names_or_counts_are_read_anew():
    general = Counted()
    decode = joint_state_decoder(general)
    kinds = [
        {},
        {"names": ("joint1", "c", "gripper")},
        {"frame_id": "bass"},
        {"counts": (3, 3, 2)},
        {"counts": (2, 4, 3)},
        {},
    ]
    for asked, kind in enumerate(kinds, start=1):
        for seed in range(3):
            data = bytes_of(seed, **kind)
            assert repr(decode(data)) == repr(general.decoder(data))
        assert general.asked == asked


def test_messages_do_not_share_their_lists():
    decode = joint_state_decoder(Counted())
    first = decode(bytes_of(0))
    first.name.append("x")
    second = decode(bytes_of(1))
    second.position.append(0.0)
    assert second.name == list(NAMES) and len(decode(bytes_of(1)).position) == 3
    assert type(second) is type(first) and type(second.header) is type(first.header)


def test_numbers_that_are_none_come_back_as_such():
    data = bytearray(bytes_of(0))
    data[-8:] = np.array([np.nan]).tobytes()
    general = Counted()
    decode = joint_state_decoder(general)
    assert np.isnan([decode(bytes(data)).effort[2] for _ in range(2)]).all() and general.asked == 1


@pytest.mark.parametrize("end", [2, 11, 40, -9, -1])
def test_a_message_that_is_cut_off_raises_what_the_general_decoder_raises(end):
    decode = joint_state_decoder(Counted())
    decode(bytes_of(0))
    data = bytes_of(1)[:end]
    with pytest.raises(Exception) as general:
        Counted().decoder(data)
    with pytest.raises(type(general.value)):
        decode(data)


def test_any_changed_byte_gives_what_the_general_decoder_gives():
    good, plain = bytes_of(1), Counted().decoder
    for place in range(len(good)):
        decode, data = joint_state_decoder(plain), bytearray(good)
        decode(bytes_of(0))
        data[place] ^= 0x41
        try:
            expected = repr(plain(bytes(data)))
        except Exception as error:
            with pytest.raises(type(error)):
                decode(bytes(data))
        else:
            assert repr(decode(bytes(data))) == expected, place


def test_a_schema_of_that_name_with_other_fields_is_left_to_the_general_decoder():
    text = "float64 first\n" + ROS2_DEFINITIONS[JOINT_STATE]
    general = Counted(Schema(id=1, data=text.encode(), encoding="ros2msg", name=JOINT_STATE))
    other = serialize_dynamic(JOINT_STATE, text)[JOINT_STATE]
    message = {"first": 2.5, "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}, "name": ["a"]}
    data = other(message | {"position": [1.0], "velocity": [2.0], "effort": [3.0]})
    decode = joint_state_decoder(general)
    assert [decode(data).first for _ in range(3)] == [2.5] * 3
    assert general.asked == 3
