"""Which machine a file describes, and what the PiPER's twin is as a machine."""

from pathlib import Path

import pytest

from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.errors import SpecError, TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin_file import load_twin, twin_digest

TWIN = Path(__file__).parents[3] / "configs" / "twin.yaml"


def test_no_file_is_the_nominal_twin_and_a_file_without_kind_is_a_twin_of_the_piper():
    nominal, twin = load_machine(None), load_machine(TWIN)
    assert isinstance(nominal, PiperTwin) and isinstance(twin, PiperTwin)
    assert (nominal.name, twin.name) == ("nominal twin", "twin")
    assert (
        twin.digest() == twin_digest(load_twin(TWIN))
        and tuple(nominal.units) == ROBOT.action_names
    )
    assert (
        nominal.units["left_joint1"] == "rad" and nominal.units["right_gripper"] == "m"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# my drive\nname: drive\nkind: axsi\n", "3: kind: .*'axsi'"),
        ("robot: {\n", "2: is not YAML"),
    ],
)
def test_an_unknown_kind_and_what_is_no_yaml_are_refused_with_their_line(
    tmp_path: Path, text: str, words: str
):
    path = tmp_path / "drive.yaml"
    path.write_text(text)
    with pytest.raises(SpecError, match=rf"drive\.yaml:{words}"):
        load_machine(path)


def test_parts_are_chosen_by_the_names_of_joints_and_arms():
    machine = load_machine(None)
    parts = ("left_joint4", "right_joint4", "right_joint5", "left pads")
    assert machine.select(parts, [], []) == parts
    assert machine.select(parts, ["J3"], []) == ("left_joint4", "right_joint4")
    assert machine.select(parts, [], ["left"]) == ("left pads",)
    assert machine.select(parts, ["right_joint5"], ["left"]) == (
        "right_joint5",
        "left pads",
    )
    with pytest.raises(TaccorlError, match="right_joint6: no such joint is swept"):
        machine.select(parts, ["right_joint6"], [])
    with pytest.raises(
        TaccorlError,
        match=r"--pads=right: the recordings have no pads of that arm; .*left",
    ):
        machine.select(parts, [], ["right"])


def test_additions_make_another_machine_and_leave_the_first_as_it_was(tmp_path: Path):
    machine = load_machine(None)
    effect = machine.effect("coulomb_friction", "left_joint5", {"torque_nm": 0.4})
    assert effect is not None and effect.acts_on() == ["left_joint5"]
    new = machine.with_additions([Addition("left_joint5", [effect], {"kp": 140.0}, {})])
    assert machine.effects == () and new.effects == ("coulomb_friction",)
    new.save(tmp_path / "twin.yaml")
    back = load_machine(tmp_path / "twin.yaml")
    assert back.digest() == new.digest() != machine.digest()
    assert (
        isinstance(back, PiperTwin)
        and back.config.controller_of("left").kp_nm_per_rad[4] == 140.0
    )


def test_an_effect_of_pads_cannot_act_on_a_joint():
    assert load_machine(None).effect("taxel_creep", "left_joint5", {}) is None
