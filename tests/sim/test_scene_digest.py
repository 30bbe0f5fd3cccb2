"""What makes a scene another one, and what is only said about it."""

from taccorl.sim.effects import make_effect
from taccorl.sim.scene_digest import scene_digest
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.assembly_1.scene import Assembly1


def digest(**effect) -> float:
    return scene_digest(Assembly1(), TwinConfig(effects=[make_effect("coulomb_friction", **effect)]), 1.0)


def test_evidence_and_interval_of_an_effect_make_no_other_scene_but_its_value_does():
    told = digest(torque_nm=0.4, interval={"torque_nm": (0.3, 0.5)}, evidence="validation error halves")
    assert told == digest(torque_nm=0.4)
    assert told != digest(torque_nm=0.41)
