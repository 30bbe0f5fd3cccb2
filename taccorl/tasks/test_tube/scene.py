"""Test Tube Insertion: a lying tube is lifted, turned upright and let go in the middle hole of a rack that the other hand holds.

The tube lies in a clamped stand, its bottom towards −y; stand and tube are drawn together. The rack stands free on the table,
its handle towards the left arm. Failures: the paper's failure analysis.
"""

import math
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.sim.part import Fit, Part, add_part, measure_fit, on_table
from taccorl.sim.randomize import OBJECT_FRICTION, symmetric
from taccorl.sim.task import (
    AT_REST_MPS,
    Reset,
    Scene,
    Subtask,
    Task,
    Verdict,
    fell,
    tasks,
)
from taccorl.tasks.test_tube.parts import glass_tube, tube_rack, tube_stand

TUBE_AT_M, TUBE_YAW_RAD = (
    (0.175, -0.315),
    np.pi / 2,
)  # of the tube's middle; heading from its bottom to its cap
RACK_AT_M, RACK_YAW_RAD = (0.400, 0.035), -np.pi / 2  # nominal; the handle looks to +y
TUBE_MIDDLE_M = 0.050  # along the tube, from its bottom
_HOLE = "middle"
_IN_DEPTH_M, _IN_LATERAL_M, _IN_TILT_RAD = 0.040, 0.003, np.deg2rad(5.0)
_RIM_M = (
    0.006  # less deep is not in the hole: of the tube's round bottom 8 mm are its own
)
_CELL_M = 0.013  # half the distance of two holes: farther off is another hole's
_LIFTED_M = 0.070  # of the tube's middle: 30 mm above where it lies
_LYING_M = 0.030  # lower than the stand holds the tube's middle, and half as high as the rack does
_UPRIGHT_RAD = np.deg2rad(8.0)
_MOVED_M = 0.025  # from the nominal place: at least 20 mm from where it stood, for it is drawn within 5 mm


@tasks.register("test_tube")
class TestTube(Task):
    """Task: one hand steadies the rack, the other inserts the tube."""

    __test__ = False  # pytest: not a test, whatever it is called

    name = "test_tube"
    instruction = "pick up the test tube and insert it into the middle hole of the rack"
    parts = ("tube", "rack")
    clamped = ("stand",)
    mating = (("tube", "rack"),)
    failures = {  # noqa: RUF012
        "dropped": 0.5,
        "rack moved": 0.0,
        "rim": 0.5,
        "jam": 0.5,
        "missed": 0.5,
    }
    home_rad = {  # noqa: RUF012
        "left": (-0.085, 2.021, -1.094, -0.582, 0.784, -1.228),
        "right": (0.636, 1.815, -0.673, -0.497, 0.873, -0.544),
    }
    rows = (
        OBJECT_FRICTION,
        symmetric("tube_position", (0.02, 0.02), "m"),
        symmetric("tube_yaw", math.radians(20), "rad"),
        symmetric("holder_position", (0.005, 0.005), "m"),
    )
    expert = f"{__package__}.expert:TestTubeExpert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        self.tube: Part = glass_tube("tube")
        self.rack: Part = tube_rack("rack", self.clearance_m)
        self.stand: Part = tube_stand("stand")

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        for part in (self.tube, self.rack, self.stand):
            add_part(spec, part)

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        yaw = TUBE_YAW_RAD + float(draw["tube_yaw"][0])
        along = np.array([np.cos(yaw), np.sin(yaw)])
        # The stand's origin is below the tube's bottom; both turn about the tube's middle.
        stand = on_table(
            self.stand, TUBE_AT_M + draw["tube_position"] - TUBE_MIDDLE_M * along, yaw
        )
        return Reset(
            poses={
                "stand": stand,
                "tube": in_seat(stand, self.stand.seats["tube"]),
                "rack": on_table(
                    self.rack, RACK_AT_M + draw["holder_position"], RACK_YAW_RAD
                ),
            },
            friction=float(draw["friction"][0]),
        )

    def fit(self, scene: Scene) -> Fit:
        """Pose error of the tube in the middle hole, arrays (N,) for N simulations."""
        mate = self.tube.mate
        assert mate is not None
        hole = scene.poses("rack") @ self.rack.holes[_HOLE].part_from_hole
        return measure_fit(
            hole, scene.poses("tube") @ mate.part_from_mate, mate.num_turns
        )

    def inside(self, fit: Fit) -> np.ndarray:
        """(N,) bool: tubes with these pose errors are deep enough in the hole."""
        upright = fit.tilt_rad < _IN_TILT_RAD
        return (fit.depth_m >= _IN_DEPTH_M) & upright & (fit.lateral_m < _IN_LATERAL_M)

    def look(self, scene: Scene) -> Verdict:
        tube, rack, fit = scene.poses("tube"), scene.poses("rack"), self.fit(scene)
        inside, speed, released = (
            self.inside(fit),
            _speed(scene),
            ~scene.pads_touching("tube").any(1),
        )
        at_rack = released & scene.contact("tube", "rack").touching
        entered, here = fit.depth_m >= _RIM_M, fit.lateral_m < _CELL_M
        stuck = (fit.depth_m < _IN_DEPTH_M) | (fit.tilt_rad >= _IN_TILT_RAD)
        moved = np.linalg.norm(rack[:, :3, 3] - (*RACK_AT_M, 0.0), axis=1)
        return Verdict(
            goal=inside & released & (speed < AT_REST_MPS),
            failures={
                "dropped": fell(tube)
                | fell(rack)
                | (released & (_middle(tube)[:, 2] < _LYING_M)),
                "rack moved": moved > _MOVED_M,
                "rim": at_rack & ~entered,
                "jam": at_rack & entered & here & stuck,
                "missed": at_rack
                & entered
                & ~here,  # in another hole, or leaning on the rack
            },
            partial=inside.astype(int),
            measures={
                "depth_m": fit.depth_m,
                "tilt_rad": fit.tilt_rad,
                "lateral_m": fit.lateral_m,
                "speed_mps": speed,
                "rack_moved_m": moved,
            },
        )

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        def gripped(scene: Scene) -> np.ndarray:
            return np.asarray(scene.pads_touching("rack")[:, :2].all(1))

        def lifted(scene: Scene) -> np.ndarray:
            held = scene.pads_touching("tube")[:, 2:].all(1)
            return np.asarray(held & (_middle(scene.poses("tube"))[:, 2] > _LIFTED_M))

        def upright(scene: Scene) -> np.ndarray:
            return lifted(scene) & (scene.poses("tube")[:, 2, 2] > np.cos(_UPRIGHT_RAD))

        def inserted(scene: Scene) -> np.ndarray:
            released = ~scene.pads_touching("tube").any(1)
            return (
                self.inside(self.fit(scene)) & released & (_speed(scene) < AT_REST_MPS)
            )

        return {
            "left": (
                Subtask(name="grasp rack", done=gripped),
                Subtask(name="hold rack", done=inserted),
            ),
            "right": (
                Subtask(name="lift tube", done=lifted),
                Subtask(name="turn tube upright", done=upright),
                Subtask(name="insert tube", done=inserted),
            ),
        }


def in_seat(stand_pose: np.ndarray, stand_from_part: np.ndarray) -> np.ndarray:
    """World pose (7,), position [m] and quaternion wxyz, of a part placed slightly above its seat ``stand_from_part`` (4, 4) in a
    stand at ``stand_pose`` (7,).
    """
    turned = Rotation.from_quat(stand_pose[3:], scalar_first=True)
    pos = stand_pose[:3] + turned.apply(stand_from_part[:3, 3]) + (0, 0, 0.0002)
    return np.r_[
        pos,
        (turned * Rotation.from_matrix(stand_from_part[:3, :3])).as_quat(
            scalar_first=True
        ),
    ]


def _speed(scene: Scene) -> np.ndarray:
    """(N,) of the tube against the rack [m/s]."""
    return np.linalg.norm(scene.velocities("tube") - scene.velocities("rack"), axis=1)


def _middle(tube: np.ndarray) -> np.ndarray:
    """(N, 3) middle of the tube, world [m]."""
    return tube[:, :3, 3] + TUBE_MIDDLE_M * tube[:, :3, 2]
