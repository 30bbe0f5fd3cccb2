"""Outlines and the convex solids that parts are made of: exact partitions, never an approximate convex decomposition.

An outline is a simple polygon, (N, 2), counter-clockwise, m. A region with holes (a shapely polygon) is cut along its
constrained Delaunay triangulation; triangles are merged while they stay convex. Pieces share vertices bit for bit, so they
neither overlap nor leave gaps (MuJoCo then stores mesh vertices in single precision: 4 nm at 60 mm).
An approximate decomposition (CoACD) closes the puzzle's holes by 0.8–4 mm (measured).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
import shapely
from scipy.spatial.transform import Rotation
from shapely.geometry import Polygon

from taccorl.errors import TaccorlError

# N vertices of an outline

_CONVEX_TOLERANCE_M = (
    1e-12  # how far a corner may lie inside the hull and still count as straight
)


def circle_outline(
    radius_m: float, num_sides: int, *, circumscribed: bool = False
) -> np.ndarray:
    """Regular polygon (N, 2) [m] of N = ``num_sides`` corners that approximates a circle; with ``circumscribed`` (for holes) the
    whole circle lies inside it."""
    corner_m = radius_m / math.cos(math.pi / num_sides) if circumscribed else radius_m
    angle = 2 * math.pi * (np.arange(num_sides) + 0.5) / num_sides
    return corner_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def triangle_outline(side_m: float) -> np.ndarray:
    """Equilateral triangle (3, 2) [m] about its centroid; one corner points to +y."""
    height = side_m * math.sqrt(3) / 2
    return np.array(
        [(-side_m / 2, -height / 3), (side_m / 2, -height / 3), (0, 2 * height / 3)]
    )


def heart_outline(width_m: float, arc_sides: int = 12) -> np.ndarray:
    """A square on its corner with a half disc on each upper side, (2 × arc_sides + 2, 2) [m], about its centroid.

    With half-disc radius r the width is 2 r (1 + 1/√2); it is met when ``arc_sides`` is a multiple of 4. Tip at −y, notch
    at +y; cut along y both halves are convex."""
    radius = width_m / (2 + math.sqrt(2))
    centre = radius / math.sqrt(2)
    angle = np.linspace(-math.pi / 4, 3 * math.pi / 4, arc_sides + 1)
    right = np.stack(
        [centre + radius * np.cos(angle), centre + radius * np.sin(angle)], axis=1
    )
    right[-1, 0] = 0.0  # the notch
    left = right[-2::-1] * (-1, 1)
    outline = np.concatenate([[(0.0, -radius * math.sqrt(2))], right, left])
    return outline - np.array(Polygon(outline).centroid.coords[0])


def offset_outline(outline_m: np.ndarray, clearance_m: float) -> np.ndarray:
    """``outline_m`` (N, 2) with every side moved outwards by ``clearance_m``, corners kept sharp, (N, 2): the hole for a part.

    The distance between the two outlines is the clearance along every side and larger at convex corners. Raises
    TaccorlError: a side next to a notch is too short to be moved that far."""
    before, after = np.roll(outline_m, 1, axis=0), np.roll(outline_m, -1, axis=0)
    side_in, side_out = _unit(outline_m - before), _unit(after - outline_m)
    normal_in, normal_out = _outward(side_in), _outward(side_out)
    # The moved corner p + v lies on both moved sides: v · n_in = v · n_out = clearance.
    moved = (
        outline_m
        + clearance_m
        * (normal_in + normal_out)
        / (1 + np.sum(normal_in * normal_out, axis=1))[:, None]
    )
    length = np.sum((np.roll(moved, -1, axis=0) - moved) * side_out, axis=1)
    if length.min() <= 0 or not Polygon(moved).is_valid:
        side = int(length.argmin())
        raise TaccorlError(
            f"side {side} vanishes when moved out by {clearance_m * 1e3:g} mm; use a smaller clearance"
        )
    return moved


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _outward(sides: np.ndarray) -> np.ndarray:
    """Outward normals of the sides of a counter-clockwise outline."""
    return np.stack([sides[:, 1], -sides[:, 0]], axis=1)


def convex_partition(region: Polygon) -> list[np.ndarray]:
    """Return convex outlines that tile ``region`` exactly, each (N, 2) [m] counter-clockwise, of the region's own vertices
    only."""
    triangles = shapely.orient_polygons(
        shapely.get_parts(shapely.constrained_delaunay_triangles(region))
    )
    corners = [
        [(x, y) for x, y in triangle.exterior.coords[:-1]] for triangle in triangles
    ]
    merged = [_merge(corners, longest_first) for longest_first in (True, False)]
    return [np.array(piece) for piece in min(merged, key=len)]


type _Point = tuple[float, float]


def _merge(polygons: list[list[_Point]], longest_first: bool) -> list[list[_Point]]:
    """Remove inner sides one by one where both its ends stay convex. One pass is complete: angles only grow."""
    pieces = dict(enumerate(polygons))
    owner = {side: i for i, corners in pieces.items() for side in _sides(corners)}
    inner = [(a, b) for a, b in owner if (b, a) in owner and a < b]
    for a, b in sorted(
        inner, key=lambda side: (math.dist(*side), side), reverse=longest_first
    ):
        one, other = owner[a, b], owner[b, a]
        union = _between(pieces[one], b, a) + _between(pieces[other], a, b)[1:-1]
        if one == other or not all(
            _is_convex_at(union, union.index(corner)) for corner in (a, b)
        ):
            continue
        pieces[one] = union
        del pieces[other]
        owner |= dict.fromkeys(_sides(union), one)
    return list(pieces.values())


def _sides(corners: list[_Point]) -> list[tuple[_Point, _Point]]:
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def _between(corners: list[_Point], first: _Point, last: _Point) -> list[_Point]:
    """The corners from ``first`` to ``last``, both included."""
    start = corners.index(first)
    turned = corners[start:] + corners[:start]
    return turned[: turned.index(last) + 1]


def _is_convex_at(corners: list[_Point], i: int) -> bool:
    (ax, ay), (bx, by), (cx, cy) = (
        corners[i - 1],
        corners[i],
        corners[(i + 1) % len(corners)],
    )
    cross = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
    return cross >= -_CONVEX_TOLERANCE_M * math.dist((ax, ay), (cx, cy))


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid(ABC):
    """One convex solid of a part, about its own origin, standing along its own z axis."""

    part_from_solid: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the solid in the part's frame [m]."""
    mass_kg: float = 0.0
    """Mass [kg]."""
    color: str = "grey"
    """Name in ``COLORS``; it has no physical effect."""
    touches: bool = True
    """False for ballast: it has mass, but no contacts, and is not drawn."""

    @property
    @abstractmethod
    def volume_m3(self) -> float:
        """Volume of the solid [m³]."""

    @property
    def com_part_m(self) -> np.ndarray:
        """(3,) Centre of mass in the part's frame."""
        return self.part_from_solid[:3, 3]


@dataclass(frozen=True, kw_only=True, eq=False)
class Box(Solid):
    """Box with its sides along the axes of its frame."""

    half_m: tuple[float, float, float]
    """Half the side along x, y and z [m]."""

    @property
    def volume_m3(self) -> float:
        return 8 * math.prod(self.half_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cylinder(Solid):
    """Cylinder along z."""

    radius_m: float
    half_height_m: float
    """Half its length [m]."""

    @property
    def volume_m3(self) -> float:
        return math.pi * self.radius_m**2 * 2 * self.half_height_m


@dataclass(frozen=True, kw_only=True, eq=False)
class Capsule(Solid):
    """Cylinder along z with a half sphere on both ends."""

    radius_m: float
    half_height_m: float
    """Half the length of the cylinder between the two half spheres [m]."""

    @property
    def volume_m3(self) -> float:
        return (
            math.pi
            * self.radius_m**2
            * (2 * self.half_height_m + 4 / 3 * self.radius_m)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Prism(Solid):
    """Convex outline in x and y, extruded along z to both sides."""

    outline_m: np.ndarray
    """(N, 2) convex outline, counter-clockwise."""
    half_height_m: float
    """Half its length [m]."""

    @property
    def volume_m3(self) -> float:
        return Polygon(self.outline_m).area * 2 * self.half_height_m

    @property
    def com_part_m(self) -> np.ndarray:
        (x, y) = Polygon(self.outline_m).centroid.coords[0]
        return (self.part_from_solid @ (x, y, 0.0, 1.0))[:3]


def box_between(
    low_m: Sequence[float], high_m: Sequence[float], color: str = "grey"
) -> Box:
    """The axis-parallel box between the corners ``low_m`` and ``high_m``, (x, y, z) each, in the part's frame."""
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    pose = np.eye(4)
    pose[:3, 3] = (low + high) / 2
    x, y, z = ((high - low) / 2).tolist()
    return Box(half_m=(x, y, z), part_from_solid=pose, color=color)


def extrude(
    region: Polygon, z_low_m: float, z_high_m: float, color: str = "grey"
) -> list[Solid]:
    """Extrude ``region`` [m], in the part's x and y, from ``z_low_m`` to ``z_high_m``; returns exact boxes for axis-parallel
    rectangles, prisms for the rest."""
    pose = np.eye(4)
    pose[2, 3] = (z_low_m + z_high_m) / 2
    solids: list[Solid] = []
    for outline in convex_partition(region):
        low, high = outline.min(axis=0), outline.max(axis=0)
        if len(outline) == 4 and np.all((outline == low) | (outline == high)):
            solids.append(box_between([*low, z_low_m], [*high, z_high_m], color))
        else:
            half = (z_high_m - z_low_m) / 2
            solids.append(
                Prism(
                    outline_m=outline,
                    half_height_m=half,
                    part_from_solid=pose,
                    color=color,
                )
            )
    return solids


def moved[S: Solid](solid: S, part_from_frame: np.ndarray) -> S:
    """Return a copy of the solid, moved: its pose in the part becomes ``part_from_frame`` (4, 4) [m] times its present one."""
    return replace(solid, part_from_solid=part_from_frame @ solid.part_from_solid)


def with_mass[S: Solid](solids: Sequence[S], mass_kg: float) -> list[S]:
    """Return the solids with ``mass_kg`` distributed among them by volume, in their order."""
    volume = sum(solid.volume_m3 for solid in solids)
    return [
        replace(solid, mass_kg=mass_kg * solid.volume_m3 / volume) for solid in solids
    ]


def add_geom(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, solid: Solid, name: str, **settings
) -> mujoco.MjsGeom:
    """Add one solid as the geom ``name`` of ``body``; a prism becomes a mesh of that name. Inertia is exact.

    ``settings`` are geom attributes (contact, material)."""
    settings |= {"pos": solid.part_from_solid[:3, 3], "mass": solid.mass_kg}
    settings["quat"] = Rotation.from_matrix(solid.part_from_solid[:3, :3]).as_quat(
        scalar_first=True
    )
    match solid:
        case Box():
            return body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=solid.half_m, **settings
            )
        case Cylinder() | Capsule():
            kinds = {
                Cylinder: mujoco.mjtGeom.mjGEOM_CYLINDER,
                Capsule: mujoco.mjtGeom.mjGEOM_CAPSULE,
            }
            size = [solid.radius_m, solid.half_height_m, 0]
            return body.add_geom(
                name=name, type=kinds[type(solid)], size=size, **settings
            )
        case Prism():
            heights = np.repeat(
                [-solid.half_height_m, solid.half_height_m], len(solid.outline_m)
            )
            vertices = np.concatenate(
                [np.tile(solid.outline_m, (2, 1)), heights[:, None]], axis=1
            )
            # The hull is the prism itself, so its inertia is exact.
            convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            spec.add_mesh(name=name, uservert=vertices.ravel(), inertia=convex)
            return body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **settings
            )
        case _:
            raise TypeError(f"{name}: no MuJoCo geom for a {type(solid).__name__}")
