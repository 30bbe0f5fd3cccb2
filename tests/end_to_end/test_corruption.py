"""Damaged, wrong and odd recordings through the real command: each ends in its right outcome, and nothing readable is lost.

All files go through one ``taccorl ingest``, so a bad one must not disturb its neighbours.
"""

import json
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from edited import rewrite
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from taccorl.data.dataset import Dataset
from tests.recordings.stand_in import StandInConfig, write_mcap

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
SECONDS, SEED = 4.0, 7
FAULTY_SECONDS = 8.0  # In 8 s the grippers close one after the other, so that exchanged arms and pads can be told apart
CAMERAS = (96, 128)
BASE = StandInConfig(
    duration_s=SECONDS, seed=SEED, camera_size=CAMERAS, chunk_size_bytes=96 * 1024
)


def middle_chunk(path: Path) -> tuple[int, int]:
    """Byte offset and size of a chunk in the middle, by mcap's own reader."""
    found = []
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                size = (
                    9
                    + 8
                    + 8
                    + 8
                    + 4
                    + 4
                    + len(record.compression)
                    + 8
                    + len(record.data)
                )
                found.append((file.tell() - size, size))
    return found[len(found) // 2]


def with_bytes(path: Path, start: int, replacement: bytes) -> bytes:
    data = bytearray(path.read_bytes())
    data[start : start + len(replacement)] = replacement
    return bytes(data)


def flipped(path: Path) -> bytes:
    offset, size = middle_chunk(path)
    at = offset + size // 2
    return with_bytes(path, at, bytes([path.read_bytes()[at] ^ 0xFF]))


def flipped_length(path: Path) -> bytes:
    """The chunk's own length field points far beyond the file."""
    return with_bytes(path, middle_chunk(path)[0] + 6, b"\xff")


def zeroed_page(path: Path) -> bytes:
    return with_bytes(path, middle_chunk(path)[0] + 64, bytes(4096))


def wrong_schema(path: Path) -> bytes:
    """JointStates under the name of another type."""
    types = {"/joint_states_left": "geometry_msgs/msg/PoseStamped"}
    return rewrite(path, path.with_suffix(".rewritten"), list, types=types).read_bytes()


# name → (how it is made, expected outcome, words that the reason must hold)
FROM_BYTES: dict[str, tuple[Callable[[Path], bytes], str, tuple[str, ...]]] = {
    "intact": (lambda p: p.read_bytes(), "written", ()),
    "flipped_byte": (flipped, "split", ("chunk lost",)),
    "flipped_chunk_length": (flipped_length, "split", ("record header",)),
    "zeroed_page": (zeroed_page, "split", ("chunk lost",)),
    # only the index at the end is gone: every message is there
    "no_footer": (
        lambda p: p.read_bytes()[:-200],
        "written",
        ("nothing lost", "no index"),
    ),
    "no_end_magic": (
        lambda p: p.read_bytes()[:-8],
        "written",
        ("nothing lost", "no index"),
    ),
    "wrong_schema": (
        wrong_schema,
        "refused",
        ("/joint_states_left", "PoseStamped", "JointState"),
    ),
    "empty": (lambda p: b"", "refused", ("empty",)),
    "only_magic": (lambda p: p.read_bytes()[:8], "refused", ("/joint_states_left",)),
    "wrong_first_byte": (
        lambda p: b"X" + p.read_bytes()[1:],
        "written",
        ("nothing lost", "not the beginning of an MCAP file"),
    ),
    "garbage": (
        lambda p: random.Random(0).randbytes(50_000),
        "refused",
        ("not an MCAP",),
    ),
}
FROM_CONFIG: dict[str, tuple[dict[str, Any], str, tuple[str, ...]]] = {
    "degrees": ({"joints_in_degrees": True}, "quarantined", ("degrees?", "left_joint")),
    "swapped_arms": ({"swap_arms": True}, "quarantined", ("arm",)),
    "sim_time": ({"sim_time_stamps": True}, "refused", ("simulation time",)),
    "swapped_pads": (
        {"swap_pads": ("left_robot_left_finger", "right_robot_left_finger")},
        "quarantined",
        ("left_a", "right_a"),
    ),
    "clock_offset": (
        {"clock_offset_s": {"/camera_f/color/image_raw/compressed": 0.6}},
        "refused",
        ("/camera_f", "latency_s"),
    ),
    "gap": (
        {"gap": [("/camera_l/color/image_raw/compressed", 1.8, 2.3)]},
        "split",
        ("left_wrist",),
    ),
}


@pytest.fixture(scope="module")
def ingested(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """All cases ingested by one real command: entries by name, and the command's exit code and output."""
    folder = tmp_path_factory.mktemp("corruption")
    base = folder / "base.mcap"
    write_mcap(base, BASE)
    inputs = folder / "inputs"
    inputs.mkdir()
    for name, (make, _, _) in FROM_BYTES.items():
        (inputs / f"{name}.mcap").write_bytes(make(base))
    for name, (faults, _, _) in FROM_CONFIG.items():
        config = StandInConfig(
            duration_s=FAULTY_SECONDS, seed=SEED, camera_size=CAMERAS, **faults
        )
        write_mcap(inputs / f"{name}.mcap", config)
    before = {p.name: p.read_bytes() for p in inputs.iterdir()}
    command = [
        sys.executable,
        "-m",
        "taccorl.cli.main",
        "ingest",
        str(inputs),
        "--spec=piper_flexitac_mcap",
    ]
    command += [f"--out={folder / 'out'}", f"--store={folder / 'store'}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1500)
    assert {p.name: p.read_bytes() for p in inputs.iterdir()} == before, (
        "an original was touched"
    )
    report = json.loads((folder / "out.ingest_report.json").read_text())
    entries = {Path(e["recording"]).stem: e for e in report["recordings"]}
    return {"entries": entries, "done": done, "out": folder / "out"}


@pytest.mark.parametrize("name", [*FROM_BYTES, *FROM_CONFIG])
def test_each_case_ends_in_its_outcome_with_the_reason(
    ingested: dict[str, Any], name: str
) -> None:
    _, outcome, words = {**FROM_BYTES, **FROM_CONFIG}[name]
    entry = ingested["entries"][name]
    assert entry["outcome"] == outcome, (
        entry["reason"],
        entry["damage"],
        entry["losses"],
    )
    for word in words:
        assert word in entry["reason"] + json.dumps(entry["damage"]) + json.dumps(
            entry["losses"]
        ), (word, entry["reason"])
    assert entry["command"].startswith("taccorl ")


def test_exit_code_tells_and_no_traceback_reaches_the_user(
    ingested: dict[str, Any],
) -> None:
    done = ingested["done"]
    assert done.returncode == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert "traceback" not in json.dumps(list(ingested["entries"].values())), (
        "a fault of ours was met"
    )
    assert "quarantined" in done.stdout and "refused" in done.stdout


def test_what_was_written_is_a_sound_dataset(ingested: dict[str, Any]) -> None:
    dataset = Dataset(ingested["out"])
    written = sum(
        e["outcome"] == "written"
        for r in ingested["entries"].values()
        for e in r["episodes"]
    )
    assert dataset.num_episodes == written
    assert dataset.video_problems() == []
