"""Record a demonstration in the twin as an ``Episode``: observations, actions, and the simulator's state.

A row is the observation before an action, and the action: the target that is reached at the next row (``action_time: next_row``).
Pictures are drawn afterwards, row by row, from the stored states: only what is kept costs rendering, and a dataset can be
rendered again.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taccorl.data.episode import EXECUTED, Episode, Pictures
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.data.spec import DatasetSpec, FeatureSpec, find_spec, load_dataset_spec
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import (
    PARTS_KEY,
    POSE_UNITS,
    part_pose_names,
    part_poses,
    posed_bodies,
)
from taccorl.sim.simulation import Simulation, Watch
from taccorl.sim.trajectory import DenseRecorder, Trajectory


def told_origin(origin: Origin) -> dict[str, Any]:
    """Return the keys of a simulation's description that state its origin; ``origin_told`` reads them.

    The domain of the twin is left out: the store's keys of attempts that were made before there was a domain stay valid.
    """
    return {"origin": origin.text} | (
        {} if origin.domain == TWIN_ORIGIN.domain else {"domain": origin.domain}
    )


def origin_told(simulation: Mapping[str, Any]) -> Origin:
    """Origin stated by a simulation's description."""
    return Origin(
        simulation.get("domain", TWIN_ORIGIN.domain),
        simulation.get("origin", TWIN_ORIGIN.text),
    )


_ANY = (-1e12, 1e12)
_REACH = (-10.0, 10.0)  # [m] a part that fell off the table is still within it
PICTURE = "observation.images."
"""Beginning of the keys of picture features."""


def row_spec(
    sim: Simulation, *, pictures: bool, executed: bool = False, parts: bool = False
) -> DatasetSpec:
    """Data spec of the twin's rows: the robot's features and the simulator's own: state, seed, subtask of each arm, success.

    ``sim.state`` has the size of the task's scene, so datasets of different tasks merge only without it. ``executed``: rows also
    hold the executed targets (``sim.executed``), because ``action`` holds the intended ones. ``parts``: rows also hold the poses
    of the task's parts (``part_poses``)."""
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    own = {"unit": "1", "frame": "simulator", "rate_hz": float(spec.fps)}
    features = {
        key: feature
        for key, feature in spec.features.items()
        if not feature.optional and (pictures or feature.dtype != "video")
    }
    if pictures:
        sim.require_cameras(
            [
                key.removeprefix(PICTURE)
                for key, f in features.items()
                if f.dtype == "video"
            ]
        )
    features |= {
        "sim.state": FeatureSpec(
            dtype="float64", shape=(sim.row_size,), range=_ANY, **own
        ),
        "sim.seed": FeatureSpec(dtype="int64", shape=(1,), range=(0, 2**62), **own),
        "sim.subtask": FeatureSpec(
            dtype="int16",
            shape=(len(ROBOT.arms),),
            range=(0, 99),
            names=ROBOT.arms,
            **own,
        ),
        "sim.success": FeatureSpec(dtype="int16", shape=(1,), range=(0, 1), **own),
    }
    if parts:
        names = part_pose_names(sim.task)
        features[PARTS_KEY] = FeatureSpec(
            dtype="float32",
            shape=(len(names),),
            unit=POSE_UNITS * len(posed_bodies(sim.task)),
            frame="world",
            rate_hz=float(spec.fps),
            range=_REACH,
            names=names,
            optional=True,
        )
    if executed:
        features[EXECUTED] = spec.features["action"]
    return dataclasses.replace(spec, features=features)


@dataclass
class EpisodeRecorder:
    """Steps simulation 0 and records the rows of an episode. Make a new one after each reset."""

    sim: Simulation
    spec: DatasetSpec  # Data spec of the rows, from ``row_spec``
    sensor_rng: np.random.Generator | None = (
        None  # Random generator of the pads' noise; None: a noiseless sensor
    )
    dense: bool = False
    """True: also keep a trajectory at 200 Hz, from which a recording in the format of the drivers is made."""
    rows: list[dict[str, np.ndarray]] = field(
        default_factory=list
    )  # Recorded rows: feature → value
    physics_s: float = 0.0  # Wall time of the physics in all steps so far [s]
    touch_s: float = 0.0  # Wall time of touch in all steps so far [s]

    def __post_init__(self) -> None:
        self._dense = DenseRecorder(self.sim) if self.dense else None

    def step(
        self,
        action: np.ndarray,
        watch: Watch | None = None,
        intended: np.ndarray | None = None,
    ) -> None:
        """Record one row and make one control step with ``action`` (14,) [rad, m]. The action is rounded to float32 before it is
        executed, so that the executed action is the stored one. ``watch``: callback for physics steps in between; only without
        ``dense``. ``intended``: (14,) the row's ``action``, if it differs from the executed one, which is then stored as
        ``sim.executed``."""
        action = np.asarray(action, dtype=np.float32)
        sim = self.sim
        began_s = time.perf_counter()
        touch = sim.touch(self.sensor_rng)[0]
        self.touch_s += time.perf_counter() - began_s
        row = {
            "observation.state": sim.proprioception()[0].astype(np.float32),
            "observation.tactile": touch,
            "sim.state": sim.state_rows(np.array([0]))[0],
            "sim.seed": sim.seeds[:1].copy(),
            "sim.subtask": sim.judge.subtask[0].astype(np.int16),
        }
        if PARTS_KEY in self.spec.features:
            row[PARTS_KEY] = part_poses(sim)[0]
        began_s = time.perf_counter()
        sim.step(
            action[None].astype(np.float64),
            watch=self._dense.watch() if self._dense else watch,
        )
        self.physics_s += time.perf_counter() - began_s
        row["action"] = sim.executed[0].astype(np.float32)
        if intended is not None:
            row[EXECUTED], row["action"] = (
                row["action"],
                np.asarray(intended, np.float32),
            )
        row["sim.success"] = sim.judge.success[:1].astype(np.int16)
        self.rows.append(row)

    def trajectory(self) -> Trajectory:
        """The recorded trajectory at 200 Hz."""
        assert self._dense is not None, "make the recorder with dense=True"
        return self._dense.trajectory()

    def episode(self, name: str, simulation: dict[str, Any]) -> Episode:
        """All recorded rows as an episode of the origin that ``simulation`` states. It is stored in the episode's provenance."""
        arrays = {
            key: np.stack([row[key] for row in self.rows]) for key in self.rows[0]
        }
        outcome = self.sim.judge.outcome
        keys = tuple(key for key in self.spec.keys("video"))
        return Episode(
            name=name,
            spec=self.spec,
            start_ns=0,
            arrays=arrays,
            pictures=lambda: self._pictures(arrays["sim.state"], keys),
            picture_keys=keys,
            instruction=self.sim.task.instruction,
            success=bool(outcome.success[0]),
            origin=origin_told(simulation),
            baselines={"observation.tactile": self.sim.sensor.baseline.reshape(-1)},
            stages=tuple(self._stages(arrays["sim.subtask"])),
            provenance={"recording": name, "simulation": simulation},
        )

    def _pictures(
        self, states: np.ndarray, keys: tuple[str, ...]
    ) -> Iterator[Pictures]:
        cameras = [key.removeprefix(PICTURE) for key in keys]
        for images in self.sim.render_states(states, cameras):
            yield {PICTURE + camera: image for camera, image in images.items()}

    def _stages(self, subtask: np.ndarray) -> Iterator[tuple[int, str]]:
        """(first row, "right: insert plug") wherever an arm begins another subtask."""
        subtasks = self.sim.task.subtasks()
        for row in np.flatnonzero(
            np.any(np.diff(subtask, axis=0, prepend=-1) != 0, axis=1)
        ):
            now = [
                f"{arm}: {subtasks[arm][k].name if k < len(subtasks[arm]) else 'done'}"
                for arm, k in zip(ROBOT.arms, subtask[row], strict=True)
            ]
            yield int(row), ", ".join(now)
