"""Do Puzzle: circle, heart and triangle go into their holes in a tray; a piece that is misplaced by a millimetre rests on the
rim.

The tray is clamped in the middle, its row of holes along y: circle to the left. The left hand places the circle, the right
hand triangle and heart, one hand at the tray at a time.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
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
from taccorl.tasks.puzzle.parts import PIECES, puzzle_piece, puzzle_tray

# Nominal places [m]: outlines stay ≥ 4 mm apart whatever is drawn, and all are reached ≥ 0.2 rad from the joint limits.
TRAY_AT_M, YAW_RAD = (
    (0.27, -0.02),
    -np.pi / 2,
)  # the tray's x runs to the right; pieces lie as their holes do
PIECES_AT_M = {
    "circle": (0.285, 0.155),
    "heart": (0.285, -0.195),
    "triangle": (0.285, -0.324),
}
"""Piece → nominal place (x, y) on the table, in the world [m]."""

_ABOVE_FLOOR_M, _TILT_RAD = 0.0025, np.deg2rad(3.0)
_LATERAL_M, _TURN_RAD = (
    0.003,
    np.deg2rad(10.0),
)  # wider than any clearance: only what lies in its own hole is within
_TIPPED_RAD = np.deg2rad(30.0)
_LIFTED_M = 0.03
_ENTERED_M = 0.002  # below the mouth: the piece is in a hole, perhaps jammed
_SEARCHING_MPS = (
    0.005  # faster than this, a piece that is pressed on the tray searches its hole
)
_KNOB_ABOVE_M = 0.0325  # middle of the knob over the piece's underside
_LEFT_ALONE_M = 0.10  # knob from both hands: nobody is about to pick it up again


@tasks.register("puzzle")
class Puzzle(Task):
    """Task: put three pieces into a tray."""

    name = "puzzle"
    instruction = (
        "put the circle, the heart and the triangle into their holes in the tray"
    )
    parts = PIECES
    clamped = ("tray",)
    mating = tuple((shape, "tray") for shape in PIECES)
    max_partial = len(PIECES)
    time_limit_s = 45.0
    # "wrong place", of the paper's failure analysis: the piece is pressed at one place outside of its hole, without a search. The
    # expert presses for 0.7 s at most before it backs off (30 pieces, simulated).
    failures = {"dropped": 0.0, "tipped": 1.0, "rim": 3.0, "wrong place": 3.0}  # noqa: RUF012
    home_rad = {  # noqa: RUF012
        "left": (-0.310, 1.704, -0.795, 0.0, 0.749, -0.310),
        "right": (0.310, 1.704, -0.795, 0.0, 0.749, 0.310),
    }
    rows = (
        OBJECT_FRICTION,
        symmetric("tray_position", (0.005, 0.005), "m"),
        symmetric("tray_yaw", math.radians(5), "rad"),
        *(symmetric(f"{piece}_position", (0.01, 0.01), "m") for piece in PIECES),
        *(symmetric(f"{piece}_yaw", math.radians(10), "rad") for piece in PIECES),
        symmetric("circle_support", (0.03, 0.03), "m"),
        symmetric("heart_support", (0.03, 0.027), "m"),
        symmetric("triangle_support", (0.03, 0.027), "m"),
    )
    expert = f"{__package__}.expert:PuzzleExpert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        self.tray: Part = puzzle_tray("tray", self.clearance_m)
        self.pieces: dict[str, Part] = {shape: puzzle_piece(shape) for shape in PIECES}
        holes = [self.tray.holes[shape] for shape in PIECES]
        self._tray_from_hole = np.stack([hole.part_from_hole for hole in holes])
        self.in_depth_m = holes[0].depth_m - _ABOVE_FLOOR_M
        """Depth [m] of a piece's underside below the mouth from which the piece is inserted; all holes have the same depth."""
        mates = [piece.mate for piece in self.pieces.values() if piece.mate]
        self._piece_from_mate = np.stack([mate.part_from_mate for mate in mates])
        self._is_round = np.array([mate.num_turns is None for mate in mates])
        self._turn_period_rad = np.array(
            [2 * np.pi / (mate.num_turns or 1) for mate in mates]
        )

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        for part in (self.tray, *self.pieces.values()):
            add_part(spec, part)

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        tray_yaw = YAW_RAD + float(draw["tray_yaw"][0])
        quat = Rotation.from_euler("z", tray_yaw).as_quat(scalar_first=True)
        poses = {"tray": np.r_[TRAY_AT_M + draw["tray_position"], 0.0, quat]}
        for shape, piece in self.pieces.items():
            # The table's "reset support" moves what the piece lies on, "position" the piece on it: both add up.
            xy = (
                PIECES_AT_M[shape]
                + draw[f"{shape}_support"]
                + draw[f"{shape}_position"]
            )
            poses[shape] = on_table(piece, xy, YAW_RAD + float(draw[f"{shape}_yaw"][0]))
        return Reset(poses=poses, friction=float(draw["friction"][0]))

    def fits(self, scene: Scene, which: Sequence[int] = range(len(PIECES))) -> Fit:
        """Pose errors of pieces (all by default) in their own holes; arrays (N, len(which)) in the order of ``PIECES``."""
        k = list(which)
        pieces = np.stack([scene.poses(PIECES[i]) for i in k], axis=1)
        fit = measure_fit(
            scene.poses("tray")[:, None] @ self._tray_from_hole[k],
            pieces @ self._piece_from_mate[k],
            1,
        )
        period_rad = self._turn_period_rad[k]
        turn_rad = fit.turn_rad - period_rad * np.round(fit.turn_rad / period_rad)
        return fit._replace(turn_rad=np.where(self._is_round[k], 0.0, turn_rad))

    def inside(self, fit: Fit) -> np.ndarray:
        """(N, n) bool: pieces with these pose errors (arrays (N, n), as from ``fits``) are inserted, i.e. at most 2.5 mm above
        the hole's floor and tilted by less than 3°.
        """
        # The other two are wider than any clearance: only what is in its own hole is within.
        turned = np.abs(fit.turn_rad) < _TURN_RAD
        return (
            (fit.depth_m > self.in_depth_m)
            & (fit.tilt_rad < _TILT_RAD)
            & (fit.lateral_m < _LATERAL_M)
            & turned
        )

    def look(self, scene: Scene) -> Verdict:
        fit = self.fits(scene)
        inside, released = self.inside(fit), ~_stack(scene.pads_touching).any(axis=2)
        placed = inside & released & _slow(scene, inside, AT_REST_MPS)
        outside = _stack(lambda shape: scene.contact(shape, "tray").touching) & ~inside
        on_rim = outside & released
        pressed = outside & ~released & (fit.depth_m < _ENTERED_M)
        pressed &= _slow(scene, pressed, _SEARCHING_MPS)
        pieces = _stack(scene.poses)
        fallen = fell(pieces.reshape(-1, 4, 4)).reshape(-1, len(PIECES))
        tipped = released & (pieces[..., 2, 2] < np.cos(_TIPPED_RAD))
        rim = on_rim & _left_alone(scene, pieces, on_rim)
        failures = {
            "dropped": fallen,
            "tipped": tipped,
            "rim": rim,
            "wrong place": pressed,
        }
        measures = {
            "depth_m": fit.depth_m,
            "tilt_rad": fit.tilt_rad,
            "lateral_m": fit.lateral_m,
        }
        return Verdict(
            goal=placed.sum(axis=1) == len(PIECES),
            failures={
                name: np.logical_or.reduce(seen, axis=1)
                for name, seen in failures.items()
            },
            partial=placed.sum(axis=1),
            measures={
                f"{shape}_{what}": of[:, k]
                for what, of in measures.items()
                for k, shape in enumerate(PIECES)
            },
        )

    def placed(self, scene: Scene, shape: str) -> np.ndarray:
        """(N,) bool: the piece ``shape`` is in its hole and released."""
        inside = self.inside(self.fits(scene, [PIECES.index(shape)]))[:, 0]
        return inside & ~scene.pads_touching(shape).any(axis=1)

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        """Arm → its subtasks for each piece: grasp, then place. One hand places at a time: triangle (right), circle (left), heart
        (right).
        """

        def pair(shape: str) -> tuple[Subtask, Subtask]:
            def lifted(scene: Scene) -> np.ndarray:
                return scene.poses(shape)[:, 2, 3] > _LIFTED_M

            def placed(scene: Scene) -> np.ndarray:
                return self.placed(scene, shape)

            return (
                Subtask(name=f"grasp {shape}", done=lifted),
                Subtask(name=f"place {shape}", done=placed),
            )

        return {"left": pair("circle"), "right": (*pair("triangle"), *pair("heart"))}


def _stack(of_piece: Callable[[str], np.ndarray]) -> np.ndarray:
    """(N, 3, ...) of a function of the piece."""
    return np.stack([of_piece(shape) for shape in PIECES], axis=1)


def _slow(scene: Scene, asked: np.ndarray, limit_mps: float) -> np.ndarray:
    """(N, 3) which of the pieces ``asked`` (N, 3) about are slower than ``limit_mps``."""
    slow = np.zeros_like(asked)
    for k in np.flatnonzero(asked.any(axis=0)):
        slow[:, k] = np.linalg.norm(scene.velocities(PIECES[k]), axis=1) < limit_mps
    return slow


def _left_alone(scene: Scene, pieces: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """(N, 3) from which pieces both hands are away: nobody is about to pick them up again. Asked about few."""
    if not asked.any():
        return asked
    knobs = pieces[..., :3, 3] + _KNOB_ABOVE_M * pieces[..., :3, 2]
    hands = np.stack([scene.poses(f"{arm}_{ROBOT.hand}") for arm in ROBOT.arms], axis=1)
    tcps = hands[..., :3, 3] + ROBOT.tcp_from_hand_m * hands[..., :3, 2]
    return (
        np.linalg.norm(knobs[:, :, None] - tcps[:, None], axis=3).min(axis=2)
        > _LEFT_ALONE_M
    )
