"""Read sources from a dataset of ``taccorl collect``. Every pose is computed from the stored simulator state.

Needed columns: ``sim.state``, ``sim.seed``, ``sim.subtask``, ``action``. Poses and contacts are computed from the state with
the model of the very twin that the dataset was made in.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import Dataset
from taccorl.data.episode import EXECUTED, Episode
from taccorl.episodes.plan import twin_of_text
from taccorl.episodes.sources.mimicgen.rest import RestOffset, joint_addresses
from taccorl.episodes.sources.mimicgen.source import ArmTrack, Source
from taccorl.episodes.sources.mimicgen.spec import MimicSpec
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.errors import DatasetError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts.kinematics import ArmKinematics

COLUMNS = ("sim.state", "sim.seed", "sim.subtask", "action")
"""Features that a dataset must have to be read as sources."""


def read_sources(root: Path, spec: MimicSpec) -> list[Source]:
    """Read every successful episode of a dataset as a source. Raises DatasetError: the dataset has no simulator state, is of
    another task, or its twin's model has changed."""
    dataset = open_sources(root, spec.task)
    episodes = [dataset.episode(i) for i in range(dataset.num_episodes)]
    kept = [episode for episode in episodes if episode.success]
    if not kept:
        raise DatasetError(
            f"{root}: none of its {len(episodes)} episodes is a success; collect some: taccorl collect"
        )
    reader = SourceReader(simulation_of(kept[0], spec.task))
    return [reader.read(episode) for episode in kept]


def open_sources(root: Path, task: str) -> Dataset:
    """Open a dataset and check that it has the columns that sources need. Reads ``meta/`` only. Raises DatasetError: it is not a
    dataset, has no simulator state, or its arms were disturbed."""
    dataset = Dataset(root)
    missing = [key for key in COLUMNS if key not in dataset.info["features"]]
    if missing:
        raise DatasetError(
            f"{root}: has no {', '.join(missing)}: the poses of objects are unknown, as in every recording of a robot, so that "
            f"it cannot be a source. Collect sources in the twin: taccorl collect --task={task} --out=outputs/{task}"
        )
    made = (
        dataset.episode_facts(0)
        .get("provenance", {})
        .get("simulation", {})
        .get("source")
    )
    is_collected = isinstance(made, dict) and not made.get("hands", {}).get(
        "pulse_rad", 0.0
    )
    if EXECUTED in dataset.info["features"] and not is_collected:
        raise DatasetError(
            f"{root}: its hands deviate from their actions, because its arms were disturbed (--source.hands.pulse_rad, "
            "datagen_config/disturbance) or an expert took over (contact_mode: closed_loop_expert, taccorl correct). Give the "
            "dataset from which it was made, or collect one without pulses"
        )
    return dataset


def simulation_of(episode: Episode, task: str) -> Simulation:
    """Make the simulation in which an episode was collected. Raises DatasetError: the episode is of another task, or does not
    state its simulation."""
    told = episode.provenance.get("simulation")
    if not isinstance(told, dict) or "twin" not in told:
        raise DatasetError(
            f"{episode.name}: does not state in which twin it was made; collect it again"
        )
    if told["task"] != task:
        raise DatasetError(
            f"{episode.name}: is of {told['task']}: --task={told['task']}, or a dataset of {task}"
        )
    return make_simulation(told)


def make_simulation(told: Mapping[str, Any]) -> Simulation:
    """Make the simulation that ``told`` describes with the keys ``task``, ``difficulty``, ``twin`` (text of a twin.yaml) and
    ``randomization``.
    """
    twin = twin_of_text(told["twin"])
    return Simulation(
        tasks.get(told["task"])(told["difficulty"]),
        twin,
        scale=float(told["randomization"]),
    )


class SourceReader:
    """Reads episodes of one simulation as sources. Made once, used for all of them."""

    def __init__(self, sim: Simulation) -> None:
        self.sim = sim
        self.kinematics = {
            arm: ArmKinematics(arm, sim.config.robot) for arm in ROBOT.arms
        }
        self._touching = Touching(sim)

    def read(self, episode: Episode) -> Source:
        """Read one episode as a source. Raises DatasetError: the states are of another scene than this simulation's."""
        states, actions = episode.arrays["sim.state"], episode.executed().astype(float)
        if (
            states.shape[1] != self.sim.row_size
            or (states[:, 0] != self.sim.scene).any()
        ):
            raise DatasetError(
                f"{episode.name}: its states are of another scene than {self.sim.task.name}, {self.sim.task.difficulty}, in "
                "the twin that the episode names: an older version of taccorl made it. Collect it again"
            )
        task, touching, data, num = (
            self.sim.task,
            self._touching,
            self._touching.data,
            len(states),
        )
        objects = {name: np.empty((num, 4, 4)) for name in (*task.parts, *task.clamped)}
        mated, free = (
            {name: np.empty(num, bool) for name in task.parts} for _ in range(2)
        )
        held = {
            arm: {name: np.empty(num, bool) for name in task.parts}
            for arm in ROBOT.arms
        }
        tcp, joints = (
            {arm: np.empty((num, *size)) for arm in ROBOT.arms}
            for size in ((4, 4), (ROBOT.num_joints,))
        )
        holds_fast = {arm: np.empty(num, bool) for arm in ROBOT.arms}
        for t, row in enumerate(states):
            touching.look(row)
            met = {
                name
                for pair in task.mating
                if set(pair) in touching.pairs
                for name in pair
            }
            for name, poses in objects.items():
                poses[t] = _pose(data.body(name))
            for name in task.parts:
                mated[name][t], free[name][t] = name in met, touching.free(name)
            for arm in ROBOT.arms:
                tcp[arm][t] = _pose(data.site(f"{arm}_tcp"))
                joints[arm][t] = data.qpos[joint_addresses(self.sim.model, arm)]
                holds_fast[arm][t] = touching.holds_fast(arm)
                for name in task.parts:
                    held[arm][name][t] = touching.holds(arm, name)
        touched = np.logical_or.accumulate(np.logical_or.reduce(list(mated.values())))
        rest_command = self._command(states[0])
        arms = {}
        for arm in ROBOT.arms:
            own = ROBOT.joint_slice(arm)
            commands = actions[:, own]
            goals = self._goals(
                arm, joints[arm], commands, rest_command[own], touched | holds_fast[arm]
            )
            goal, command = (
                np.stack([self.kinematics[arm].pose(row) for row in rows])
                for rows in (goals, commands)
            )
            arms[arm] = ArmTrack(
                tcp[arm],
                goal,
                goals,
                actions[:, ROBOT.gripper_index(arm)],
                command,
                commands,
            )
        subtask = episode.arrays["sim.subtask"]
        signals = {
            arm: {s.name: subtask[:, a] > k for k, s in enumerate(task.subtasks()[arm])}
            for a, arm in enumerate(ROBOT.arms)
        }
        return Source(episode.name, arms, objects, signals, mated, free, held)

    def _command(self, row: np.ndarray) -> np.ndarray:
        """(14,) the targets in force in a stored state."""
        return self.sim.row_memory(row[None])["targets"][0]

    def _goals(
        self,
        arm: str,
        joints: np.ndarray,
        commands: np.ndarray,
        at_rest: np.ndarray,
        held_back: np.ndarray,
    ) -> np.ndarray:
        """(T, 6) where the commands (T, 6) were to bring the joints (T, 6). Where contact has ``held_back`` (T,) the arm, nothing
        is learnt of its rest."""
        gains = self.sim.config.controller_of(arm)
        rest = RestOffset(
            joints[0], at_rest, np.divide(gains.kd_nms_per_rad, gains.kp_nm_per_rad)
        )
        goals = []
        for now, command, is_held_back in zip(joints, commands, held_back, strict=True):
            if not is_held_back:
                rest.see(now)
            goals.append(rest.goal(command))
        return np.array(goals)


def _pose(part: Any) -> np.ndarray:
    """(4, 4) world pose of MuJoCo's view of a body or a site."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = part.xmat.reshape(3, 3), part.xpos
    return pose
