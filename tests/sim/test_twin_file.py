"""twin.yaml: what is written is read back equal, what is wrong is named with file, line and the nearest name."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from taccorl.errors import SpecError, TaccorlError
from taccorl.sim.cameras import (
    CameraConfig,
    CameraOffset,
    bench_cameras,
    sensor_intrinsics,
)
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.robot import RobotConfig
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import PhysicsConfig, TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin

CONFIGS = Path(__file__).parents[2] / "configs"


def read(tmp_path: Path, text: str) -> TwinConfig:
    path = tmp_path / "twin.yaml"
    path.write_text(text, encoding="utf-8")
    return load_twin(path)


def written(tmp_path: Path, config: TwinConfig) -> str:
    save_twin(config, tmp_path / "twin.yaml")
    return (tmp_path / "twin.yaml").read_text(encoding="utf-8")


def test_the_nominal_twin_is_the_nominal_twin() -> None:
    assert load_twin(CONFIGS / "twin.yaml") == TwinConfig()


def test_the_nominal_twin_is_written_as_nothing_at_all(tmp_path: Path) -> None:
    lines = [
        line
        for line in written(tmp_path, TwinConfig()).splitlines()
        if not line.startswith("#")
    ]
    assert lines == ["effects: []"]
    assert load_twin(tmp_path / "twin.yaml") == TwinConfig()


@pytest.mark.parametrize(
    "text", ["\n\n", "# effects: []\n", "  # nothing yet\n\n# at all"]
)
def test_a_file_that_says_nothing_is_the_nominal_twin(
    tmp_path: Path, text: str
) -> None:
    assert read(tmp_path, text) == TwinConfig()


def test_a_file_without_a_byte_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"twin.yaml: is empty \(0 bytes\)"):
        read(tmp_path, "")


@pytest.mark.parametrize("kind", ["robot", "axis", "cells"])
def test_a_file_of_another_machine_is_refused_with_its_kind_and_line(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "drive.yaml"
    path.write_text(f"# mine\nkind: {kind}  # of the bench\nname: slide\n")
    with pytest.raises(SpecError, match=rf"drive\.yaml:2: .*'{kind}'.*twin\.yaml"):
        load_twin(path)


def changed_everywhere() -> TwinConfig:
    front, left, right = bench_cameras()
    turned = CameraOffset(rotation_rad=(0.01, -0.02, 1e-7))
    aimed = dataclasses.replace(left, look_at_m=None, quat_wxyz=(1.0, 0.0, 0.0, 0.0))
    extra = CameraConfig(
        name="top",
        position_m=(0.3, 0.0, 1.0),
        look_at_m=(0.3, 0.0, 0.0),
        up=(1.0, 0.0, 0.0),
        recording_size=(240, 320),
        intrinsics=sensor_intrinsics("d415", 240, 320),
    )
    return TwinConfig(
        robot=RobotConfig(inertias="menagerie", armature_kgm2=1e-5, pads="rigid"),
        controller=ControllerConfig(
            kp_nm_per_rad=[float(x) for x in np.geomspace(1e-3, 1e17, 6)]
        ),
        arm_controllers={
            "right": ControllerConfig(torque_ff_nm=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
        },
        physics=PhysicsConfig(steps_per_control_step=20),
        cameras=[dataclasses.replace(front, offset=turned), aimed, right, extra],
        sensor=FlexiTacConfig(gain_count=80.0, resting_count=(5, 6), seed=3),
        effects=[
            make_effect(
                "coulomb_friction",
                torque_nm=np.float64(1 / 3),
                arm="left",
                joints=["joint5", "joint1"],
                interval={"torque_nm": (0.3, np.float64(0.4))},
                evidence='no: "3" # 2,01 → 0.20 mrad\nsecond line\t\U0001f9be',
            ),
            make_effect("taxel_gain_spread", log_std=0.1, seed=7, pads=["left_b"]),
            make_effect("torque_saturation"),
        ],
    )


def test_what_is_written_is_read_back_equal(tmp_path: Path) -> None:
    config = changed_everywhere()
    text = written(tmp_path, config)
    assert load_twin(tmp_path / "twin.yaml") == config
    assert written(tmp_path, load_twin(tmp_path / "twin.yaml")) == text
    assert "seed: 7" in text
    assert "log_std" in text
    assert "mount_height_m" not in text, "only what differs is written"


@pytest.mark.parametrize("name", list(effects))
def test_every_effect_is_read_back_equal(tmp_path: Path, name: str) -> None:
    cls = effects.get(name)
    values = {p.name: p.typical for p in cls.parameters()}
    ends = {p.name: (p.low, p.high) for p in cls.parameters()}
    config = TwinConfig(effects=[cls(**values, interval=ends, evidence="because")])
    written(tmp_path, config)
    assert load_twin(tmp_path / "twin.yaml") == config


def test_a_camera_may_be_moved_added_or_taken_away(tmp_path: Path) -> None:
    front, left, right = bench_cameras()
    text = "cameras:\n  left_wrist: null\n  front: {position_m: [1, 0, 0.5]}\n  top: {look_at_m: [0, 0, -1], up: [1, 0, 0]}\n"
    moved = dataclasses.replace(front, position_m=(1.0, 0.0, 0.5))
    top = CameraConfig(name="top", look_at_m=(0.0, 0.0, -1.0), up=(1.0, 0.0, 0.0))
    assert read(tmp_path, text).cameras == [moved, right, top]
    config = TwinConfig(cameras=[moved, right, top])
    written(tmp_path, config)
    assert load_twin(tmp_path / "twin.yaml") == config
    with pytest.raises(TaccorlError, match=r"cameras \['right_wrist', 'front'\]"):
        written(tmp_path, TwinConfig(cameras=[right, front]))
    assert left.name == "left_wrist"


ONE = "effects:\n- effect: coulomb_friction\n  torque_nm: 0.4\n"


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("robto: {}\n", 1, "unknown key 'robto'; did you mean 'robot'?"),
        ("robot:\n  mount_hight_m: 0.2\n", 2, "'mount_hight_m'; did you mean 'mount_height_m'?"),
        ("robot:\n  pads: sprang\n", 2, "'sprang' is not one of 'sprung', 'rigid'"),
        ("physics:\n  impratio: 1\n  steps_per_control_step: 33\n", 3, "33 is not a multiple of 20"),
        ("physics:\n  impratio: 0\n", 2, "physics.impratio: 0.0 is out of range; give a finite number > 0"),
        ("robot:\n  pad_stiffness_n_per_m: -1\n", 2, "robot.pad_stiffness_n_per_m: -1.0 is out of range"),
        ("physics: {impratio: ten}\n", 1, "expected float, found 'ten'"),
        ("controller:\n  kp_nm_per_rad: [1, 2]\n", 2, "2 values for 6 joints"),
        ("controller:\n  kp_nm_per_rad: 1813\n", 2, "expected a list, found '1813'"),
        ("sensor:\n  gian_count: 3\n", 2, "unknown key 'gian_count'; did you mean 'gain_count'?"),
        ("sensor:\n  type: flexytac\n", 2, "no sensor 'flexytac'; did you mean 'flexitac'?"),
        ("cameras:\n  frnt: null\n", 2, "there is no camera 'frnt' to remove; did you mean 'front'?"),
        ("cameras:\n  top: {}\n", 2, "give either look_at_m or quat_wxyz"),
        ("cameras:\n  front: {postion_m: [0, 0, 0]}\n", 2, "did you mean 'position_m'?"),
        ("effects:\n- torque_nm: 1\n", 2, "key 'effect' is missing; its value is one of: armature, "),
        ("effects:\n- effect: coulomb_fricton\n", 2, "no effect 'coulomb_fricton'; did you mean 'coulomb_friction'?"),
        ("effects: {coulomb_friction: 1}\n", 1, "expected a list, found keys and values"),
        ("model: arm.xml\n", 1, "begins with its kind: `kind: robot`"),
        (ONE + "  torqe_nm: 1\n", 4, "unknown key 'torqe_nm'; did you mean 'torque_nm'?"),
        (ONE + "  arm: lfet\n", 4, "'lfet' is not one of 'left', 'right', 'both'; did you mean 'left'?"),
        (ONE + "  joints: [joint5, joint7]\n", 4, "no joint 'joint7'; did you mean"),
        (ONE + "  joints: [joint5, joint5]\n", 4, "each once"),
        (ONE + "  joints: []\n", 4, "name at least one"),
        (ONE + "  interval: {torque_mn: [0, 1]}\n", 4, "interval of no parameter, 'torque_mn'; did you mean 'torque_nm'?"),
        (ONE + "  interval: {torque_nm: [1, 0]}\n", 4, "give two numbers, low and high"),
        (ONE + "  interval: {torque_nm: [1]}\n", 4, "expected 2 values, found 1"),
        (ONE + "- effect: coulomb_friction\n", 1, "coulomb_friction acts on left_joint1 twice, entries 1 and 2"),
        ("effects:\n- effect: payload\n  mass_kg: 2\n", 3, "mass_kg is 2 kg, outside of -1.5 … 1.5 kg"),
        ("effects:\n- effect: payload\n  mass_kg: .nan\n", 3, "expected float, found '.nan'"),
        ("effects:\n- effect: dead_taxels\n  share: 0.1\n  pads: [left_c]\n", 4, "no pad 'left_c'; did you mean 'left_"),
        ("effects:\n- effect: payload\n  effect: armature\n", 3, "stands here twice"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_line(
    tmp_path: Path, text: str, line: int, said: str
) -> None:
    with pytest.raises(SpecError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'twin.yaml'}:{line}: "), message
    assert said in message


@pytest.mark.parametrize(
    "text", ["null", "\t- x", "a: [", "- 1\n", "effects: &x [*x]\n"]
)
def test_what_is_no_twin_file_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(SpecError, match=r"twin\.yaml"):
        read(tmp_path, text)


def test_a_file_that_cannot_be_written_leaves_the_old_one_alone(tmp_path: Path) -> None:
    save_twin(changed_everywhere(), tmp_path / "twin.yaml")
    before = (tmp_path / "twin.yaml").read_bytes()
    config = TwinConfig()
    config.robot.mount_height_m = float("inf")
    with pytest.raises(TaccorlError, match="mount_height_m is inf"):
        save_twin(config, tmp_path / "twin.yaml")
    assert (tmp_path / "twin.yaml").read_bytes() == before
    with pytest.raises(TaccorlError, match=r"nowhere.*cannot be written"):
        save_twin(TwinConfig(), tmp_path / "nowhere" / "twin.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["twin.yaml"]


def test_a_twin_that_could_not_be_read_again_is_not_written(tmp_path: Path) -> None:
    before = written(tmp_path, TwinConfig())
    twice = [
        make_effect("camera_pose", cameras=["front"], turn_x_rad=x)
        for x in (0.01, 0.02)
    ]
    with pytest.raises(TaccorlError, match="camera_pose acts on front twice"):
        save_twin(TwinConfig(effects=twice), tmp_path / "twin.yaml")
    assert (tmp_path / "twin.yaml").read_text(encoding="utf-8") == before
