#!/usr/bin/env bash
# Surprise: ROS 2's `byte` and `char` are both an unsigned char (rosidl's
# introspection says so of OCTET and CHAR), yet each of the two usual Python readers
# takes one of them as signed, and not the same one.
# Hurts: whoever reads status bytes or taxels from a bag: 195 becomes -61, but only
# in one of the readers, and values up to 127 look right in both.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0 numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

NAME = "pad/msg/Status"
DEFINITION = "byte flags\nchar level\nuint8 count\n"
CDR = bytes([0, 1, 0, 0, 195, 195, 195, 0])


def numbers(message):
    return message.flags, message.level, message.count


store = get_typestore(Stores.ROS2_JAZZY)
store.register(get_types_from_msg(DEFINITION, NAME))
rosbags = numbers(store.deserialize_cdr(CDR, NAME))
schema = Schema(id=1, name=NAME, encoding="ros2msg", data=DEFINITION.encode())
mcap = numbers(DecoderFactory().decoder_for("cdr", schema)(CDR))

print("byte, char and uint8 of a ROS 2 message, each 195 on the wire")
print("expected: (195, 195, 195) from each reader")
print(f"seen: rosbags {version('rosbags')} {rosbags}")
print(f"      mcap-ros2-support {version('mcap-ros2-support')} {mcap}")
if (rosbags, mcap) != ((-61, 195, 195), (195, -61, 195)):
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
