"""Director of one attempt: chooses source and transform of each subtask and computes each hand's target. Uses poses only.

``Director.step(scene)`` is called once per control step and returns an ``ArmTarget`` for each arm. The caller (the
twin, or a test's ideal hands) executes it and passes the resulting scene to the next step.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from taccorl.episodes.sources.mimicgen.carry import (
    Distance,
    bridge,
    distance,
    in_hand_correction,
    look_alike,
    object_delta,
    one_of_nearest,
)
from taccorl.episodes.sources.mimicgen.schedule import (
    ConstraintSpec,
    Cue,
    Place,
    Schedule,
)
from taccorl.episodes.sources.mimicgen.source import (
    ArmTrack,
    Segment,
    SourcePool,
    contact_row,
)
from taccorl.episodes.sources.mimicgen.spec import SubtaskSpec
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import minimum_jerk, turn

_SETTLED_M, _SETTLED_RAD = (
    0.0004,
    0.004,
)  # a hand that moves less in a control step is at rest
_ARRIVED_M, _ARRIVED_RAD = (
    0.0005,
    0.005,
)  # a hand that is no further from its goal is there
_REACH_M = 0.4  # of a joint to the hand: how far noise of the joints moves it
_JOINT_RADPS = 2.5  # peak speed of any joint in motions that are blended in joint space
_HANDED_OVER_STEPS = (
    2  # of a path: one in which another takes over, one when it has finished
)


class SeenPoses(Protocol):
    """Interface of the present scene: poses of hands and bodies."""

    def tcp(self, arm: str) -> np.ndarray:
        """Pose of an arm's hand, world-from-TCP (4, 4)."""
        ...

    def body(self, name: str) -> np.ndarray:
        """Pose of a body, world-from-body (4, 4)."""
        ...

    def mated(self, name: str) -> bool:
        """Whether a body touches the body that it is to be mated with."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmTarget:
    """Target of one arm for a control step: TCP pose, gripper opening, and the joint angles where it is given in joint space."""

    goal: np.ndarray
    """World-from-TCP (4, 4)."""
    opening_m: float
    """Opening between the pads [m]."""
    joints_rad: np.ndarray | None = None
    """(6,) joint angles [rad], if the target is given in joint space; ``goal`` is then their pose."""
    contact: bool = False
    """True if the held object touches its mate or soon will: the offset of the arm is then not estimated."""
    noisy: bool = True
    """True: the disturbance of the attempt, if there is one, may be added; False: the target is executed as stated."""
    intended: np.ndarray | None = None
    """Pose (4, 4) of the TCP in the world from which the dataset's ``action`` is computed. It is ``goal`` without the scripted
    expert's aiming error and tremor. None: ``goal`` contains neither, and ``action`` is computed from ``goal``."""


class ContactHands(Protocol):
    """Interface of a controller that moves the hands in contact in place of the source's motion."""

    @property
    def corrections(self) -> list[tuple[int, str]]:
        """Corrections so far: (row of the action, description)."""
        ...

    def take(self, arm: str, subtask: str, arm_target: ArmTarget) -> None:
        """Take over the arm from the next control step to the end of the subtask; ``arm_target`` was its last target."""
        ...

    def step(self) -> Mapping[str, ArmTarget]:
        """Arm → target for the next control step, for the arms that were given to the controller (``take``) and have not
        finished their subtask. Called once per control step."""
        ...


@dataclass(frozen=True)
class Ahead:
    """Control steps that remain until an arm must follow its path exactly. 0: the next step; infinite: no such event on the
    present path is known."""

    gripper: float
    """Steps until the arm's gripper begins to open or close."""
    contact: float
    """Steps until contact (``contact_lead_steps`` before the held object touches its mate), or until another controller moves
    the arm."""


@dataclass
class Choice:
    """Source and transform that an attempt chose for one subtask; stored in the provenance."""

    source: int  # Index of the source in the pool, from 0
    segment: Segment  # Rows of the source that the subtask repeats
    delta: (
        np.ndarray
    )  # Δ (4, 4), world to world: transform of the source's motion to the new scene
    correction: np.ndarray  # C = G_src · G_new⁻¹ (4, 4): correction for the present pose of the held object in the hand


@dataclass
class _Path:
    """One subtask of one arm: a bridge, then rows of a source; in contact another may move the hand."""

    bridge: list[ArmTarget]
    choice: Choice
    track: ArmTrack
    held: str | None  # What the hand holds, where its path is to be kept
    rows: np.ndarray  # Of the source, one for each step after the bridge
    contact: int  # First row that counts as contact
    joints_rad: np.ndarray | None  # (steps after the bridge, 6) where joints are told
    is_handed_over: bool = (
        False  # Another moves the hand in contact, for as long as it takes
    )

    def __len__(self) -> int:
        return self.num_own + self.is_handed_over * _HANDED_OVER_STEPS

    @property
    def num_own(self) -> int:
        """Steps before another takes over."""
        return len(self.bridge) + len(self.rows)

    def row(self, step: int) -> int | None:
        """Of the source; None on the bridge, and where another moves the hand."""
        return (
            int(self.rows[step - len(self.bridge)])
            if len(self.bridge) <= step < self.num_own
            else None
        )


@dataclass
class _Hand:
    last: ArmTarget
    joints_rad: np.ndarray | None = None
    """(6,) of the last arm_target, as the executor solved it."""
    path: _Path | None = None
    seen: np.ndarray | None = None
    """World-from-TCP (4, 4) a control step ago."""
    waited: int = 0


class Director:
    """Computes the arms' targets of one attempt: chooses a source for each subtask, and transfers its motion to the present
    scene. All random numbers come from ``rng``.
    """

    def __init__(
        self,
        pool: SourcePool,
        scene: SeenPoses,
        openings_m: Mapping[str, float],
        rng: np.random.Generator,
        *,
        hz: float,
        kinematics: Mapping[str, ArmKinematics] | None = None,
        contact_hands: Callable[[np.random.Generator], ContactHands] | None = None,
    ) -> None:
        """``kinematics``: arm → its kinematics; only subtasks without an object_ref need it. ``contact_hands``: factory of the
        controller that moves the hands in contact, which gets its own random generator; None: the source's motion is used."""
        self.pool, self.spec, self.hz, self.kinematics = (
            pool,
            pool.spec,
            hz,
            kinematics or {},
        )
        self._rng, self._noise_rng = rng.spawn(2)
        self.contact_hands = contact_hands(rng.spawn(1)[0]) if contact_hands else None
        self._handed_over: set[str] = set()
        """Arms that the contact controller moves now."""
        self.schedule = Schedule(self.spec.signals, self.spec.task_constraint_configs)
        self.choices: dict[Place, Choice] = {}
        self._hands = {
            arm: _Hand(
                ArmTarget(goal=scene.tcp(arm), opening_m=openings_m[arm], noisy=False)
            )
            for arm in self.spec.signals
        }
        self._source: int | None = None
        """Index of the source that the attempt repeats; None: not chosen yet."""
        self._shared: dict[int, tuple[int, np.ndarray]] = {}
        """Coordination → index of the source and Δ that both arms use."""
        self._offsets: dict[Place, int] = {}
        for arm, subtasks in self.spec.subtask_configs.items():
            for k, subtask in enumerate(subtasks):
                low, high = subtask.subtask_term_offset_range
                self._offsets[arm, k] = int(self._rng.integers(low, high + 1))

    @property
    def done(self) -> bool:
        """True if all subtasks have ended; targets then stay constant."""
        return self.schedule.done

    def step(
        self, scene: SeenPoses, joints_rad: Mapping[str, np.ndarray] | None = None
    ) -> dict[str, ArmTarget]:
        """Arm → its target for the next control step. ``joints_rad``: arm → (6,) joint angles that the caller computed for the
        arm's last target, if there was one. Raises DeadlockError: the arms wait for each other."""
        for arm, joints in (joints_rad or {}).items():
            self._hands[arm].joints_rad = joints
        for arm in self.schedule.to_plan():
            self._plan(arm, scene)
        held = [
            arm
            for arm in self._hands
            if arm in self._handed_over or self._is_to_settle(arm, scene)
        ]
        cues = self.schedule.tick(held) if not self.done else {}
        felt, arm_targets = self._in_contact(cues), {}
        for arm, hand in self._hands.items():
            if arm in felt:
                hand.last = arm_targets[arm] = felt[arm]
            elif arm in cues:
                hand.last, hand.waited = self._wish(arm, cues[arm].step, scene), 0
                arm_targets[arm] = self._shaken(hand.last)
            else:
                hand.waited += arm in held
                hand.last = replace(hand.last, noisy=False)
                arm_targets[arm] = hand.last
            hand.seen = scene.tcp(arm)
        return arm_targets

    def ahead(self, arm: str) -> Ahead:
        """Steps until the arm must follow its path exactly."""
        hand, cue = self._hands[arm], self.schedule.upcoming(arm)
        if arm in self._handed_over:
            return Ahead(0, 0)
        if cue is None or hand.path is None:
            return Ahead(math.inf, math.inf)
        path, first = hand.path, max(cue.step - len(hand.path.bridge), 0)
        rows, bridge_left = path.rows[first:], max(len(path.bridge) - cue.step, 0)

        def steps(found: np.ndarray) -> float:
            return float(bridge_left + np.argmax(found)) if found.any() else math.inf

        contact = steps(rows >= path.contact)
        if path.is_handed_over:
            contact = min(contact, max(path.num_own - cue.step, 0))
        return Ahead(steps(path.track.gripper_acts[rows]), contact)

    def _in_contact(self, cues: Mapping[str, Cue]) -> Mapping[str, ArmTarget]:
        """What others arm_target for the arms that they move now."""
        if self.contact_hands is None:
            return {}
        for arm, cue in cues.items():
            hand = self._hands[arm]
            assert hand.path is not None
            if hand.path.is_handed_over and cue.step == hand.path.num_own:
                self.contact_hands.take(
                    arm, self.spec.signals[arm][cue.subtask], hand.last
                )
        felt = self.contact_hands.step()
        self._handed_over = set(felt)
        return felt

    # settling and noise -----------------------------------------------------------------------------------------------

    def _is_to_settle(self, arm: str, scene: SeenPoses) -> bool:
        """Whether the arm's gripper would act next while the arm still moves, or what it holds meet its mate while the arm is not
        where it is to be."""
        cue, hand, generation = (
            self.schedule.upcoming(arm),
            self._hands[arm],
            self.spec.datagen_config,
        )
        row = (
            hand.path.row(cue.step)
            if cue is not None and hand.path is not None
            else None
        )
        if row is None or hand.path is None or hand.seen is None:
            return False
        if (
            hand.path.track.gripper_acts[row]
            and hand.waited < generation.num_settle_steps_before_gripper
        ):
            moved = distance(hand.seen, scene.tcp(arm))
            return moved.position_m > _SETTLED_M or moved.rotation_rad > _SETTLED_RAD
        if (
            row == hand.path.contact
            and hand.path.held
            and hand.waited < generation.num_settle_steps_before_contact
        ):
            off = distance(hand.last.goal, scene.tcp(arm))
            return off.position_m > _ARRIVED_M or off.rotation_rad > _ARRIVED_RAD
        return False

    def _shaken(self, arm_target: ArmTarget) -> ArmTarget:
        std = self.spec.datagen_config.noise
        if (
            arm_target.contact
            or not arm_target.noisy
            or (std.position_m == 0 and std.rotation_rad == 0)
        ):
            return arm_target
        draw = self._noise_rng.normal(size=6)
        if arm_target.joints_rad is not None:
            return replace(
                arm_target,
                joints_rad=arm_target.joints_rad + draw * std.position_m / _REACH_M,
            )
        goal = arm_target.goal @ turn(draw[3:] * std.rotation_rad)
        goal[:3, 3] += draw[:3] * std.position_m
        return replace(arm_target, goal=goal)

    # planning ---------------------------------------------------------------------------------------------------------

    def _plan(self, arm: str, scene: SeenPoses) -> None:
        """The path of the arm's present subtask, from what the scene is now."""
        k = self.schedule.subtask(arm)
        subtask, coordination = (
            self.spec.subtask_configs[arm][k],
            self.spec.coordination(arm, k),
        )
        i, delta = self._source_and_delta(arm, k, subtask, coordination, scene)
        source, segment = (
            self.pool.sources[i],
            self.pool.segment(i, arm, k, self._offsets),
        )
        hand, track = self._hands[arm], source.arms[arm]
        keeps_path = (
            subtask.held_object and self.spec.datagen_config.retarget == "held_object"
        )
        choice = self.choices[arm, k] = Choice(i, segment, delta, np.eye(4))
        hand.path = path = _Path(
            bridge=[],
            choice=choice,
            track=track,
            held=subtask.held_object if keeps_path else None,
            rows=np.arange(segment.start, segment.end),
            contact=contact_row(
                source,
                self._held_now(arm, k),
                segment,
                self.spec.datagen_config.contact_lead_steps,
            ),
            joints_rad=None,
        )
        self._look_into_hand(arm, path, segment.start, scene)
        num_together = segment.num_together
        if subtask.object_ref is None and coordination is None:
            path.rows, path.joints_rad = self._along_joints(
                arm, track, segment, choice.correction
            )
        else:
            before = track.goal[segment.start - 1] if segment.start else track.tcp[0]
            first = delta @ before @ choice.correction
            goals = bridge(hand.last.goal, first, self.hz)
            path.bridge = [
                ArmTarget(goal=goal, opening_m=hand.last.opening_m) for goal in goals
            ]
        if self.contact_hands is not None and path.contact < segment.end:
            num_together = self._hand_over(path, coordination)
        self.schedule.plan(arm, len(path), num_together)

    def _hand_over(self, path: _Path, coordination: ConstraintSpec | None) -> int:
        """Cut a path where another takes over: at contact, but two hands that work together in the same row. Gives the number of
        its last steps that they do side by side."""
        places, i = (
            coordination.eef_subtask_constraint_tuple if coordination else (),
            path.choice.source,
        )
        together = max(
            (self.pool.segment(i, *p, self._offsets).start for p in places),
            default=path.contact,
        )
        row = max(path.contact, together)
        path.rows, path.is_handed_over = path.rows[path.rows < row], True
        return row - together + _HANDED_OVER_STEPS

    def _wish(self, arm: str, step: int, scene: SeenPoses) -> ArmTarget:
        """Of a step of the arm's path, without noise."""
        hand = self._hands[arm]
        path = hand.path
        assert path is not None
        row = path.row(step)
        if row is None:
            return (
                path.bridge[step]
                if step < len(path.bridge)
                else replace(hand.last, noisy=False)
            )
        choice, told = path.choice, None
        if path.joints_rad is not None:
            told = path.joints_rad[step - len(path.bridge)]
            goal = self.kinematics[arm].pose(told)
        else:
            # Not for a part that the other hand or a fixture holds, too: each correction would raise the force.
            held = path.held
            if (
                held
                and self.pool.sources[choice.source].free[held][row]
                and not scene.mated(held)
            ):
                self._look_into_hand(arm, path, row, scene)
            goal = choice.delta @ path.track.goal[row] @ choice.correction
        opening_m = float(path.track.opening_m[row])
        return ArmTarget(
            goal=goal, opening_m=opening_m, joints_rad=told, contact=row >= path.contact
        )

    def _look_into_hand(
        self, arm: str, path: _Path, row: int, scene: SeenPoses
    ) -> None:
        """C = G_src · G_new⁻¹ of what the hand holds, now and in that row: what has slipped since is made good."""
        if path.held is None:
            return
        held_src = self.pool.sources[path.choice.source].objects[path.held][row]
        path.choice.correction = in_hand_correction(
            path.track.tcp[row],
            held_src,
            scene.tcp(arm),
            scene.body(path.held),
            self._num_turns(path.held),
        )

    def _held_now(self, arm: str, k: int) -> list[str]:
        """What this hand holds in its subtask ``k``, and the other one in what is coordinated with it."""
        coordination = self.spec.coordination(arm, k)
        places = (
            coordination.eef_subtask_constraint_tuple if coordination else ((arm, k),)
        )
        return [
            body
            for body in [self.spec.subtask_configs[a][j].held_object for a, j in places]
            if body is not None
        ]

    def _source_and_delta(
        self,
        arm: str,
        k: int,
        subtask: SubtaskSpec,
        coordination: ConstraintSpec | None,
        scene: SeenPoses,
    ) -> tuple[int, np.ndarray]:
        """Which source the subtask repeats, and the transform Δ of it."""
        if coordination is None:
            i = self._choose(arm, k, scene)
            return i, self._object_delta(i, arm, k, subtask.object_ref, scene)
        key = self.spec.task_constraint_configs.index(coordination)
        if key not in self._shared:
            i, body = self._choose(arm, k, scene), subtask.object_ref
            moved = body if coordination.coordination_scheme == "transform" else None
            self._shared[key] = i, self._object_delta(i, arm, k, moved, scene)
        return self._shared[key]

    def _object_delta(
        self, i: int, arm: str, k: int, body: str | None, scene: SeenPoses
    ) -> np.ndarray:
        if body is None:
            return np.eye(4)
        row = self.pool.segment(i, arm, k, self._offsets).start
        return object_delta(
            scene.body(body),
            self.pool.sources[i].objects[body][row],
            self._num_turns(body),
        )

    def _along_joints(
        self, arm: str, track: ArmTrack, segment: Segment, correction: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows, and joints (steps, 6), of a subtask that refers to no object: the source's, blended into where the arm is and
        to where what it holds ends as in the source. A straight line of the hand may pass a singularity; this cannot.
        A longer way than the source's takes more steps.
        """
        hand, kinematics = self._hands[arm], self.kinematics[arm]
        joints = track.joints_rad[segment.rows]
        now = (
            hand.joints_rad
            if hand.joints_rad is not None
            else kinematics.solve(hand.last.goal, joints[0])[0]
        )
        end, _ = kinematics.solve(track.goal[segment.end - 1] @ correction, joints[-1])
        share = np.array([minimum_jerk(x) for x in np.linspace(0, 1, len(joints))])[
            :, None
        ]
        joints = joints + (1 - share) * (now - joints[0]) + share * (end - joints[-1])
        fastest = np.abs(np.diff(joints, axis=0)).max(initial=0.0) * self.hz
        slower = max(1.0, fastest / _JOINT_RADPS)
        at = np.linspace(0, len(joints) - 1, math.ceil(len(joints) * slower))
        resampled = np.stack(
            [np.interp(at, np.arange(len(joints)), column) for column in joints.T],
            axis=1,
        )
        return segment.start + np.round(at).astype(int), resampled

    # selection --------------------------------------------------------------------------------------------------------

    def _choose(self, arm: str, k: int, scene: SeenPoses) -> int:
        """One source for the whole attempt, by the strategy of the subtask that begins first."""
        if self._source is None:
            subtask = self.spec.subtask_configs[arm][k]
            if (
                subtask.selection_strategy == "random"
                or (body := subtask.object_ref) is None
            ):
                self._source = int(self._rng.integers(len(self.pool)))
            else:
                distances = [
                    self._object_distance(i, arm, k, body, scene)
                    for i in range(len(self.pool))
                ]
                self._source = one_of_nearest(distances, self._rng)
        return self._source

    def _object_distance(
        self, i: int, arm: str, k: int, body: str, scene: SeenPoses
    ) -> Distance:
        then = self.pool.sources[i].objects[body][
            self.pool.segment(i, arm, k, self._offsets).start
        ]
        return distance(look_alike(scene.body(body), then, self._num_turns(body)), then)

    def _num_turns(self, body: str) -> int:
        return self.spec.symmetry.get(body, 1)
