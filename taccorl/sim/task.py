"""Base class and registry of tasks: parts on the bench, reset distribution, predicates on the simulator's state, subtasks.

Each task is a folder of ``taccorl/tasks``, or an outside package; the simulation finds it by its registration.

Letters in shapes: N simulations.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol

import mujoco
import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.sim.randomize import Row

CLEARANCES_M = {"easy": 0.0010, "train": 0.0005, "hard": 0.0003}
"""Difficulty → clearance on each side between mating parts [m]. (A D415 pixel is 3.7 mm at 0.6 m after scaling to 224.)"""
HOLD_S = 0.5  # a goal counts when it has held this long after release
AT_REST_MPS = 0.02  # a part that moves faster than this against its holder is in flight


class Scene(Protocol):
    """Input of the predicates: the privileged state of N simulations after a control step."""

    num_sims: int

    def poses(self, body: str) -> np.ndarray:
        """World-from-body poses (N, 4, 4) of a body."""
        ...

    def velocities(self, body: str) -> np.ndarray:
        """Linear velocity of the origin of the body's frame, in world coordinates (N, 3) [m/s]."""
        ...

    def pads_touching(self, body: str) -> np.ndarray:
        """(N, 4) bool for N simulations: which pads touch the body, in the order left_a, left_b, right_a, right_b."""
        ...

    def contact(self, body: str, other: str) -> "Contact":
        """Contact between two bodies, arrays (N,); the task must declare the pair in ``mating``."""
        ...


@dataclass(frozen=True)
class Contact:
    """Contact of one pair of bodies: deepest penetration [m], net force [N] and whether they touch, each (N,)."""

    touching: np.ndarray
    penetration_m: np.ndarray
    """Deepest penetration [m], ≥ 0."""
    force_n: np.ndarray
    """Magnitude of the net normal force [N]."""


@dataclass(frozen=True, kw_only=True)
class Subtask:
    """One segment of one arm's motion; it ends when ``done`` becomes true.

    The task's MimicGen spec states its reference body, the held body and the order between the arms."""

    name: str
    done: Callable[[Scene], np.ndarray]
    """Predicate that ends the subtask: (N,) bool for a ``Scene``."""


@dataclass(frozen=True)
class Verdict:
    """Values of a task's predicates at one instant. ``Judge`` decides from them when a goal or failure has held long enough."""

    goal: np.ndarray
    """(N,) bool: the part is in place and at rest, and no pad touches it."""
    failures: dict[str, np.ndarray]
    """Category of ``Task.failures`` → (N,) bool: its condition is met at this instant."""
    partial: np.ndarray
    """(N,) int: number of the task's goals that are in place (puzzle: 0–3)."""
    measures: dict[str, np.ndarray] = field(default_factory=dict)
    """Name with unit → (N,) value, for reports and privileged state."""


@dataclass(frozen=True, kw_only=True)
class Reset:
    """Initial scene of an episode: poses of the parts, changes of their masses, friction."""

    poses: dict[str, np.ndarray]
    """Part or clamped body → world pose (7,): position [m], quaternion wxyz."""
    mass_change_kg: dict[str, float] = field(default_factory=dict)
    """Part → change of its mass relative to the model [kg]."""
    friction: float = 0.5
    """Sliding friction of every part."""


class Task(ABC):
    """A scene with a goal: parts, randomisation at reset, predicates of success and failure, subtasks of the arms. Subclasses
    register with ``@tasks.register("name")``."""

    name: ClassVar[str]
    instruction: ClassVar[str]
    """The sentence that the policy reads."""
    parts: ClassVar[tuple[str, ...]]
    """Movable bodies, each with a free joint of its own name."""
    clamped: ClassVar[tuple[str, ...]] = ()
    """Bodies clamped to the bench (mocap) whose pose is drawn at reset."""
    mating: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Pairs of bodies whose contact is measured for predicates and reports."""
    max_partial: ClassVar[int] = 1
    """Number of the task's goals."""
    time_limit_s: ClassVar[float] = 30.0
    """Simulated time after which an episode fails as ``timeout`` [s]."""
    failures: ClassVar[dict[str, float]] = {"dropped": 0.0}
    """Failure category that ``look`` may return → time [s] for which its condition must last. ``timeout`` and ``diverged`` are
    added to every task."""
    home_rad: ClassVar[dict[str, tuple[float, ...]]]
    """Arm → six joint angles at reset [rad]; grippers are open."""
    rows: ClassVar[tuple[Row, ...]] = ()
    """Randomisation at reset; values of the paper's table "Domain randomization parameter values" (App. E) in its four tasks."""
    expert: ClassVar[str | None] = None
    """Scripted expert as ``module:Class``, a class of ``taccorl.tasks.experts.ScriptedExpert``; imported on first use. None: the
    task has no expert."""
    mimicgen: ClassVar[Path | None] = None
    """MimicGen spec, a YAML file (``taccorl/episodes/sources/mimicgen/spec.py``); None: ``augment`` does not support the task."""

    def __init__(self, difficulty: str = "train") -> None:
        if difficulty not in CLEARANCES_M:
            raise TaccorlError(
                f"task {self.name}: no difficulty {difficulty!r}; {nearest(difficulty, CLEARANCES_M)}"
            )
        self.difficulty = difficulty
        self.clearance_m = CLEARANCES_M[difficulty]

    @abstractmethod
    def add_parts(self, spec: mujoco.MjSpec) -> None:
        """Add the parts at their nominal poses to the model of the bench."""

    @abstractmethod
    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        """Initial scene for one draw of ``rows``: name of the row → its values (components,)."""

    @abstractmethod
    def look(self, scene: Scene) -> Verdict:
        """Evaluate the predicates of success and failure."""

    @abstractmethod
    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        """Arm → its subtasks, in order."""


tasks: Registry[type[Task]] = Registry("task", "taccorl.tasks")


def at_rest(scene: Scene, part: str, holder: str) -> np.ndarray:
    """(N,) bool: the body ``part`` moves slower than 20 mm/s relative to the body ``holder``."""
    off = scene.velocities(part) - scene.velocities(holder)
    return np.einsum("ni,ni->n", off, off) < AT_REST_MPS**2


def fell(pose: np.ndarray) -> np.ndarray:
    """(N,) bool: the body with the world poses ``pose`` (N, 4, 4) is below the table's top or beyond its edge."""
    x, y, z = pose[:, :3, 3].T
    return (z < -0.02) | (np.abs(y) > 0.7) | (x < -0.15) | (x > 0.85)
