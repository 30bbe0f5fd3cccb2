"""Vectors, poses, twists, wrenches, IMU readings and odometry: read as numbers by name, drafted as features with their units."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from by_lerobot import write_with_lerobot
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from test_draft import inspect_and_ingest

from taccorl.cli.main import main
from taccorl.data import decode
from taccorl.data.checks import check_episode
from taccorl.data.dataset import Dataset
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import find_sources
from taccorl.data.ros import unit_of, vector_type
from taccorl.data.spec import ChannelSpec, load_recording_spec
from taccorl.errors import RecordingError

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_780_000_000 * 10**9
NUM = 300  # 3 s at 100 Hz
XYZ = ("x", "y", "z")


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def vector(*xyz: float, kind: str = "Vector3") -> Any:
    return make(f"geometry_msgs/msg/{kind}", **dict(zip(XYZ, xyz, strict=True)))


def quaternion(w: float, x: float, y: float, z: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", w=w, x=x, y=y, z=z)


def header(k: int, frame: str) -> Any:
    sec, nanosec = divmod(START_NS + k * 10**7, 10**9)
    return make(
        "std_msgs/msg/Header",
        stamp=make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec),
        frame_id=frame,
    )


def pose() -> Any:
    return make(
        "geometry_msgs/msg/Pose",
        position=vector(1, 2, 3, kind="Point"),
        orientation=quaternion(0.5, 0.1, 0.2, 0.3),
    )


def twist() -> Any:
    return make(
        "geometry_msgs/msg/Twist", linear=vector(4, 5, 6), angular=vector(7, 8, 9)
    )


def wrench(k: int = 0) -> Any:
    return make(
        "geometry_msgs/msg/Wrench",
        force=vector(1, 2, k / 100),
        torque=vector(0.1, 0.2, 0.3),
    )


def imu(k: int = 0, orientation_covariance: float = -1.0) -> Any:
    covariance = np.zeros(9)
    return make(
        "sensor_msgs/msg/Imu",
        header=header(k, "imu_link"),
        orientation=quaternion(1, 0, 0, 0),
        orientation_covariance=np.array([orientation_covariance] + [0.0] * 8),
        angular_velocity=vector(0.1, 0.2, 0.3),
        angular_velocity_covariance=covariance,
        linear_acceleration=vector(0, 0, 9.81),
        linear_acceleration_covariance=covariance,
    )


def odometry(k: int = 0) -> Any:
    return make(
        "nav_msgs/msg/Odometry",
        header=header(k, "odom"),
        child_frame_id="base_link",
        pose=make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose(),
            covariance=np.arange(36.0),
        ),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=twist(),
            covariance=np.arange(36.0),
        ),
    )


def stamped(kind: str, field: str, value: Any, k: int = 0) -> Any:
    return make(
        f"geometry_msgs/msg/{kind}Stamped", header=header(k, "tool0"), **{field: value}
    )


POSE = (
    (["position.x", "position.y", "position.z"], ["m"] * 3, [1, 2, 3]),
    (
        ["orientation.w", "orientation.x", "orientation.y", "orientation.z"],
        ["wxyz"] * 4,
        [0.5, 0.1, 0.2, 0.3],
    ),
)
TWIST = (
    (["linear.x", "linear.y", "linear.z"], ["m/s"] * 3, [4, 5, 6]),
    (["angular.x", "angular.y", "angular.z"], ["rad/s"] * 3, [7, 8, 9]),
)
FORCE = (
    (["force.x", "force.y", "force.z"], ["N"] * 3, [1, 2, 0]),
    (["torque.x", "torque.y", "torque.z"], ["Nm"] * 3, [0.1, 0.2, 0.3]),
)
IMU = (
    (
        ["orientation.w", "orientation.x", "orientation.y", "orientation.z"],
        ["wxyz"] * 4,
        [1, 0, 0, 0],
    ),
    (
        ["angular_velocity.x", "angular_velocity.y", "angular_velocity.z"],
        ["rad/s"] * 3,
        [0.1, 0.2, 0.3],
    ),
    (
        ["linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z"],
        ["m/s2"] * 3,
        [0, 0, 9.81],
    ),
)
ACCEL = make("geometry_msgs/msg/Accel", linear=vector(4, 5, 6), angular=vector(7, 8, 9))
QUATERNION = (list("wxyz"), ["wxyz"] * 4, [0.5, 0.1, 0.2, 0.3])
GEOMETRY = {
    "Vector3": ("vector", vector(1, 2, 3), [(list(XYZ), [""] * 3, [1, 2, 3])]),
    "Point": (
        "point",
        vector(1, 2, 3, kind="Point"),
        [(list(XYZ), ["m"] * 3, [1, 2, 3])],
    ),
    "Quaternion": ("quaternion", quaternion(0.5, 0.1, 0.2, 0.3), [QUATERNION]),
    "Pose": ("pose", pose(), POSE),
    "Twist": ("twist", twist(), TWIST),
    "Wrench": ("wrench", wrench(), FORCE),
    "Accel": (
        "accel",
        ACCEL,
        [
            (TWIST[0][0], ["m/s2"] * 3, [4, 5, 6]),
            (TWIST[1][0], ["rad/s2"] * 3, [7, 8, 9]),
        ],
    ),
}
"""Kind → its field in the stamped kind, a message, and its names, units and values."""
MESSAGES = [
    *((message, groups) for _, message, groups in GEOMETRY.values()),
    *(
        (stamped(kind, field, message), groups)
        for kind, (field, message, groups) in GEOMETRY.items()
    ),
    (imu(), IMU),
    (odometry(), (*POSE, *TWIST)),
]


def kind_of(message: Any) -> str:
    return message.__msgtype__


@pytest.mark.parametrize(
    ("message", "groups"),
    MESSAGES,
    ids=lambda m: kind_of(m) if hasattr(m, "__msgtype__") else "",
)
def test_every_message_is_numbers_with_names_and_units(
    message: Any, groups: Any
) -> None:
    names = [name for group in groups for name in group[0]]
    assert (
        list(decode.vector_paths(message)) == names
        and vector_type(kind_of(message)) is not None
    )
    assert [unit_of(name, kind_of(message)) for name in names] == [
        u for group in groups for u in group[1]
    ]
    whole = decode.VectorExtractor(ChannelSpec(topic="/t", rate_hz=1))
    assert whole(message).tolist() == [value for group in groups for value in group[2]]
    picked = ChannelSpec(
        topic="/t", rate_hz=1, pick=(names[-1], names[0]), scale=(1, 10)
    )
    assert decode.VectorExtractor(picked)(message).tolist() == [
        groups[-1][2][-1],
        10 * groups[0][2][0],
    ]


def test_a_part_of_a_message_is_named_within_that_part() -> None:
    part = ChannelSpec(
        topic="/t", rate_hz=1, field="pose.pose", pick=("orientation.w", "position.z")
    )
    assert decode.VectorExtractor(part)(odometry()).tolist() == [0.5, 3]
    assert decode.VectorExtractor(
        ChannelSpec(topic="/t", rate_hz=1, field="angular_velocity")
    )(imu()).tolist() == [0.1, 0.2, 0.3]
    json = {
        "header": {},
        "wrench": {
            "force": dict(zip(XYZ, (1, 2, 3), strict=True)),
            "torque": {"x": 4, "y": 5, "z": 6},
        },
    }
    extract = decode.VectorExtractor(ChannelSpec(topic="/t", rate_hz=1))
    assert extract(json).tolist() == [1, 2, 3, 4, 5, 6]
    with pytest.raises(RecordingError, match=r"no field 'torque'; known: force"):
        extract({"wrench": {"force": {"x": 1, "y": 2, "z": 3}}})
    with pytest.raises(
        RecordingError,
        match=r"'force\.w' is not among its names; did you mean 'force\.\w'",
    ):
        decode.VectorExtractor(ChannelSpec(topic="/t", rate_hz=1, pick=("force.w",)))(
            json
        )


@pytest.mark.parametrize(
    "value",
    [
        SimpleNamespace(x=1, y=2),
        {"pose": {"name": "home"}},
        {"x": {"y": 1}},
        {"position": [1.0]},
    ],
)
def test_other_messages_have_no_such_numbers(value: Any) -> None:
    assert decode.vector_paths(value) == {}


def write_bag(folder: Path) -> Path:
    """A mobile robot: odometry, IMU without orientation, force sensor, a bare Vector3; commanded by velocity."""
    topics: dict[str, tuple[str, Any]] = {
        "/odom": ("nav_msgs/msg/Odometry", odometry),
        "/imu/data": ("sensor_msgs/msg/Imu", imu),
        "/ft/wrench": (
            "geometry_msgs/msg/WrenchStamped",
            lambda k: stamped("Wrench", "wrench", wrench(k), k),
        ),
        "/wind": ("geometry_msgs/msg/Vector3", lambda k: vector(1, 2, 3)),
        "/cmd_vel": ("geometry_msgs/msg/Twist", lambda k: twist()),
    }
    with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            t: writer.add_connection(t, kind, typestore=STORE)
            for t, (kind, _) in topics.items()
        }
        for k in range(NUM):
            for topic, (kind, message) in topics.items():
                writer.write(
                    connections[topic],
                    START_NS + k * 10**7,
                    STORE.serialize_cdr(message(k), kind),
                )
    return folder


def test_a_robot_without_joint_states_is_drafted_and_ingested_with_units_and_frames(
    tmp_path: Path,
) -> None:
    bag = write_bag(tmp_path / "bag")
    assert all(
        not t.problem and t.num_values
        for t in inspect_source(*find_sources(bag)[0]).topics
    )
    told = {"text": "drive", "unit": "m/s", "range": "[-20, 20]", "frame": "base_link"}
    arrays = inspect_and_ingest(bag, tmp_path, **told).episode(0).arrays
    assert not any(
        "not used" in path.read_text() for path in tmp_path.glob("mine*.yaml")
    )
    spec = load_recording_spec(tmp_path / "mine.yaml")
    features = spec.target.features
    assert features["observation.ft_wrench"].unit == ("N", "N", "N", "Nm", "Nm", "Nm")
    assert features["observation.ft_wrench"].frame == "tool0"
    assert features["observation.odom"].unit == (
        *["m"] * 3,
        *["wxyz"] * 4,
        *["m/s"] * 3,
        *["rad/s"] * 3,
    )
    assert (
        features["observation.odom"].frame == "base_link"
    )  # a TODO: its pose is in "odom", its twist in "base_link"
    assert features["observation.odom"].names[3:5] == ("orientation.w", "orientation.x")
    # sensor_msgs/Imu: orientation_covariance[0] = -1 means that the IMU does not measure orientation.
    assert features["observation.imu_data"].unit == (*["rad/s"] * 3, *["m/s2"] * 3)
    assert (
        features["observation.wind"].unit == "m/s"
        and features["observation.wind"].frame == "base_link"
    )
    assert spec.features["action"].channels == ("cmd_vel",)
    assert arrays["observation.odom"][5].tolist() == pytest.approx(
        [1, 2, 3, 0.5, 0.1, 0.2, 0.3, 4, 5, 6, 7, 8, 9]
    )
    assert arrays["action"][5].tolist() == [4, 5, 6, 7, 8, 9]
    # Rows come at 30 Hz, samples at 100 Hz; sample k, at k / 100 s, has the force k / 100 N. Row t holds the newest sample at its
    # time, t / 30 s, which is k = floor(100 t / 30).
    expected = [int(100 * t / 30 + 1e-9) / 100 for t in range(len(arrays["action"]))]
    assert arrays["observation.ft_wrench"][:, 2].tolist() == pytest.approx(expected)


# ---- other people's touch ----

ROWS, FPS = 90, 30
KINDS: dict[str, tuple[str, tuple[int, ...]]] = {
    "observation.tactile.primary": ("float32", (12, 32)),  # LeFlexiTac
    "observation.tactile.left": ("uint8", (2, 16, 16)),  # two pads
    "observation.tactile.magnets": ("float32", (15,)),  # eFlesh, AnySkin
    "observation.tactile": ("int32", (4, 3)),
}


def touch(dtype: str, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(0, 200, (ROWS, *shape))
    return values.astype(dtype)


def build(root: Path, values: dict[str, np.ndarray]) -> Path:
    phase = np.arange(ROWS) / 30
    state = np.stack([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)
    columns = {"observation.state": state, "action": np.float32(0.9) * state, **values}
    rows = [
        {key: column[k] for key, column in columns.items()} | {"task": "press"}
        for k in range(ROWS)
    ]
    joints = {key: ["pan.pos", "lift.pos"] for key in ("observation.state", "action")}
    return write_with_lerobot(root, [rows], fps=FPS, robot_type="arm", names=joints)


@pytest.mark.parametrize("key", KINDS)
def test_touch_of_any_shape_and_type_is_read_to_the_number(
    tmp_path: Path, key: str
) -> None:
    values = touch(*KINDS[key])
    dataset = Dataset(build(tmp_path / "d", {key: values}))
    assert dataset.skipped == {}
    episode = dataset.episode(0)
    assert np.array_equal(episode.arrays[key], values.reshape(ROWS, -1))
    shape = KINDS[key][1]
    assert episode.spec.features[key].layout == (shape if len(shape) > 1 else ())


def checks(root: Path) -> dict[str, str]:
    return {
        f.check: f.severity
        for f in check_episode(Dataset(root).episode(0))
        if "tactile" in f.feature
    }


@pytest.mark.parametrize("key", KINDS)
def test_faults_of_touch_are_found_without_a_sensor_spec(
    tmp_path: Path, key: str
) -> None:
    good = touch(*KINDS[key])
    assert checks(build(tmp_path / "good", {key: good})) == {"touch_range": "note"}
    dead = good.copy()
    dead.reshape(ROWS, -1)[:, 3] = 7
    assert checks(build(tmp_path / "dead", {key: dead})).get("dead_taxel") == "warning"
    frozen = good.copy()
    frozen[30:60] = frozen[30]
    assert (
        checks(build(tmp_path / "frozen", {key: frozen})).get("frozen_touch")
        == "warning"
    )
    assert (
        checks(build(tmp_path / "silent", {key: np.full_like(good, 5)})).get(
            "silent_pad"
        )
        == "warning"
    )


def test_a_draft_ingests_touch_with_its_layout(tmp_path: Path) -> None:
    key = "observation.tactile.primary"
    values = touch(*KINDS[key])
    ingested = inspect_and_ingest(
        build(tmp_path / "d", {key: values}),
        tmp_path,
        unit="unknown",
        frame="pad",
        range="[-1000, 1000]",
    )
    assert ingested.spec.features[key].layout == (12, 32)
    assert ingested.info["features"][key]["layout"] == [12, 32]
    stored = ingested.episode(0).arrays[key]
    assert (
        np.array_equal(stored, values.reshape(ROWS, -1)[: len(stored)])
        and len(stored) >= ROWS - 1
    )


def test_view_of_a_dataset_says_what_the_sheet_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {
        key: touch(*kind) for key, kind in KINDS.items() if key != "observation.tactile"
    }
    root, out = build(tmp_path / "d", values), tmp_path / "episode.rrd"
    assert main(["view", str(root), f"--save={out}"]) == 0
    assert out.is_file() and "not shown" not in capsys.readouterr().out
    assert main(["view", str(root), f"--sheet={tmp_path / 'sheet.png'}"]) == 0
    lines = [
        line
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("not shown with --sheet: ")
    ]
    assert [line.split(": ")[1] for line in lines] == [
        "observation.tactile.primary",
        "observation.tactile.left",
    ]
