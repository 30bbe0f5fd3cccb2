"""One attempt in the twin: physics and acceptance criteria only, a pure function of (spec, sources, twin, seed, k).

Touch and pictures are computed only for kept attempts: rows come from executing its stored actions again (``stored.execute``).
"""

import functools
import zlib
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from taccorl.data.episode import INTENDED
from taccorl.episodes.attempt import Actions, Targets, act
from taccorl.episodes.sources.mimicgen.director import ArmTarget, Director
from taccorl.episodes.sources.mimicgen.disturbance import Disturbance, Exact
from taccorl.episodes.sources.mimicgen.gates import GateKeeper, foreign_contact
from taccorl.episodes.sources.mimicgen.rest import RestOffset, joint_addresses
from taccorl.episodes.sources.mimicgen.source import SourcePool
from taccorl.episodes.sources.mimicgen.spec import check_closed_loop
from taccorl.episodes.sources.mimicgen.stored import Demonstration, state_digest
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.errors import UnreachableError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation, Watch
from taccorl.sim.task import HOLD_S
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.kinematics import ArmKinematics, retargeted

_UNREACHABLE_M = 0.005  # that inverse kinematics leaves: the hand would be elsewhere
_AFTER_STEPS = round(
    (HOLD_S + 0.5) * CONTROL_HZ
)  # a goal reached last of all must still hold
_DISTURBANCE = 3  # apart from the pads' noise, which draws from (scene seed, 2)
_WORD = "mimicgen"  # apart from the scenes of ``taccorl collect`` with the same seed


class ExpertContact:
    """``ContactHands`` of ``contact_mode: closed_loop_expert``: in contact the expert moves the hands instead of the source,
    whose motion does not react to it. The expert detects a block from how far the hand is pushed back, backs off and aims
    again. Its aiming error and tremor are drawn from the attempt's generator; the caller corrects the steady-state offset."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        """``sim``: one whose episode has just been reset. ``rng``: generator of the attempt."""
        self._expert = expert_of(sim.task)(sim, rng)
        self._expert.stand_by()

    @property
    def corrections(self) -> list[tuple[int, str]]:
        return self._expert.events

    def take(self, arm: str, subtask: str, arm_target: ArmTarget) -> None:
        self._expert.take_over(arm, subtask, arm_target.goal, arm_target.opening_m)

    def step(self) -> Mapping[str, ArmTarget]:
        expert = self._expert
        if expert.done:
            expert.step_count += 1
            return {}
        expert.act()
        hands = {arm: expert.hands[arm] for arm in expert.running}
        return {
            arm: ArmTarget(
                goal=hand.goal,
                opening_m=hand.opening_m,
                contact=not hand.learns,
                noisy=False,
                intended=hand.intended,
            )
            for arm, hand in hands.items()
        }


def attempt_seeds(root: int, task: str, k: int) -> tuple[int, np.random.Generator]:
    """Return the scene seed (0 … 2⁶² − 1) and the random generator of attempt ``k``: ``SeedSequence(root, spawn_key=(task, k))``,
    independent of other attempts.
    """
    sequence = np.random.SeedSequence(
        root, spawn_key=(zlib.crc32(f"{_WORD} {task}".encode()), k)
    )
    scene, rest = sequence.spawn(2)
    return int(
        scene.generate_state(1, np.uint64)[0] >> np.uint64(2)
    ), np.random.default_rng(rest)


@dataclass(frozen=True, kw_only=True, eq=False)
class Generated(Demonstration):
    """Result of one attempt: outcome, actions, provenance."""

    outcome: str
    """As ``Attempt.outcome``, or the acceptance criterion (gate) that a success did not meet."""
    reason: str = ""
    """Explanation of the outcome; empty if there is none."""

    @property
    def success(self) -> bool:
        return self.outcome == "success"


@dataclass
class _Physics:
    """Recorder of an attempt without rows."""

    sim: Simulation
    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    intended: list[np.ndarray | None] = field(default_factory=list)

    def step(
        self,
        action: np.ndarray,
        watch: Watch | None = None,
        intended: np.ndarray | None = None,
    ) -> None:
        self.states.append(self.sim.state_rows()[0])
        self.actions.append(action)
        self.intended.append(intended)
        self.sim.step(action[None].astype(np.float64), watch=watch)


class TwinScene:
    """Poses of hands and parts in simulation 0 of the twin, as the ``Director`` needs them."""

    def __init__(self, sim: Simulation) -> None:
        self.sim = sim

    def tcp(self, arm: str) -> np.ndarray:
        return self.sim.tcp(arm)[0]

    def body(self, name: str) -> np.ndarray:
        return self.sim.poses(name)[0]

    def mated(self, name: str) -> bool:
        pairs = [pair for pair in self.sim.task.mating if name in pair]
        return any(self.sim.contact(*pair).touching[0] for pair in pairs)


class Hands:
    """Convert arm targets to joint commands: inverse kinematics, and correction of the steady-state joint offset."""

    def __init__(
        self,
        sim: Simulation,
        kinematics: Mapping[str, ArmKinematics],
        *,
        max_joint_speed_radps: float,
        learn: bool = True,
    ) -> None:
        """After a reset. ``max_joint_speed_radps``: limit of the joint speed: a target that would need more is followed at this
        speed. ``learn``: targets are joint positions to reach, so that the steady-state offset is estimated and corrected; False:
        they are sent unchanged."""
        self._max_step_rad = max_joint_speed_radps / CONTROL_HZ
        self.sim, self.kinematics, self.learn = sim, kinematics, learn
        self.joints_rad, self._rest = {}, {}
        self._joints = {arm: joint_addresses(sim.model, arm) for arm in ROBOT.arms}
        self._touching = Touching(sim)
        self.unreached_m, self.unreached = 0.0, ""
        command = sim.arrays["ctrl"][0, sim.action_actuators]
        for arm in ROBOT.arms:
            gains = sim.config.controller_of(arm)
            joints = sim.arrays["qpos"][0, self._joints[arm]]
            lag_s = np.divide(gains.kd_nms_per_rad, gains.kp_nm_per_rad)
            self.joints_rad[arm] = joints
            self._rest[arm] = RestOffset(
                joints, command[ROBOT.joint_slice(arm)].copy(), lag_s
            )

    def action(
        self, arm_targets: Mapping[str, ArmTarget], pushed: Collection[str] = ()
    ) -> np.ndarray:
        """(14,) float32 joint targets [rad] and openings [m] for ``arm_targets`` (arm → its target). The offset of ``pushed``
        (disturbed) arms is not estimated.
        """
        action, qpos = np.empty(ROBOT.num_actions), self.sim.arrays["qpos"][0]
        may_learn = [
            arm
            for arm in ROBOT.arms
            if self.learn and arm not in pushed and not arm_targets[arm].contact
        ]
        still = [arm for arm in may_learn if self._rest[arm].is_still]
        if still:
            self._touching.look(self.sim.state_rows()[0])
        for arm in ROBOT.arms:
            arm_target, rest = arm_targets[arm], self._rest[arm]
            if arm in still and not self._touching.holds_fast(arm):
                rest.see(qpos[self._joints[arm]])
            if arm_target.joints_rad is None:
                joints, error_m = self.kinematics[arm].solve(
                    arm_target.goal, self.joints_rad[arm]
                )
                if error_m > self.unreached_m:
                    self.unreached_m, self.unreached = (
                        error_m,
                        f"{arm} arm: TCP at {np.round(arm_target.goal[:3, 3], 3).tolist()} m",
                    )
            else:
                joints = arm_target.joints_rad
            last = self.joints_rad[arm]
            self.joints_rad[arm] = joints = last + np.clip(
                joints - last, -self._max_step_rad, self._max_step_rad
            )
            action[ROBOT.joint_slice(arm)] = (
                rest.command(joints) if self.learn else joints
            )
            action[ROBOT.gripper_index(arm)] = arm_target.opening_m
        return np.clip(action, ROBOT.action_low, ROBOT.action_high).astype(np.float32)

    def intended(
        self, action: np.ndarray, arm_targets: Mapping[str, ArmTarget]
    ) -> np.ndarray:
        """(14,) float32 the dataset's ``action`` for ``action`` (14,), which was computed for ``arm_targets``: without the error
        of an expert's aim."""
        goals = {
            arm: target.intended
            for arm, target in arm_targets.items()
            if target.intended is not None
        }
        return retargeted(action, self.kinematics, self.joints_rad, goals)


class Attempts:
    """Attempts with one spec and one pool of sources in one simulation. The result of ``run(k)`` does not depend on earlier
    runs."""

    def __init__(self, pool: SourcePool, sim: Simulation, seed: int) -> None:
        self.pool, self.spec, self.sim, self.seed = pool, pool.spec, sim, seed
        self.kinematics = {
            arm: ArmKinematics(arm, sim.config.robot) for arm in ROBOT.arms
        }
        self._feels = self.spec.datagen_config.contact_mode == "closed_loop_expert"
        self._disturbs = self.spec.datagen_config.disturbance.joint_rad > 0
        if self._feels:
            check_closed_loop(self.spec)

    def run(self, k: int) -> Generated:
        """Run attempt ``k``: physics only, without touch and pictures."""
        sim, (scene_seed, rng) = self.sim, attempt_seeds(self.seed, self.spec.task, k)
        sim.reset([scene_seed])
        director = self._director(rng)
        gates, made = GateKeeper(sim), _Physics(sim)
        outcome, reason = act(
            sim, self._targets(director, scene_seed), made, gates.watch
        )
        actions = np.array(made.actions, np.float32).reshape(-1, ROBOT.num_actions)
        intended, last_state = (
            np.array(made.intended, np.float32).reshape(actions.shape),
            state_digest(sim),
        )
        provenance = self._provenance(director, k, scene_seed)
        if outcome == "success":
            gates.see_actions(actions)
            provenance["gates"] = gates.measured.record()
            if refused := gates.measured.refused(self.spec.gates) or foreign_contact(
                sim, np.stack(made.states)
            ):
                outcome, reason = refused
        return Generated(
            attempt=k,
            scene_seed=scene_seed,
            actions=actions,
            intended=intended if self.spec.datagen_config.has_intended else None,
            last_state=last_state,
            provenance=provenance,
            outcome=outcome,
            reason=reason,
        )

    def _director(self, rng: np.random.Generator) -> Director:
        command = self.sim.arrays["ctrl"][0, self.sim.action_actuators]
        return Director(
            self.pool,
            TwinScene(self.sim),
            {arm: float(command[ROBOT.gripper_index(arm)]) for arm in ROBOT.arms},
            rng,
            hz=CONTROL_HZ,
            kinematics=self.kinematics,
            contact_hands=functools.partial(ExpertContact, self.sim)
            if self._feels
            else None,
        )

    def _targets(self, director: Director, scene_seed: int) -> Actions:
        """Raises DeadlockError: the arms wait for each other; UnreachableError: a pose is out of reach."""
        scene, generation, after = TwinScene(self.sim), self.spec.datagen_config, 0
        max_speed, commanded = (
            self.spec.gates.max_joint_speed_radps,
            generation.retarget == "eef_command",
        )
        hands = Hands(
            self.sim,
            self.kinematics,
            max_joint_speed_radps=max_speed,
            learn=not commanded,
        )
        drift = Disturbance(
            generation.disturbance, np.random.default_rng([scene_seed, _DISTURBANCE])
        )
        exact = Exact(self.sim)
        while after < _AFTER_STEPS:
            arm_targets = director.step(scene, hands.joints_rad)
            if self._disturbs:
                drift.update(
                    arm_targets,
                    {arm: director.ahead(arm) for arm in ROBOT.arms},
                    exact.look(),
                )
            action = hands.action(arm_targets, drift.pushed)
            if hands.unreached_m > _UNREACHABLE_M:
                raise UnreachableError(
                    f"{hands.unreached} is out of reach by {hands.unreached_m * 1e3:.1f} mm"
                )
            yield Targets(
                drift.executed(action) if self._disturbs else action,
                hands.intended(action, arm_targets),
            )
            after += director.done

    def _provenance(
        self, director: Director, k: int, scene_seed: int
    ) -> dict[str, object]:
        choices = []
        for (arm, number), choice in sorted(director.choices.items()):
            choices.append(
                {
                    "arm": arm,
                    "subtask": self.spec.signals[arm][number],
                    "source": self.pool.sources[choice.source].name,
                    "rows": [choice.segment.start, choice.segment.end],
                    "delta": np.round(choice.delta, 9).tolist(),
                    "in_hand_correction": np.round(choice.correction, 9).tolist(),
                }
            )
        generation, feels = self.spec.datagen_config, director.contact_hands
        felt = (
            {
                "corrections": [list(event) for event in feels.corrections],
                INTENDED: True,
            }
            if feels
            else {}
        )
        pushed = (
            {"disturbance": asdict(generation.disturbance)} if self._disturbs else {}
        )
        return {
            "attempt": k,
            "seed": self.seed,
            "scene_seed": scene_seed,
            "spec": self.spec.digest,
            "retarget": generation.retarget,
            "contact_mode": generation.contact_mode,
            **felt,
            **pushed,
            "draw": {
                name: np.asarray(value).tolist()
                for name, value in self.sim.draws[0].items()
            },
            "subtasks": choices,
        }
