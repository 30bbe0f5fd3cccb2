"""Recordings of a robot for which nobody wrote a recording spec: its joints' topics, found by the names of its joints.

MCAP, ROS bags and HDF5 are read at the native rate of each stream. Which topic holds the positions and which the targets is
what ``taccorl ingest inspect`` drafts; units are those of the robot's file. What was taken is a note of each measurement.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from taccorl.data.draft import draft_paths, draft_specs
from taccorl.data.finding import Finding, listed
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import Source
from taccorl.data.spec import ACTION, STATE, RecordingSpec, load_recording_spec
from taccorl.errors import RecordingError

WIDEST = 1e9
"""Largest number of a joint that is read [rad, m]: what a recording holds is judged later, by the robot's own limits."""


def own_spec(reader: str, source: Source, units: Mapping[str, str]) -> RecordingSpec:
    """The spec that reads the joints ``units`` (name → rad or m) of a recording. Raises RecordingError: no topic names a
    joint, or which one holds positions and which one targets is not to be seen; the message has the way out."""
    recording, dataset = (
        yaml.safe_load(text)
        for text in draft_specs(inspect_source(reader, source), Path("own.yaml"))[:2]
    )
    topics = {c: stated["topic"] for c, stated in recording["channels"].items()}
    features = {
        key: recording["features"].get(key, {}).get("channels", [])
        for key in (STATE, ACTION)
    }
    used: dict[str, dict[str, Any]] = {}
    joints: dict[str, list[str]] = {}
    for key, channels in features.items():
        joints[key] = []
        for channel in channels if isinstance(channels, list) else ():
            stated = dict(recording["channels"].get(channel, {}))
            own = [str(n) for n in stated.get("pick", ()) if str(n) in units]
            if own:
                used[channel] = stated | {"pick": own}
                joints[key] += own
        features[key] = [c for c in channels if c in used]
    is_alike = sorted(joints[STATE]) == sorted(joints[ACTION])
    is_ordered = len(features[ACTION]) == 1 or joints[STATE] == joints[ACTION]
    if not (joints[STATE] and is_alike and is_ordered):
        found = [
            f"{what}: {listed(joints[key]) or 'none'}"
            for key, what in ((STATE, "positions"), (ACTION, "targets"))
        ]
        raise RecordingError(
            f"which topics hold the joints of the robot file is not to be seen ({'; '.join(found)}; its joints: "
            f"{listed([*units])}; topics: {listed(sorted(topics.values()))}). Write it down: taccorl ingest inspect "
            f"{source.path} --draft=spec.yaml, then --spec=spec.yaml"
        )
    if len(features[ACTION]) == 1:  # of the same joints, perhaps in another order
        joints[ACTION] = used[features[ACTION][0]]["pick"] = joints[STATE]
    recording |= {
        "channels": used,
        "features": {
            key: {"channels": channels, "align": "asof"}
            for key, channels in features.items()
        },
        "instruction": {"from": "spec", "text": "a measurement"},
    }
    dataset["features"] = {
        key: {
            "dtype": "float32",
            "shape": [len(names)],
            "names": [f"{name}.pos" for name in names],
            "unit": [units[name] for name in names],
            "frame": "joint",
            "rate_hz": used[features[key][0]]["rate_hz"],
            "range": [-WIDEST, WIDEST],
        }
        for key, names in joints.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        paths = draft_paths(Path(folder) / "own.yaml")
        for path, content in zip(paths, (recording, dataset), strict=False):
            path.write_text(yaml.safe_dump(content), encoding="utf-8")
        return load_recording_spec(paths[0])


def taken(spec: RecordingSpec) -> Finding:
    """Note on the topics that ``own_spec`` took."""
    of = [
        listed([spec.channels[c].topic for c in spec.features[key].channels])
        for key in (STATE, ACTION)
    ]
    text = f"positions are those of {of[0]}, targets those of {of[1]}, by their names; if not so, state them (--spec)"
    return Finding("own_topics", "note", "file", text)
