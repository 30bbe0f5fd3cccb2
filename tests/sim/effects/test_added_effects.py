"""Effects together in one twin, and what is said when they cannot be."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from press_bench import BLOCK_M, perform, start

from pipelines.effects_page import PAGE, text
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect, prose
from taccorl.sim.effects.effect import (
    Effect,
    JointEffect,
    TouchEffect,
    effect,
    effects,
    number,
)
from taccorl.sim.effects.touch_memory import TouchLag
from taccorl.sim.simulation import Watch


def many() -> list[Effect]:
    return [
        make_effect(
            "command_delay", delay_s=0.01, joints=["joint1", "joint5", "gripper"]
        ),
        make_effect("sensor_delay", delay_s=0.007),
        make_effect("command_lag", time_constant_s=0.03, arm="right"),
        make_effect("coulomb_friction", torque_nm=0.3, joints=["joint4"]),
        make_effect("coulomb_friction", torque_nm=0.6, joints=["joint2"]),
        make_effect("stribeck_friction", torque_nm=0.2, joints=["joint5"]),
        make_effect("backlash", play_rad=0.002, joints=["joint6"]),
        make_effect("joint_compliance", compliance_rad_per_nm=0.001, joints=["joint6"]),
        make_effect("payload", mass_kg=0.1, arm="left"),
        # What acts between physics steps, on the same joints
        make_effect("load_friction", share=0.1),
        make_effect("torque_lag", time_constant_s=0.005),
        make_effect("torque_scale", factor=0.9),
        make_effect("torque_fade", rate_per_min=1.0),
        make_effect("encoder_eccentricity", amplitude_rad=0.01),
        make_effect("encoder_scale", factor=1.02),
        make_effect("error_deadband", width_rad=0.002),
        make_effect("integral_action", rate_per_s=1.0),
        make_effect("velocity_feedforward", share=0.5),
        make_effect("taxel_creep", share=0.3),
        make_effect("taxel_hysteresis", half_width=0.1, pads=["left_a"]),
        make_effect("baseline_drift", rate_per_min=1.0),
    ]


@pytest.mark.filterwarnings("error")
def test_many_effects_at_once_run_the_same_whatever_their_order_alone_in_a_batch_and_from_a_snapshot() -> (
    None
):
    alone = perform(start(*many()))
    again = perform(start(*many()[::-1]))
    for kind, values in alone.items():
        np.testing.assert_array_equal(
            again[kind], values, err_msg=f"other order: {kind}"
        )
    batch = start(*many(), num_sims=3, num_threads=3)
    begun = perform(batch, last=5)
    snapshot = batch.snapshot(np.array([2]))
    ended = perform(batch, 5)
    for kind, values in alone.items():
        np.testing.assert_array_equal(
            np.concatenate([begun[kind], ended[kind]])[:, 0], values[:, 0], err_msg=kind
        )
    other = start(*many(), num_sims=3)
    perform(other, last=3)
    other.restore(snapshot, np.array([2]))
    for kind, values in perform(other, 5).items():
        np.testing.assert_array_equal(
            values[:, 2], ended[kind][:, 2], err_msg=f"restored: {kind}"
        )


def test_a_reset_forgets_everything() -> None:
    sim = start(*many(), num_sims=2)
    fresh = sim.snapshot()
    perform(sim)
    sim.reset([0], np.array([1]))
    sim.reset([0], np.array([0]))
    other = start(*many(), num_sims=2)
    other.reset([0, 0])
    forgotten, never = sim.snapshot(), other.snapshot()
    for name, values in never.memory.items():
        np.testing.assert_array_equal(forgotten.memory[name], values, err_msg=name)
    np.testing.assert_array_equal(forgotten.physics, never.physics)
    assert fresh.memory.keys() == never.memory.keys()


def test_a_diverged_simulation_does_not_spoil_its_neighbour_or_its_own_next_episode() -> (
    None
):
    sim = start(
        make_effect("taxel_creep", share=0.3),
        make_effect("command_delay", delay_s=0.02),
        num_sims=2,
    )
    targets = sim.targets.copy()
    targets[:, 6] = BLOCK_M - 0.008
    sim.arrays["qpos"][0, 3] = np.nan
    for _ in range(4):
        sim.step(targets)
    assert sim.diverged.tolist() == [True, False] and sim.reading()[1].max() > 0.5
    sim.reset([0], np.array([0]))
    sim.step(targets)
    assert not sim.diverged.any() and np.isfinite(sim.reading()).all()


def test_states_of_a_twin_with_other_effects_are_refused() -> None:
    state = start(make_effect("taxel_creep", share=0.3)).snapshot()
    with pytest.raises(TaccorlError, match=r".*taxel_creep/crept.*another twin"):
        start(make_effect("taxel_hysteresis", half_width=0.1)).restore(state)


def test_effects_act_in_the_order_of_their_slots_and_stored_rows_hold_them_in_that_of_names() -> (
    None
):
    own = [
        make_effect("direction_gain", factor=0.8),
        make_effect("command_lag", time_constant_s=0.1),
    ]
    own += [
        make_effect("encoder_eccentricity", amplitude_rad=0.01),
        make_effect("taxel_creep", share=0.1),
    ]
    sim = start(make_effect("armature", added_kgm2=0.1), *own)
    order = [
        "command_lag",
        "encoder_eccentricity",
        "direction_gain",
        "armature",
        "taxel_creep",
    ]
    assert [effect.name for effect in sim.effects.present] == order
    names = [
        name.split("/")[:2]
        for name in sorted(sim.snapshot().memory)
        if name[0].isdigit()
    ]
    stored = [
        "command_lag",
        "direction_gain",
        "direction_gain",
        "encoder_eccentricity",
        "taxel_creep",
    ]
    assert names == [
        [k, name] for k, name in zip("12234", stored, strict=True)
    ]  # 0 is armature's, which keeps nothing


def test_one_effect_may_not_act_twice_on_one_joint_but_on_two() -> None:
    two = [
        make_effect("armature", added_kgm2=0.1, joints=[joint])
        for joint in ("joint1", "joint2")
    ]
    model = start(*two).model
    dofs = [model.joint(f"left_joint{k}").dofadr[0] for k in (1, 2, 3)]
    np.testing.assert_allclose(model.dof_armature[dofs], [0.11, 0.11, 0.01])
    twice = [*two, make_effect("armature", arm="right", joints=["joint2"])]
    with pytest.raises(
        TaccorlError, match=r"armature acts on right_joint2 twice, entries 2 and 3"
    ):
        start(*twice)


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        (
            "coulomb_fricton",
            {},
            "no effect 'coulomb_fricton'; did you mean 'coulomb_friction'?",
        ),
        (
            "coulomb_friction",
            {"torque": 1.0},
            "no parameter 'torque'; did you mean 'torque_nm'?",
        ),
        (
            "coulomb_friction",
            {"torque_nm": -1.0},
            "torque_nm is -1 N·m, outside of 0 … 20 N·m",
        ),
        ("direction_gain", {"factor": 50.0}, "factor is 50, outside of 0.2 … 5"),
        ("coulomb_friction", {"torque_nm": float("nan")}, "torque_nm is nan N·m"),
        (
            "coulomb_friction",
            {"torque_nm": "1"},
            "torque_nm is '1'; give a number in N·m",
        ),
        (
            "coulomb_friction",
            {"torque_nm": True},
            "torque_nm is True; give a number in N·m",
        ),
        (
            "coulomb_friction",
            {"joints": ["gripper"]},
            "no joint 'gripper'; known: joint1",
        ),
        (
            "command_delay",
            {"joints": ["griper"]},
            "no joint 'griper'; did you mean 'gripper'?",
        ),
        ("payload", {"arm": "middle"}, "no arm 'middle'; known: both, left, right"),
        ("dead_taxels", {"seed": -1}, "seed is -1; give a whole number"),
        ("taxel_creep", {"pads": ["left_c"]}, "no pad 'left_c'; did you mean 'left_"),
    ],
)
def test_what_cannot_be_is_said_with_the_way_out(
    name: str, values: dict[str, Any], said: str
) -> None:
    with pytest.raises(TaccorlError) as caught:
        make_effect(name, **values)
    assert said in str(caught.value)


class Undecorated(TouchEffect):
    """Planted: without @dataclass its parameter is none."""

    name: ClassVar = "undecorated"
    slot: ClassVar = "taxel"
    share: float = number("s", "1", 0.0, 0.5, (0.0, 1.0), "planted")


@dataclass(kw_only=True)
class Shapeless(JointEffect):
    """Planted: nothing says when it is absent."""

    name: ClassVar = "shapeless"
    width_s: float = number("w", "s", None, 0.5, (0.0, 1.0), "planted")


@pytest.mark.parametrize(
    ("cls", "said"), [(Undecorated, "@dataclass"), (Shapeless, "absent value")]
)
def test_a_class_that_could_never_take_part_says_so(
    cls: type[Effect], said: str
) -> None:
    with pytest.raises(TaccorlError, match=said):
        cls()


def test_a_memory_advances_at_the_boards_rate_whatever_the_phase_of_its_neighbours() -> (
    None
):
    """100 Hz are 12 of the 40 physics steps of a control step, so scans of step 36, 48, … fall within control steps.

    Against the effect's own law over ideal readings that a watch takes at these instants. Simulation 1 begins a step later."""
    lag = make_effect("touch_lag", time_constant_s=0.02)
    assert isinstance(lag, TouchLag)
    sim, ideal = start(lag, num_sims=2), start()
    press = sim.targets.copy()
    press[:, 6] = BLOCK_M - 0.006
    sim.step(press, np.array([0]))

    memory, at_scan, count = lag.memory(1, ROBOT.pad.shape), [], 0
    expected = []
    for control_step in range(6):
        due = [s for s in range(1, 41) if (40 * control_step + s) % 12 == 0]
        ideal.step(
            press[:1], watch=Watch(due, lambda _: at_scan.append(ideal.reading()))
        )
        for reading in at_scan[count:]:
            lag.scans(reading[None], memory, np.full((1, 1), 0.01))
        count = len(at_scan)
        since_s = (40 * (control_step + 1) % 12) * ideal.config.physics.timestep_s
        looked = {name: values.copy() for name, values in memory.items()}
        expected.append(
            lag.scans(ideal.reading()[None], looked, np.full((1, 1), since_s))[0, 0]
        )
    assert count == 20 and expected[-1].max() > 0.3

    np.testing.assert_allclose(sim.reading()[0], expected[0], atol=1e-5)
    for control_step in range(5):
        sim.step(press)
        found = sim.reading()
        np.testing.assert_allclose(
            found[0],
            expected[control_step + 1],
            atol=1e-5,
            err_msg=f"0, {control_step}",
        )
        np.testing.assert_allclose(
            found[1], expected[control_step], atol=1e-5, err_msg=f"1, {control_step}"
        )


@pytest.mark.parametrize(
    ("words", "meant"), [(("robt",), "'robot'"), (("load", "weigth"), "'weight'")]
)
def test_an_effect_with_an_unknown_slot_or_need_is_refused_where_it_is_registered(
    words: Any, meant: str
) -> None:
    with pytest.raises(TaccorlError, match=f"did you mean {meant}"):
        effect("of_one", *words)(type("OfOne", (JointEffect,), {}))
    assert "of_one" not in effects


# ---- docs/effects.md ----


def test_the_page_of_effects_is_current():
    assert PAGE.read_text(encoding="utf-8") == text(), "run make pictures"


def test_a_section_of_another_form_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    texts = prose.PAGE.read_text(encoding="utf-8")
    monkeypatch.setattr(prose, "PAGE", tmp_path / "effects.md")
    for old, new, told in (
        ("- **Record:** One slow sweep", "One", "cogging: its section"),
        (
            "| cable_spring | end_stop |",
            "| cable_string | end_stop |",
            "the last table names cable_string",
        ),
    ):
        prose.PAGE.write_text(texts.replace(old, new))
        prose._sections.cache_clear()
        with pytest.raises(TaccorlError, match=told):
            _ = effects.get("armature").equation
    prose._sections.cache_clear()
