"""What is carried over, in a world of ideal hands: a source's own scene gives the source, a moved scene the moved motion, and
what a hand holds keeps its path however it lies in the hand."""

import dataclasses
import math

import numpy as np
import pytest
from ideal_hands import (
    BOX,
    CLOSED_M,
    GRIP_ROW,
    HZ,
    LET_GO_ROW,
    NUM_ROWS,
    OPEN_M,
    REST,
    TOUCH_ROW,
    IdealHands,
    demonstration,
    generate,
    mimic_spec,
    pose,
    scene,
)

from taccorl.episodes.sources.mimicgen import carry
from taccorl.episodes.sources.mimicgen.director import Director
from taccorl.episodes.sources.mimicgen.source import ArmTrack, Source, SourcePool
from taccorl.episodes.sources.mimicgen.spec import MimicSpec, NoiseSpec
from taccorl.tasks.experts.se3 import between, inverse

LEAD = 4  # contact_lead_steps, where they are given
G = pose(0.04, -0.03, 0.02, 0.1, -0.2, 0.7)
SLIP = {
    "left": pose(0.001, 0.002, -0.001, 0.03, 0, 0.02),
    "right": pose(-0.002, 0.001, 0.0005, 0, 0.05, -0.03),
}


def pool_of(spec: MimicSpec, *sources: Source) -> SourcePool:
    return SourcePool(spec, sources or [demonstration(scene())])


@pytest.mark.parametrize("scheme", ["replay", "transform"])
@pytest.mark.parametrize("retarget", ["held_object", "eef"])
def test_the_scene_of_the_source_gives_the_source(scheme, retarget):
    source = demonstration(scene())
    made = generate(pool_of(mimic_spec(scheme, retarget=retarget), source), scene())
    for arm in BOX:
        # Nothing is to be bridged, so row t is step t: goals and gripper alike, to rounding.
        np.testing.assert_allclose(made.goals[arm], source.arms[arm].goal, atol=1e-12)
        np.testing.assert_array_equal(made.openings[arm], source.arms[arm].opening_m)


@pytest.mark.parametrize("synchronize_start", [False, True])
def test_a_moved_scene_gives_the_moved_motion(synchronize_start):
    sources = [
        demonstration(
            scene(plug=pose(0.28 + 0.01 * k, -0.2, 0.02, 0, 0, 0.1 * k)),
            name=f"demo {k}",
        )
        for k in range(3)
    ]
    spec = mimic_spec("transform", synchronize_start=synchronize_start)
    new = scene(
        plug=pose(0.33, -0.12, 0.02, 0, 0, -0.4),
        cradle=pose(0.27, 0.2, 0.02, 0, 0, 0.8),
    )
    here, there = (
        generate(pool_of(spec, *sources), new),
        generate(pool_of(spec, *sources), new.moved(G)),
    )
    for arm in BOX:
        np.testing.assert_allclose(there.goals[arm], G @ here.goals[arm], atol=1e-12)
    for body in here.objects:
        np.testing.assert_allclose(
            there.objects[body], G @ here.objects[body], atol=1e-12
        )


def test_what_is_held_keeps_the_path_of_the_source_however_it_lies_in_the_hand():
    source = demonstration(scene())
    new = scene(
        plug=pose(0.34, -0.1, 0.02, 0, 0, 0.5), cradle=pose(0.26, 0.2, 0.02, 0, 0, -0.2)
    )
    made = generate(pool_of(mimic_spec(), source), new, grip_slip=SLIP)
    # Ends run together: counted from the end, rows of the joint part are steps.
    together = np.arange(-(NUM_ROWS - LET_GO_ROW) - 20, -(NUM_ROWS - LET_GO_ROW))
    for body in ("plug", "cradle"):
        np.testing.assert_allclose(
            made.objects[body][together], source.objects[body][together], atol=1e-9
        )
    # The hands themselves are elsewhere, by as much as the box has slipped in them.
    off = (
        made.goals["right"][together, :3, 3]
        - source.arms["right"].goal[together, :3, 3]
    )
    assert np.linalg.norm(off, axis=1).min() > 0.001


def test_hand_replay_carries_the_slip_over_to_what_is_held():
    source = demonstration(scene())
    made = generate(
        pool_of(mimic_spec(retarget="eef"), source), scene(), grip_slip=SLIP
    )
    np.testing.assert_allclose(
        made.goals["right"], source.arms["right"].goal, atol=1e-12
    )
    off = inverse(source.objects["plug"][LET_GO_ROW]) @ made.objects["plug"][LET_GO_ROW]
    np.testing.assert_allclose(off, SLIP["right"], atol=1e-12)


def test_replay_of_commands_is_the_source_s_commands_carried_over():
    source, g = demonstration(scene()), pose(0.03, 0.01, 0)
    pool = pool_of(mimic_spec("transform", retarget="eef_command"), source)
    made = generate(pool, scene().moved(g))
    for arm in BOX:
        sent = made.goals[arm][
            -NUM_ROWS + GRIP_ROW[arm] :
        ]  # after the bridge onto what was commanded
        np.testing.assert_allclose(
            sent, g @ source.arms[arm].goal[GRIP_ROW[arm] :] @ REST, atol=1e-12
        )


def test_a_grasp_of_a_displaced_object_is_the_displaced_grasp_and_the_bridge_keeps_its_speed():
    source = demonstration(scene())
    new = scene(plug=pose(0.36, -0.16, 0.02))  # 6 cm farther, as it was
    made = generate(pool_of(mimic_spec(), source), new)
    closes = int(np.argmax(made.openings["right"] == CLOSED_M))
    expected = source.arms["right"].goal[GRIP_ROW["right"]].copy()
    expected[0, 3] += 0.06
    np.testing.assert_allclose(made.goals["right"][closes], expected, atol=1e-12)
    # 6 cm at a peak of 0.25 m/s: 1.875 · 0.06 / 0.25 = 0.45 s = 13.5 steps, so 14.
    assert closes == GRIP_ROW["right"] + 14
    steps_m = np.linalg.norm(np.diff(made.goals["right"][:14, :3, 3], axis=0), axis=1)
    assert steps_m.max() < 0.25 / 30


def test_without_coordination_the_hands_do_not_meet():
    sources = [demonstration(scene())]
    new = scene(plug=pose(0.24, -0.16, 0.02))  # the right hand's way is longer

    def relative(made, step):
        return inverse(made.objects["cradle"][step]) @ made.objects["plug"][step]

    then = (
        inverse(sources[0].objects["cradle"][LET_GO_ROW])
        @ sources[0].objects["plug"][LET_GO_ROW]
    )
    off = {}
    for scheme in ("replay", "none"):
        made = generate(pool_of(mimic_spec(scheme), *sources), new)
        lets_go = (
            len(made.openings["right"])
            - int(np.argmax(made.openings["right"][::-1] == CLOSED_M))
            - 1
        )
        off[scheme] = np.linalg.norm(relative(made, lets_go)[:3, 3] - then[:3, 3])
    assert off["replay"] < 1e-9
    assert off["none"] > 0.001  # twice the play of a plug in its hole


def test_noise_is_of_the_transport_and_not_of_the_contact():
    noise = NoiseSpec(position_m=0.0025, rotation_rad=0.024)
    source = demonstration(scene())
    made = generate(
        pool_of(mimic_spec(contact_lead_steps=4, noise=noise), source), scene()
    )
    before = GRIP_ROW["left"]  # nothing is bridged up to here
    off_m = np.linalg.norm(
        made.goals["left"][:before, :3, 3] - source.arms["left"].goal[:before, :3, 3],
        axis=1,
    )
    # White: three axes of 2.5 mm are 4.3 mm together.
    assert 0.003 < np.sqrt(np.mean(off_m**2)) < 0.006
    # From 4 rows before the boxes touch, what is held is where it was in the source; the first row still shows the last noise.
    contact = NUM_ROWS - (TOUCH_ROW - 4)
    for body in ("plug", "cradle"):
        until = -(NUM_ROWS - LET_GO_ROW)
        np.testing.assert_allclose(
            made.objects[body][1 - contact : until],
            source.objects[body][1 - contact : until],
            atol=1e-9,
        )
        assert (
            np.abs(made.objects[body][-contact] - source.objects[body][-contact]).max()
            > 1e-4
        )


class Lagging(IdealHands):
    """Goes a third of the way to its goal in each step."""

    def execute(self, arm, goal, opening_m):
        super().execute(arm, between(self.tcps[arm], goal, 1 / 3), opening_m)


class RestingOff(IdealHands):
    """The right hand stays 3 mm above its goal."""

    def execute(self, arm, goal, opening_m):
        super().execute(arm, pose(0, 0, 0.003 * (arm == "right")) @ goal, opening_m)


def test_a_hand_waits_for_rest_before_its_gripper_acts():
    source, start, moved_m = demonstration(scene()), scene(), []
    for settle in (0, 12):
        world = Lagging(dict(start.tcps), dict(start.bodies))
        pool = pool_of(mimic_spec(num_settle_steps_before_gripper=settle), source)
        director = Director(
            pool, world, world.openings, np.random.default_rng(0), hz=HZ
        )
        while world.openings["right"] == OPEN_M:
            arm_targets, seen = director.step(world), world.tcp("right")
            for arm, arm_target in arm_targets.items():
                world.execute(arm, arm_target.goal, arm_target.opening_m)
        moved_m.append(np.linalg.norm(world.tcp("right")[:3, 3] - seen[:3, 3]))
    # The hand of the source stands for two rows before it closes: (2/3)³ of its lag are left.
    assert moved_m[1] < 0.0004 < 0.002 < moved_m[0]


@dataclasses.dataclass
class BeforeContact:
    """Steps up to the first of contact, which both hands begin in the same; then before that step:"""

    num_steps: int
    step_m: float  # How far the goal of the right hand went in the last step in which it moved
    off_m: dict[str, float]  # Hand → how far it is from its last goal
    apart: np.ndarray  # Cradle-from-plug (4, 4)


def until_contact(kind: type[IdealHands], settle: int, **generation) -> BeforeContact:
    start, goals, contact, now = scene(), [], False, None
    world = kind(dict(start.tcps), dict(start.bodies))
    pool = pool_of(
        mimic_spec(
            contact_lead_steps=LEAD,
            num_settle_steps_before_contact=settle,
            **generation,
        )
    )
    director = Director(pool, world, world.openings, np.random.default_rng(0), hz=HZ)
    while not contact:
        apart = inverse(world.body("cradle")) @ world.body("plug")
        tcps, arm_targets = dict(world.tcps), director.step(world)
        contact = arm_targets["right"].contact
        assert arm_targets["left"].contact == contact  # side by side
        if contact:
            steps_m = np.linalg.norm(
                np.diff([goal["right"][:3, 3] for goal in goals], axis=0), axis=1
            )
            off_m = {
                arm: float(np.linalg.norm((tcps[arm] - goals[-1][arm])[:3, 3]))
                for arm in BOX
            }
            now = BeforeContact(
                len(goals) + 1, steps_m[steps_m > 1e-9][-1], off_m, apart
            )
        goals.append({arm: arm_target.goal for arm, arm_target in arm_targets.items()})
        for arm, arm_target in arm_targets.items():
            world.execute(arm, arm_target.goal, arm_target.opening_m)
    assert now is not None
    return now


def test_hands_that_are_not_at_their_goal_wait_before_contact():
    at_once, waited = (until_contact(Lagging, settle) for settle in (0, 30))
    # In each step a hand goes on by v; what it lags behind comes to (v + lag) · 2/3 = lag, 2 v, of which (2/3)ⁿ is left after n.
    assert at_once.off_m["right"] == pytest.approx(2 * at_once.step_m, rel=0.2)
    steps = math.ceil(math.log(0.0005 / max(at_once.off_m.values())) / math.log(2 / 3))
    assert waited.num_steps - at_once.num_steps == steps > 5
    assert max(waited.off_m.values()) <= 0.0005


def test_hands_wait_as_long_as_the_spec_says_unless_they_are_at_their_goal_or_replayed_plainly():
    at_once, waited = (until_contact(RestingOff, settle) for settle in (0, 30))
    assert at_once.off_m["right"] == pytest.approx(0.003)
    assert waited.num_steps - at_once.num_steps == 30
    assert (
        until_contact(IdealHands, 30).num_steps
        == until_contact(IdealHands, 0).num_steps
    )
    at_once, plain = (
        until_contact(RestingOff, settle, retarget="eef_command") for settle in (0, 30)
    )
    assert at_once.num_steps == plain.num_steps


def test_the_source_nearest_in_position_and_angle_is_repeated(monkeypatch):
    monkeypatch.setattr(carry, "NEAREST", 1)
    at = [pose(0.30, -0.16, 0.02, 0, 0, angle) for angle in (-0.6, 0.0, 0.6)]
    spec = mimic_spec()
    nearest = dataclasses.replace(
        spec.subtask_configs["left"][0], selection_strategy="nearest_neighbor_object"
    )
    subtasks = dict(
        spec.subtask_configs, left=(nearest, spec.subtask_configs["left"][1])
    )
    spec = dataclasses.replace(spec, subtask_configs=subtasks)
    pool = pool_of(spec, *(demonstration(scene(cradle=p)) for p in at))
    for k, p in enumerate(at):
        made = generate(pool, scene(cradle=p @ pose(0.004, 0, 0, 0, 0, 0.1)), seed=k)
        assert {choice.source for choice in made.director.choices.values()} == {
            k
        }  # one for the whole episode
    # A body that looks the same after a third of a turn is nearest where it looks the same.
    turned = dataclasses.replace(spec, symmetry={"cradle": 3})
    made = generate(
        pool_of(turned, *pool.sources),
        scene(cradle=at[1] @ pose(0, 0, 0, 0, 0, 2 * np.pi / 3)),
    )
    choice = made.director.choices["left", 0]
    assert choice.source == 1
    np.testing.assert_allclose(choice.delta, np.eye(4), atol=1e-12)


def test_a_round_part_may_turn_in_the_hand_at_will():
    spec = dataclasses.replace(mimic_spec(), symmetry={"plug": 0})
    source = demonstration(scene())
    made = generate(
        pool_of(spec, source),
        scene(),
        grip_slip={"left": np.eye(4), "right": pose(0, 0, 0, 0, 0, 1.3)},
    )
    np.testing.assert_allclose(
        made.goals["right"], source.arms["right"].goal, atol=1e-9
    )


def test_a_gripper_acts_where_it_was_still_before():
    opening = np.array([7, 7, 7, 7, 7, 6, 5, 4, 4, 4, 4, 4, 4, 7.0])
    poses, joints = np.zeros((14, 4, 4)), np.zeros((14, 6))
    track = ArmTrack(poses, poses, joints, opening, poses, joints)
    assert np.flatnonzero(track.gripper_acts).tolist() == [5, 13]
