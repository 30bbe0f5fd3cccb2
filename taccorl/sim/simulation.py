"""N simulations of one task in lock-step on ``mujoco.batch``: reset, control steps, touch, pictures, exact state.

One simulation is the batch with N = 1, so a run is the same bit for bit alone, in a batch and with any number of threads.
Letters in shapes: N simulations, S sub-commands of one control step, A numbers of an action.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.actions import check_actions
from taccorl.sim.blocks import Blocks
from taccorl.sim.controller import MotorEffort
from taccorl.sim.effects.added import AddedEffects, present
from taccorl.sim.effects.history import fill_histories
from taccorl.sim.outcome import Judge
from taccorl.sim.pad import PadArray
from taccorl.sim.randomize import draw
from taccorl.sim.ray_renderer import RayRenderer
from taccorl.sim.rendering import Renderer
from taccorl.sim.scene_digest import scene_digest
from taccorl.sim.seen_scene import SeenScene
from taccorl.sim.task import Reset, Task
from taccorl.sim.twin import CONTROL_HZ, TwinConfig, build_spec
from taccorl.sim.warp_batch import Unsupported, WarpBatch, check_supported, make_batch

SUB_COMMANDS = 5
"""Number of intermediate targets in one control step: targets change linearly, at 150 Hz, since a robot's driver does not jump
either."""
_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
_UNSTABLE = np.array([int(warning) for warning in _WARNINGS])
_ENCODER_ROUNDS = 12  # of a scale 10 % off: 1e-12 rad remain
_BOUND = (
    "qpos",
    "qvel",
    "ctrl",
    "time",
    "xpos",
    "xmat",
    "cvel",
    "subtree_com",
    "site_xpos",
    "site_xmat",
    "geom_xpos",
)
_BOUND += ("geom_xmat", "sensordata", "mocap_pos", "mocap_quat")


@dataclass(frozen=True)
class Snapshot:
    """Complete state of some simulations, from which they continue bit-exactly; one row per simulation."""

    physics: np.ndarray  # (n, nstate) ``mjSTATE_INTEGRATION``: positions, velocities, controls, histories, warm start
    judge: dict[str, np.ndarray]  # Name of each of the judge's counters → (n, …)
    seeds: (
        np.ndarray
    )  # (n,) seeds of the reset draws, which determine friction and masses
    memory: dict[
        str, np.ndarray
    ]  # Name → (n, …): requested targets, and the memory of effects
    scene: np.ndarray
    """(n,) ``scene_digest`` of the scenes: only simulations of the same task, difficulty, twin and randomisation accept the
    snapshot."""

    @classmethod
    def joined(cls, parts: Sequence["Snapshot"]) -> "Snapshot":
        """One snapshot that has the simulations of all ``parts``, one part after the other."""

        def join(values: list[Any]) -> Any:
            if isinstance(values[0], dict):
                return {
                    name: join([value[name] for value in values]) for name in values[0]
                }
            return np.concatenate(values)

        return cls(**join([vars(part) for part in parts]))


@dataclass(frozen=True)
class Watch:
    """Callback after given physics steps of a control step: the numbers of these steps, and the function to call."""

    at: Sequence[int]
    """Numbers of the physics steps, ≥ 1, counted from the start of the control step."""
    see: Callable[[int], None]
    """Function that is called with the number of each of these steps; positions, velocities and sensors are then current."""


class Simulation(SeenScene):
    """N simulations of ``task`` in the twin ``config``. ``scale``: share of the task's reset ranges, 0 … 1; 0 is the nominal
    scene. ``physics``: ``c``, or ``warp`` with ``WarpSettings``. Raises TaccorlError: a size is wrong, a name is unknown, or
    as ``make_batch``."""

    def __init__(
        self,
        task: Task,
        config: TwinConfig | None = None,
        *,
        num_sims: int = 1,
        num_threads: int = 1,
        scale: float = 1.0,
        physics: str = "c",
    ) -> None:
        if num_sims < 1 or num_threads < 0:
            raise TaccorlError(
                f"simulation: num_sims {num_sims} and num_threads {num_threads} must be ≥ 1 and ≥ 0"
            )
        if not (isinstance(scale, int | float) and 0 <= scale <= 1):
            raise TaccorlError(
                f"randomization: {scale!r} is no share of the ranges; give 0 (nominal) … 1 (full)"
            )
        if not (config is None or isinstance(config, TwinConfig)):
            raise TaccorlError(
                f"twin: found {config!r}; give a TwinConfig, or the path of a twin.yaml, or None"
            )
        self.task, self.config, self.num_sims = task, config or TwinConfig(), num_sims
        self.randomization_scale = scale
        self.scene = scene_digest(task, self.config, scale)
        """``scene_digest`` of this scene; a stored state is accepted only if it has the same."""
        self.spec = build_spec(self.config, task)
        self.model = self.spec.compile()
        self.batch = self._batch(num_threads, physics)
        self.blocks = Blocks(self.batch.nthread)
        self.arrays = {name: self.batch.bind(name) for name in _BOUND}
        self.judge = Judge(task, num_sims, CONTROL_HZ)
        self.sensor = self.config.sensor.build(ROBOT.pads)
        layout = replace(
            ROBOT.pad, rows=self.sensor.spec.rows, columns=self.sensor.spec.columns
        )
        self.pads = PadArray(self.model, ROBOT.pads, layout)
        self.effects = AddedEffects(
            self.config.effects, self.arrays["time"], self.batch, layout.shape
        )
        self.sensor.transforms.append(self.effects)
        self.seeds = np.full(num_sims, -1, dtype=np.int64)
        self.draws: list[dict[str, np.ndarray]] = [{} for _ in range(num_sims)]
        self.diverged = np.zeros(num_sims, dtype=bool)
        self.clipped = np.zeros(num_sims, dtype=bool)
        """(N,) bool: the newest action was beyond the limits."""
        self.executed = np.zeros((num_sims, ROBOT.num_actions))
        """(N, A) the newest action, clipped to the limits."""
        self.targets = np.zeros((num_sims, ROBOT.num_actions))
        """(N, A) the newest requested targets; effects may delay them on the way to the controllers."""
        self._renderers: dict[tuple, Renderer] = {}
        self._ray_renderers: dict[tuple, RayRenderer] = {}
        self._index()

    def _batch(self, num_threads: int, physics: str) -> Batch:
        try:
            return make_batch(self.model, self.num_sims, num_threads, physics)
        except Unsupported as error:
            for effect in present(self.config.effects):
                alone = replace(self.config, effects=[effect])
                try:
                    check_supported(build_spec(alone, self.task).compile())
                except Unsupported:
                    raise Unsupported(f"effects: {effect.name}: {error}") from error
            raise

    def _index(self) -> None:
        m = self.model
        self.action_actuators = np.array(
            [m.actuator(name).id for name in ROBOT.action_names]
        )
        self._effort = MotorEffort(self.batch, self.action_actuators)
        self._encoders = np.array(
            [m.sensor(f"{name}_pos").adr[0] for name in ROBOT.action_names]
        )
        self._joint_qpos = {
            arm: np.array([m.joint(f"{arm}_{j}").qposadr[0] for j in ROBOT.joints])
            for arm in ROBOT.arms
        }
        self._fingers = {
            arm: np.array(
                [m.joint(f"{arm}_finger_{f}").qposadr[0] for f in ROBOT.fingers]
            )
            for arm in ROBOT.arms
        }
        self._free = {part: m.joint(part).qposadr[0] for part in self.task.parts}
        self._mocap = {body: m.body(body).mocapid[0] for body in self.task.clamped}
        self._bodies = {
            name: m.body(name).id for name in (*self.task.parts, *self.task.clamped)
        }
        self._tcp_sites = {arm: m.site(f"{arm}_tcp").id for arm in ROBOT.arms}
        self._judged = self._judged_rows()
        owner = m.geom_bodyid
        self._part_geoms = np.flatnonzero(
            np.isin(owner, list(self._bodies.values())) & (m.geom_contype > 0)
        )
        self._friction = self.batch.expand("geom_friction")
        self._mass = {
            name: (m.body_mass[i], m.body_inertia[i].copy())
            for name, i in self._bodies.items()
        }
        self._body_mass, self._body_inertia = (
            self.batch.expand("body_mass"),
            self.batch.expand("body_inertia"),
        )
        touching = [
            [m.sensor(f"{pad}_on_{part}").adr[0] for pad in ROBOT.pads]
            for part in self.task.parts
        ]
        self._touching = {
            part: np.array(row)
            for part, row in zip(self.task.parts, touching, strict=True)
        }
        self._mating = {
            pair: (
                m.sensor("{}_on_{}".format(*pair)).adr[0],
                m.sensor("{}_on_{}_force".format(*pair)).adr[0],
            )
            for pair in self.task.mating
        }

    def _judged_rows(self) -> dict[str, np.ndarray]:
        """Field → its rows that joint states and predicates are computed from: parts, clamped bodies, hands, TCPs, sensors."""
        hands = [self.model.body(f"{arm}_{ROBOT.hand}").id for arm in ROBOT.arms]
        bodies = np.unique([*self._bodies.values(), *hands])
        roots = np.unique(self.model.body_rootid[bodies])
        sites = np.unique(list(self._tcp_sites.values()))
        return {
            "xpos": bodies,
            "xmat": bodies,
            "cvel": bodies,
            "subtree_com": roots,
            "site_xpos": sites,
            "site_xmat": sites,
            "sensordata": np.arange(self.model.nsensordata),
        }

    # reset -----------------------------------------------------------------------------------------------------------

    def reset(
        self, seeds: Sequence[int] | np.ndarray, ids: np.ndarray | None = None
    ) -> None:
        """Draw new scenes, one for each of ``seeds`` (n,). The same seed gives the same scene, bit for bit. ``ids``: (n,)
        simulations that get them, in the order of the seeds; None: all. Raises TaccorlError: the number of seeds differs
        from that of ``ids``, or one is no whole number in 0 … 2⁶³ − 1."""
        ids = np.arange(self.num_sims) if ids is None else np.asarray(ids)
        seeds = checked_seeds(seeds)
        if seeds.shape != ids.shape:
            raise TaccorlError(
                f"reset: {seeds.size} seeds for {ids.size} simulations; give one seed per simulation"
            )
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        for i, seed in zip(ids, seeds, strict=True):
            self._place(int(i), int(seed))
        self.batch.set_const(ids)
        self._settle(ids)
        self.diverged[ids] = self.clipped[ids] = False
        self.judge.reset(ids, self)

    def _settle(self, ids: np.ndarray) -> None:
        """Effects of ``ids`` forget, delayed values included: the controls in force have been so for ever."""
        self.targets[ids] = self.arrays["ctrl"][ids][:, self.action_actuators]
        self.effects.reset(ids, self.targets, self.seeds[ids])
        fill_histories(self.batch, ids)
        self.batch.forward(ids)
        self.effects.feel(ids, 0.0)

    def _place(self, i: int, seed: int) -> None:
        """Write the scene of ``seed`` into simulation ``i``: its model's random fields and its state."""
        self.seeds[i] = seed
        self.draws[i] = draw(
            self.task.rows, np.random.default_rng(seed), self.randomization_scale
        )
        scene = self.task.reset(self.draws[i])
        self._write_model(i, scene)
        qpos = self.arrays["qpos"]
        for part, at in self._free.items():
            qpos[i, at : at + 7] = scene.poses[part]
        for body, slot in self._mocap.items():
            self.arrays["mocap_pos"][i, slot], self.arrays["mocap_quat"][i, slot] = (
                np.split(scene.poses[body], [3])
            )
        for arm in ROBOT.arms:
            home = np.array(self.task.home_rad[arm])
            qpos[i, self._joint_qpos[arm]] = home
            # The arm rests T_ref / K_p away from its target, so that it stands still where it stands.
            controller = self.config.controller_of(arm)
            rest = np.array(controller.torque_ff_nm) / np.array(
                controller.kp_nm_per_rad
            )
            opening_m = ROBOT.action_high[ROBOT.gripper_index(arm)]
            controls = self.arrays["ctrl"][i]
            controls[self.action_actuators[ROBOT.joint_slice(arm)]] = home - rest
            controls[self.action_actuators[ROBOT.gripper_index(arm)]] = opening_m
            qpos[i, self._fingers[arm]] = ROBOT.finger_stroke_m

    def place_arms(self, joints: np.ndarray, targets: np.ndarray) -> None:
        """Put the arms of every simulation at rest at ``joints`` (A,) [rad, m], with the commands ``targets`` (A,) in force."""
        qpos, qvel = self.arrays["qpos"], self.arrays["qvel"]
        joints = self._true(joints)
        for arm in ROBOT.arms:
            qpos[:, self._joint_qpos[arm]] = joints[ROBOT.joint_slice(arm)]
            qpos[:, self._fingers[arm]] = joints[ROBOT.gripper_index(arm)] / 2
        qvel[:] = 0.0
        self.arrays["ctrl"][:, self.action_actuators] = targets
        self._settle(np.arange(self.num_sims))

    def _true(self, reported: np.ndarray) -> np.ndarray:
        """Where joints and grippers (A,) are when their encoders report ``reported``: fixed point, encoders are nearly right."""
        true = reported
        for _ in range(_ENCODER_ROUNDS):
            true = true + (reported - self.effects.encoder(true[None])[0])
        return true

    def _write_model(self, i: int, scene: Reset) -> None:
        self._friction[i, self._part_geoms, 0] = self.effects.friction(scene.friction)
        for name, (mass, inertia) in self._mass.items():
            body, change = self._bodies[name], scene.mass_change_kg.get(name, 0.0)
            self._body_mass[i, body] = mass + change
            self._body_inertia[i, body] = (
                inertia * ((mass + change) / mass) if mass > 0 else inertia
            )

    # stepping --------------------------------------------------------------------------------------------------------

    def step(
        self,
        action: np.ndarray,
        ids: np.ndarray | None = None,
        watch: Watch | None = None,
        *,
        lean: bool = False,
    ) -> None:
        """One control step (1/30 s) with targets ``action`` (N, A) [rad, m], linearly interpolated over the step.

        Simulations outside ``ids`` (all by default) are frozen, with their targets and outcomes; their rows are not used.
        ``watch`` is called after physics steps within the control step; it must not change the state. ``lean``: on a GPU only
        proprioception and outcomes are current afterwards, until ``refresh``."""
        goal = self._checked(action, ids)
        now = self.targets.copy()
        line = np.arange(1, SUB_COMMANDS + 1)[:, None, None] / SUB_COMMANDS
        commands = now + (goal - now) * line
        commands[-1] = goal  # exactly, not to rounding
        self.advance(
            commands,
            self.config.physics.steps_per_control_step // SUB_COMMANDS,
            ids,
            watch,
            lean=lean,
        )
        self.judge.update(self, ids)

    def refresh(self) -> None:
        """Make everything current after ``lean`` steps."""
        if isinstance(self.batch, WarpBatch):
            self.batch.refresh()

    def advance(
        self,
        commands: np.ndarray,
        num_steps: int,
        ids: np.ndarray | None = None,
        watch: Watch | None = None,
        *,
        lean: bool = False,
    ) -> None:
        """Physics only: ``commands`` (S, N, A) [rad, m] are S targets, each held for ``num_steps`` physics steps. For replay and
        recording.

        ``ids``, ``watch`` and ``lean``: as ``step``; steps are counted over all S targets."""
        stepped = (
            np.arange(self.num_sims) if ids is None else np.arange(self.num_sims)[ids]
        )
        arrive = self._send(commands, num_steps, ids)
        num = len(commands) * num_steps
        scans = self._scan_steps(stepped, num) if self.effects.remember_touch else {}
        in_parts = watch is not None or bool(scans) or self.effects.rewrites
        batch = self.batch
        if isinstance(batch, WarpBatch) and batch.is_resident and not in_parts:
            fields = self._judged if lean and not self.effects.past else None
            targets_SNA = np.stack(arrive)
            batch.step_targets(
                ids, self.action_actuators, targets_SNA, num_steps, fields
            )
            self._sound(ids, at_end=True)
        else:
            self._advance_in_parts(arrive, num_steps, ids, watch, scans)
        if self.effects.past:
            self.effects.past.keep()

    def _advance_in_parts(
        self,
        arrive: list[np.ndarray],
        num_steps: int,
        ids: np.ndarray | None,
        watch: Watch | None,
        scans: dict[int, np.ndarray],
    ) -> None:
        """Physics up to each change of a target, each scan of the pads and each step that is watched."""
        stepped = (
            np.arange(self.num_sims) if ids is None else np.arange(self.num_sims)[ids]
        )
        watched = set(watch.at) if watch else set()
        total = len(arrive) * num_steps
        done = 0
        step_by_step = 1 if self.effects.rewrites else num_steps
        for end in sorted(
            {*range(step_by_step, total + 1, step_by_step), *watched, *scans}
        ):
            self.arrays["ctrl"][stepped[:, None], self.action_actuators] = arrive[
                done // num_steps
            ][stepped]
            stages = mujoco.mjtStage
            all_of_it = end == total or self.effects.rewrites
            is_seen = end in watched or end in scans
            stage = (
                stages.mjSTAGE_ACC
                if all_of_it
                else stages.mjSTAGE_VEL
                if is_seen
                else stages.mjSTAGE_NONE
            )
            self.batch.step(ids, nstep=end - done, stage=stage)
            done = end
            ids = self._sound(ids, at_end=all_of_it)
            if self.effects.rewrites:
                self.effects.feel(
                    stepped if ids is None else ids, self.config.physics.timestep_s
                )
            if end in scans:
                self._scan(
                    scans[end] if ids is None else np.intersect1d(scans[end], ids)
                )
            if watch and end in watched:
                watch.see(end)

    def _scan_steps(self, ids: np.ndarray, num_steps: int) -> dict[int, np.ndarray]:
        """Physics step of the next ``num_steps`` → simulations of ``ids`` whose boards scan the pads after it.

        Effects with a memory advance at the boards' own rate, counted from an episode's begin, as they are fitted."""
        step_s = self.config.physics.timestep_s
        done = np.rint(self.arrays["time"][ids] / step_s)
        per_step = self.sensor.spec.rate_hz * step_s
        scans = [
            np.floor((done + step) * per_step + 1e-6) for step in range(num_steps + 1)
        ]
        due = {
            step: ids[scans[step] > scans[step - 1]] for step in range(1, num_steps + 1)
        }
        return {step: chosen for step, chosen in due.items() if chosen.size}

    def _scan(self, ids: np.ndarray) -> None:
        """The pads of ``ids`` are scanned, whether somebody looks or not."""
        if ids.size:
            self.effects.scan(
                self.sensor.reading(*self.pads.touch(self.batch), None), ids
            )

    def _sound(self, ids: np.ndarray | None, *, at_end: bool) -> np.ndarray | None:
        """Those of ``ids`` that have not diverged. A simulation of NaNs would cost twenty times a sound one's time.

        Before the end of a control step MuJoCo's own warnings are enough: it checks the state at the beginning of a step."""
        qvel, qpos, warned = (
            self.arrays["qvel"],
            self.arrays["qpos"],
            self.batch.warning[:, _UNSTABLE, 1],
        )
        if not warned.any() and not (
            at_end and not (np.isfinite(qvel).all() and np.isfinite(qpos).all())
        ):
            return ids
        finite = np.isfinite(qvel).all(1) & np.isfinite(qpos).all(1)
        bad = ~finite | warned.any(1)
        self.diverged |= bad
        ids = np.arange(self.num_sims) if ids is None else np.arange(self.num_sims)[ids]
        return ids[~bad[ids]]

    def _send(
        self, commands: np.ndarray, num_steps: int, ids: np.ndarray | None
    ) -> list[np.ndarray]:
        """What of S targets (S, N, A), each held for ``num_steps`` physics steps, reaches the controllers."""
        held_s, sent = np.zeros(self.num_sims), slice(None) if ids is None else ids
        held_s[sent] = num_steps * self.config.physics.timestep_s
        self.targets[sent] = commands[-1][sent]
        return [self.effects.command(command, held_s) for command in commands]

    def _checked(self, action: np.ndarray, ids: np.ndarray | None) -> np.ndarray:
        """``action`` (N, A) within the limits; kept as what ``ids`` execute."""
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.num_sims, ROBOT.num_actions):
            raise TaccorlError(
                f"action: shape {action.shape}, but the twin requires ({self.num_sims}, {ROBOT.num_actions}): "
                f"{', '.join(ROBOT.action_names)}"
            )
        check_actions(action)
        goal = np.clip(action, ROBOT.action_low, ROBOT.action_high)
        sent = slice(None) if ids is None else ids
        self.clipped[sent] = (goal != action).any(1)[sent]
        self.executed[sent] = goal[sent]
        return goal

    # state -----------------------------------------------------------------------------------------------------------

    def snapshot(self, ids: np.ndarray | None = None) -> Snapshot:
        """Complete state of the simulations ``ids`` (n,) (all by default), for ``restore``."""
        ids = np.arange(self.num_sims) if ids is None else np.asarray(ids)
        memory = self.effects.snapshot(ids) | {"targets": self.targets[ids].copy()}
        scene = np.full(len(memory["targets"]), self.scene)
        return Snapshot(
            self.batch.state[ids].copy(),
            self.judge.snapshot(ids),
            self.seeds[ids].copy(),
            memory,
            scene,
        )

    def check_snapshot(self, snapshot: Snapshot, ids: np.ndarray | None = None) -> None:
        """Check that ``restore`` accepts the snapshot for the simulations ``ids`` (n,) (all by default). Raises TaccorlError:
        as ``restore``."""
        ids = np.arange(self.num_sims) if ids is None else np.asarray(ids)
        if not isinstance(snapshot, Snapshot):
            raise TaccorlError(
                f"state: {snapshot!r} is not a Snapshot; give the result of sim.snapshot()"
            )
        if snapshot.physics.shape != (len(ids), self.batch.nstate):
            raise TaccorlError(
                f"restore: states of shape {snapshot.physics.shape} do not fit {len(ids)} simulations of task {self.task.name} "
                f"with {self.batch.nstate} numbers each; they are states of another task or twin"
            )
        kept, own = (
            {key for key in memory if "/" in key}
            for memory in (snapshot.memory, self.effects.snapshot(ids))
        )
        if kept != own:
            raise TaccorlError(
                f"restore: the state contains the memory of {', '.join(sorted(kept)) or 'nothing'}, but this twin's effects "
                f"need that of {', '.join(sorted(own)) or 'nothing'}; the state is of another twin"
            )
        self._check_scene(snapshot.scene, snapshot.seeds, ids)

    def _check_scene(
        self, scenes: np.ndarray, seeds: np.ndarray, ids: np.ndarray
    ) -> None:
        if scenes.shape != ids.shape or seeds.shape != ids.shape:
            raise TaccorlError(
                f"restore: {len(seeds)} seeds of {len(scenes)} states for {len(ids)} simulations"
            )
        checked_seeds(seeds)
        if (scenes != self.scene).any():
            effects = (
                ", ".join(effect.name for effect in self.effects.present) or "none"
            )
            raise TaccorlError(
                "restore: the state is of another task, difficulty, twin or randomisation than this simulation's: "
                f"{self.task.name}, {self.task.difficulty}, effects {effects}, randomisation {self.randomization_scale:g}. "
                "Make a simulation with the same settings as that of the state"
            )

    def restore(self, snapshot: Snapshot, ids: np.ndarray | None = None) -> None:
        """Put the simulations ``ids`` (n,) (all by default) into the snapshot's n states, in their order. Raises TaccorlError:
        the number of states differs from that of ``ids``, or they are of another task, difficulty, twin or randomisation.
        The simulation is then unchanged."""
        ids = np.arange(self.num_sims) if ids is None else np.asarray(ids)
        self.check_snapshot(snapshot, ids)
        for i, seed in zip(ids, snapshot.seeds, strict=True):
            self._place(int(i), int(seed))
        self.batch.set_const(ids)
        self.batch.state[ids] = snapshot.physics
        self.effects.restore(snapshot.memory, ids)
        self.batch.forward(ids)
        self.batch.state[ids] = (
            snapshot.physics
        )  # forward() has written its own warm start
        self.targets[ids] = snapshot.memory["targets"]
        self.judge.restore(snapshot.judge, ids, self)
        self.diverged[ids] = self.clipped[ids] = False

    @property
    def row_size(self) -> int:
        """Length of a row of ``state_rows``."""
        return self.state_rows(np.array([0])).shape[1]

    def state_rows(self, ids: np.ndarray | None = None) -> np.ndarray:
        """(n, row_size) float64 states of the simulations ``ids`` (n,) (all by default) as stored in a dataset: ``scene_digest``,
        physics state, memory of effects.

        Together with the seed, which determines friction and masses, a row restores the simulation bit-exactly except for the
        judge's counters."""
        snapshot = self.snapshot(ids)
        memory = [
            snapshot.memory[name].reshape(len(snapshot.physics), -1)
            for name in sorted(snapshot.memory)
        ]
        return np.concatenate(
            [snapshot.scene[:, None], snapshot.physics, *memory], axis=1
        )

    def restore_rows(
        self,
        rows: np.ndarray,
        seeds: Sequence[int] | np.ndarray,
        ids: np.ndarray | None = None,
    ) -> None:
        """Put the simulations ``ids`` (n,) (all by default) into the stored states ``rows`` (n, row_size), with the scene seeds
        ``seeds`` (n,); the outcome counters restart. Raises TaccorlError: the rows are of another task, difficulty, twin or
        randomisation. The simulation is then unchanged."""
        ids = np.arange(self.num_sims) if ids is None else np.asarray(ids)
        rows = np.asarray(rows, dtype=np.float64)
        if rows.shape != (len(ids), self.row_size):
            raise TaccorlError(
                f"restore: rows of shape {rows.shape} do not fit {len(ids)} simulations of task {self.task.name} with "
                f"{self.row_size} numbers each; they are states of another task, or of a twin with other effects"
            )
        seeds = checked_seeds(seeds).reshape(-1)
        judge = self.judge.snapshot(ids)
        scene, physics, _ = np.split(rows, [1, 1 + self.batch.nstate], axis=1)
        self.restore(
            Snapshot(physics, judge, seeds, self.row_memory(rows), scene[:, 0]), ids
        )
        self.judge.reset(ids, self)

    def row_memory(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """``Snapshot.memory`` from stored ``rows`` (n, row_size): name → (n, …)."""
        now, memory, at = self.snapshot(np.array([0])).memory, {}, 1 + self.batch.nstate
        for name in sorted(now):
            one = now[name][0]
            memory[name] = (
                rows[:, at : at + one.size]
                .reshape(len(rows), *one.shape)
                .astype(one.dtype)
            )
            at += one.size
        return memory


def checked_seeds(seeds: int | Sequence[int] | np.ndarray) -> np.ndarray:
    """Scene seeds as int64, with the shape of ``seeds``. Raises TaccorlError: one is no whole number in 0 … 2⁶³ − 1."""
    for seed in np.asarray(seeds, dtype=object).reshape(-1):
        if (
            isinstance(seed, bool)
            or not isinstance(seed, int | np.integer)
            or not 0 <= seed < 2**63
        ):
            raise TaccorlError(f"seed: {seed!r} is no whole number in 0 … 2^63 - 1")
    return np.asarray(seeds, dtype=np.int64)
