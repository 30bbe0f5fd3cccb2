"""Depth and rate of every taxel as compiled loops over simulations, many threads at once.

A taxel at (x, y) of its pad lies at p = a_x x + a_y y + t in a shape's frame and moves there with ṗ = v + w × (p − t). Both are
linear in (x, y, 1), so one (3, 3) matrix each says where all taxels of a pad are: its columns belong to x, y, 1. Depth is the
distance from p to the shape's surface, positive inside: of a capsule to its axis, of a cylinder the smaller distance to side and
end, of a convex solid to its nearest face or, where that is covered by another solid of the part, to the part's surface. It is
good to 1e-8 m within 0.2 m of a shape's origin. Products of three terms are fused (as BLAS fuses them in ``matrix @ grid``), all
others are not. The loops hold no lock of Python's, so blocks of simulations run in parallel.

Letters in shapes: as in ``taccorl.sim.pad`` and ``felt_shapes``.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numba.extending import intrinsic

from taccorl.sim.felt_shapes import CAPSULE, SOLID, ShapeTables
from taccorl.sim.part_surface import NEAR_M, TOUCH_M
from taccorl.sim.polyhedron import FLAT_M

_FAR_M = 1e3  # in place of infinity, because infinity times 0 is NaN
_TINY_M = (
    1e-12  # least divisor for distances, which are 0 on a shape's axis and on an edge
)
_ZERO, _TINY = np.float32(0), np.float32(_TINY_M)


class FeltGeoms(NamedTuple):
    """What a model tells of the G geoms that pads can detect, in the order of ``ShapeTables``."""

    geom: np.ndarray  # (G,) ids of the geoms
    body: np.ndarray  # (G,) ids of the geoms' bodies
    feels: np.ndarray  # (P, G) bool: the pad can detect the geom
    bound_m: np.ndarray  # (G,) radius of the bounding sphere [m]; infinite for a plane
    centre_m: np.ndarray  # (G, 3) centre of the bounding box [m]
    extent_m: np.ndarray  # (G, 3) half the sides of the bounding box [m]


class Pads(NamedTuple):
    """The P pads of one model, as tables for compiled code; P' of them are sprung, K taxels each."""

    site: np.ndarray  # (P,) id of the site that is the taxel frame
    box: np.ndarray  # (P,) id of the pad's geom, a box
    finger: np.ndarray  # (P,) id of the body that holds the site
    plate: np.ndarray  # (P,) id of the body that holds the box
    sprung: np.ndarray  # (P',) indices of the sprung pads
    plate_point_m: np.ndarray
    """(P', 3) a point of the undeformed surface in the box's frame; ``plate_normal`` (P', 3) is its normal."""
    plate_normal: np.ndarray
    root: np.ndarray  # (nbody,) root body of each body's kinematic tree
    half_m: np.ndarray  # (3,) half the sides of the taxels' rectangle [m]
    grid: np.ndarray  # (3, K) float32 rows x, y, 1


class Fields(NamedTuple):
    """``KINEMATIC_FIELDS`` of N simulations, as ``pad.Kinematics``; matrices are (…, 9)."""

    site_xpos: np.ndarray
    site_xmat: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray


@intrinsic
def _fma(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, rounded once."""
    return a(a, b, c), lambda _context, builder, _signature, values: builder.fma(
        *values
    )


@numba.njit(inline="always")
def _sum3(a0, b0, a1, b1, a2, b2):
    """a₀ b₀ + a₁ b₁ + a₂ b₂ as BLAS adds them up."""
    return _fma(a2, b2, _fma(a1, b1, a0 * b0))  # pyright: ignore[reportCallIssue] (Numba passes the first one)


@numba.njit(inline="always")
def _cross(a, b):
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@numba.njit(inline="always")
def _row_times(row, matrix):
    """(3,) row vector times a (9,) matrix."""
    return (
        _sum3(row[0], matrix[0], row[1], matrix[3], row[2], matrix[6]),
        _sum3(row[0], matrix[1], row[1], matrix[4], row[2], matrix[7]),
        _sum3(row[0], matrix[2], row[1], matrix[5], row[2], matrix[8]),
    )


@numba.njit(inline="always")
def _times(matrix, column):
    """(9,) matrix times a (3,) column vector."""
    return (
        _sum3(matrix[0], column[0], matrix[1], column[1], matrix[2], column[2]),
        _sum3(matrix[3], column[0], matrix[4], column[1], matrix[5], column[2]),
        _sum3(matrix[6], column[0], matrix[7], column[1], matrix[8], column[2]),
    )


@numba.njit(inline="always")
def _motion(fields, n, body, root, point):
    """Angular velocity, and velocity of the body at a point (3,), in the world; cvel is (ω, v at subtree_com[root])."""
    cvel, com = fields.cvel[n, body], fields.subtree_com[n, root[body]]
    turn = (cvel[0], cvel[1], cvel[2])
    across = _cross(turn, (point[0] - com[0], point[1] - com[1], point[2] - com[2]))
    return turn, (cvel[3] + across[0], cvel[4] + across[1], cvel[5] + across[2])


@numba.njit(inline="always")
def _difference(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@numba.njit(nogil=True, cache=True)
def _place(geoms, pads, fields, n, p, g, position, velocity):
    """Whether the boxes of pad p and geom g meet; then writes the pad's (3, 3) ``position`` and ``velocity`` in its frame."""
    geom, half = geoms.geom[g], pads.half_m
    site_pos, site_mat = (
        fields.site_xpos[n, pads.site[p]],
        fields.site_xmat[n, pads.site[p]],
    )
    away = _difference(fields.geom_xpos[n, geom], site_pos)
    mat = fields.geom_xmat[n, geom]
    # The pad's axes as columns, and the pad's origin [m], both in the geom's frame.
    x = _row_times((site_mat[0], site_mat[3], site_mat[6]), mat)
    y = _row_times((site_mat[1], site_mat[4], site_mat[7]), mat)
    z = _row_times((site_mat[2], site_mat[5], site_mat[8]), mat)
    back = _row_times(away, mat)
    origin = (-back[0], -back[1], -back[2])
    centre = _difference(geoms.centre_m[g], origin)
    extent = geoms.extent_m[g]
    for j, axis in enumerate((x, y, z)):
        reach = half[j] + _sum3(
            extent[0], abs(axis[0]), extent[1], abs(axis[1]), extent[2], abs(axis[2])
        )
        if (
            not abs(_sum3(centre[0], axis[0], centre[1], axis[1], centre[2], axis[2]))
            < reach
        ):
            return False
    for i in range(3):
        reach = extent[i] + _sum3(
            abs(x[i]), half[0], abs(y[i]), half[1], abs(z[i]), half[2]
        )
        if not abs(centre[i]) < reach:
            return False
    turn_1, shift_1 = _motion(fields, n, pads.finger[p], pads.root, site_pos)
    turn_2, shift_2 = _motion(fields, n, geoms.body[g], pads.root, site_pos)
    turn = _row_times(_difference(turn_1, turn_2), mat)
    shift = _row_times(_difference(shift_1, shift_2), mat)
    over_x, over_y = _cross(turn, x), _cross(turn, y)
    for i in range(3):
        position[i, 0], position[i, 1], position[i, 2] = x[i], y[i], origin[i]
        velocity[i, 0], velocity[i, 1], velocity[i, 2] = over_x[i], over_y[i], shift[i]
    return True


@numba.njit(inline="always")
def _at(row, grid, k):
    return _sum3(row[0], grid[0, k], row[1], grid[1, k], row[2], grid[2, k])


@numba.njit(nogil=True, cache=True)
def _in_round(shapes, g, position, velocity, grid, depth, rate):
    """A capsule or cylinder: the deeper of it and what is in ``depth`` and ``rate`` (K,)."""
    kind, radius, half = shapes.kind[g], shapes.radius_m[g], shapes.half_m[g]
    for k in range(grid.shape[1]):
        x, y, z = (
            _at(position[0], grid, k),
            _at(position[1], grid, k),
            _at(position[2], grid, k),
        )
        if kind == CAPSULE:
            z = z - min(max(z, -half), half)
            distance = np.sqrt(x * x + y * y + z * z)
            deep = radius - distance
        else:
            distance = np.sqrt(x * x + y * y)
            deep = min(radius - distance, half - abs(z))
        if deep > depth[k]:
            depth[k] = deep
            vx, vy, vz = (
                _at(velocity[0], grid, k),
                _at(velocity[1], grid, k),
                _at(velocity[2], grid, k),
            )
            if kind == CAPSULE:
                rate[k] = (x * vx + y * vy + z * vz) / -max(distance, _TINY)
            elif half - abs(z) < radius - distance:
                rate[k] = -vz * np.sign(z)
            else:
                rate[k] = (x * vx + y * vy) / -max(distance, _TINY)


@numba.njit(nogil=True, cache=True)
def _in_solid(
    shapes, g, position, velocity, grid, depth, rate, under, deepest, nearest
):
    """A convex solid: the deeper of it and what is in ``depth`` and ``rate`` (K,); the last three are work space."""
    first, end = shapes.faces[g, 0], shapes.faces[g, 1]
    for f in range(first, end):
        normal, row = shapes.normals[f], under[f - first]
        for j in range(3):
            row[j] = -_sum3(
                normal[0],
                position[0, j],
                normal[1],
                position[1, j],
                normal[2],
                position[2, j],
            )
        row[2] += shapes.offsets_m[f]
        if f == first:
            for k in range(grid.shape[1]):
                deepest[k], nearest[k] = _at(row, grid, k), 0
        else:
            for k in range(grid.shape[1]):
                value = _at(row, grid, k)
                nearest[k] = f - first if value <= deepest[k] else nearest[k]
                deepest[k] = value if value <= deepest[k] else deepest[k]
    seamed = shapes.surface[g] >= 0
    for k in range(grid.shape[1]):
        if not deepest[k] > _ZERO:
            continue
        if seamed and _at_seam(shapes, g, position, grid, k, under, deepest[k]):
            deep, speed = _in_part(shapes, g, position, velocity, grid, k)
            if deep > depth[k]:
                depth[k], rate[k] = deep, speed
        elif deepest[k] > depth[k]:
            normal = shapes.normals[first + nearest[k]]
            a = -_sum3(
                normal[0],
                velocity[0, 0],
                normal[1],
                velocity[1, 0],
                normal[2],
                velocity[2, 0],
            )
            b = -_sum3(
                normal[0],
                velocity[0, 1],
                normal[1],
                velocity[1, 1],
                normal[2],
                velocity[2, 1],
            )
            c = -_sum3(
                normal[0],
                velocity[0, 2],
                normal[1],
                velocity[1, 2],
                normal[2],
                velocity[2, 2],
            )
            depth[k] = deepest[k]
            rate[k] = _sum3(a, grid[0, k], b, grid[1, k], c, grid[2, k])


@numba.njit(nogil=True, cache=True)
def _at_seam(shapes, g, position, grid, k, under, deepest):
    """Whether the nearest point of the solid's own faces is where another solid of the part covers it."""
    first, end = shapes.faces[g, 0], shapes.faces[g, 1]
    for f in range(first, end):
        if shapes.covered[f] and _at(under[f - first], grid, k) == deepest:
            return True
    for r in range(shapes.seams[g, 0], shapes.seams[g, 1]):
        if _at(under[shapes.seam_face[r]], grid, k) != deepest:
            continue
        inside = True
        for side in range(2):
            axis = shapes.seam_axes[r, side]
            a = _sum3(
                axis[0],
                position[0, 0],
                axis[1],
                position[1, 0],
                axis[2],
                position[2, 0],
            )
            b = _sum3(
                axis[0],
                position[0, 1],
                axis[1],
                position[1, 1],
                axis[2],
                position[2, 1],
            )
            c = _sum3(
                axis[0],
                position[0, 2],
                axis[1],
                position[1, 2],
                axis[2],
                position[2, 2],
            )
            c -= shapes.seam_centres_m[r, side]
            inside &= (
                abs(_sum3(a, grid[0, k], b, grid[1, k], c, grid[2, k]))
                < shapes.seam_halves_m[r, side]
            )
        if inside:
            return True
    return False


@numba.njit(inline="always")
def _combined(matrix, weights):
    """Columns of a (3, ≥ 3) matrix times weights (3,), not fused."""
    a, b, c = weights
    return (
        matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c,
        matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c,
        matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c,
    )


@numba.njit(nogil=True, cache=True)
def _in_part(shapes, g, position, velocity, grid, k):
    """Depth and rate of taxel k in the whole part that solid g belongs to, float32."""
    where = (np.float64(grid[0, k]), np.float64(grid[1, k]), np.float64(grid[2, k]))
    pose = shapes.body_from_geom[g]
    turned = _combined(pose, _combined(position, where))
    point = (turned[0] + pose[0, 3], turned[1] + pose[1, 3], turned[2] + pose[2, 3])
    speed = _combined(pose, _combined(velocity, where))
    u = shapes.surface[g]
    cell = 0
    for i in range(3):
        at = (point[i] - shapes.cell_origin_m[u, i]) / shapes.cell_size_m[u]
        cell = cell * shapes.cell_counts[u, i] + int(
            min(max(at, 0.0), shapes.cell_counts[u, i] - 1.0)
        )
    cell += shapes.first_cell[u]
    pieces = shapes.piece_list[
        shapes.cell_pieces[cell, 0] : shapes.cell_pieces[cell, 1]
    ]
    edges = shapes.edge_list[shapes.cell_edges[cell, 0] : shapes.cell_edges[cell, 1]]
    depth, inward = _to_surface(shapes, point, pieces, edges)
    if depth > NEAR_M:
        pieces = np.arange(shapes.own_pieces[u, 0], shapes.own_pieces[u, 1])
        edges = np.arange(shapes.own_edges[u, 0], shapes.own_edges[u, 1])
        depth, inward = _to_surface(shapes, point, pieces, edges)
    rate = inward[0] * speed[0] + inward[1] * speed[1] + inward[2] * speed[2]
    return np.float32(depth), np.float32(rate)


@numba.njit(nogil=True, cache=True)
def _to_surface(shapes, point, pieces, edges):
    """Distance of a point (3,) to the nearest of these edges and of these pieces that it lies under, and away from it."""
    x, y, z = point
    depth, inward = _FAR_M, (0.0, 0.0, 0.0)
    least = np.inf
    for e in edges:
        edge = shapes.edges[e]
        sx, sy, sz, ex, ey, ez = edge[0], edge[1], edge[2], edge[3], edge[4], edge[5]
        dx, dy, dz = x - sx, y - sy, z - sz
        share = min(
            max((dx * ex + dy * ey + dz * ez) / (ex * ex + ey * ey + ez * ez), 0.0), 1.0
        )
        ax, ay, az = dx - share * ex, dy - share * ey, dz - share * ez
        square = ax * ax + ay * ay + az * az
        if square < least:
            least, inward = square, (ax, ay, az)
    if least < np.inf:
        depth = min(np.sqrt(least), _FAR_M)
        length = max(depth, _TINY_M)
        inward = (inward[0] / length, inward[1] / length, inward[2] / length)
    for q in pieces:
        piece = shapes.pieces[q]
        nx, ny, nz = piece[0], piece[1], piece[2]
        under = piece[3] - (x * nx + y * ny + z * nz)
        if under < -2 * TOUCH_M or under >= depth:
            continue
        ox, oy, oz = x - piece[4], y - piece[5], z - piece[6]
        if ox * ox + oy * oy + oz * oz - under * under > piece[7]:
            continue
        over = True
        for e in range(shapes.side_offsets_m.shape[1]):
            side = shapes.side_normals[q, e]
            over &= (
                x * side[0] + y * side[1] + z * side[2] - shapes.side_offsets_m[q, e]
                < FLAT_M
            )
        if over:
            depth, inward = under, (-nx, -ny, -nz)
    return depth, inward


@numba.njit(nogil=True, cache=True)
def _compressed(pads, fields, n, s, depth, rate):
    """Compression of the plate of sprung pad s and its rate, (K,); see ``PadArray.compression``."""
    p = pads.sprung[s]
    site, box = pads.site[p], pads.box[p]
    site_pos, site_mat, box_mat = (
        fields.site_xpos[n, site],
        fields.site_xmat[n, site],
        fields.geom_xmat[n, box],
    )
    normal = _row_times(_times(box_mat, pads.plate_normal[s]), site_mat)
    off = _times(box_mat, pads.plate_point_m[s])
    centre = fields.geom_xpos[n, box]
    plate = _difference(
        (centre[0] + off[0], centre[1] + off[1], centre[2] + off[2]), site_pos
    )
    point = _row_times(plate, site_mat)
    n_z = normal[2]
    along = normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]
    d = (normal[0] / n_z, normal[1] / n_z, -along / n_z)
    turn_1, shift_1 = _motion(fields, n, pads.plate[p], pads.root, site_pos)
    turn_2, shift_2 = _motion(fields, n, pads.finger[p], pads.root, site_pos)
    turn, shift = (
        _row_times(_difference(turn_1, turn_2), site_mat),
        _row_times(_difference(shift_1, shift_2), site_mat),
    )
    m = _cross(normal, turn)
    moving = normal[0] * shift[0] + normal[1] * shift[1] + normal[2] * shift[2]
    v = (
        (m[2] * d[0] - m[0]) / n_z,
        (m[2] * d[1] - m[1]) / n_z,
        (m[2] * d[2] - moving) / n_z,
    )
    d0, d1, d2 = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    v0, v1, v2 = np.float32(v[0]), np.float32(v[1]), np.float32(v[2])
    grid = pads.grid
    for k in range(grid.shape[1]):
        depth[k] = _sum3(d0, grid[0, k], d1, grid[1, k], d2, grid[2, k])
        rate[k] = _sum3(v0, grid[0, k], v1, grid[1, k], v2, grid[2, k])


@numba.njit(nogil=True, cache=True)
def take_off_sinking(depth, rate, plate_depth, plate_rate):
    """Take the part's penetration into the plate off one pad's depth D and rate, in place: δ = [D − r]₊ with r = [max (D − c)]₊,
    and δ̇ = Ḋ − ṙ; c is how far the plate is pressed in. All four arguments are (K,), depths [m] and rates [m/s].

    The taxel with the greatest D − c gets (c, ċ): on a plate that does not tilt the spring's own compression, N / K in balance.
    Where the taxels miss the summit of a small round part they all read up to that much less (0.1 mm for a sphere of 10 mm), and
    that much of the sinking, which depends on the mass, stays in."""
    furthest, beyond = -1, -np.inf
    for k in range(len(depth)):
        if depth[k] > _ZERO and depth[k] - plate_depth[k] > beyond:
            furthest, beyond = k, depth[k] - plate_depth[k]
    sunk, sunk_rate = _ZERO, _ZERO
    if furthest >= 0 and depth[furthest] - plate_depth[furthest] > _ZERO:
        sunk, sunk_rate = (
            depth[furthest] - plate_depth[furthest],
            rate[furthest] - plate_rate[furthest],
        )
    for k in range(len(depth)):
        depth[k] -= sunk
        if depth[k] > _ZERO:
            rate[k] -= sunk_rate
        else:
            depth[k], rate[k] = _ZERO, _ZERO


@numba.njit(inline="always")
def _work_space(shapes, grid):
    """Arrays for ``_in_solid``: (most faces of a solid, 3), (K,) and (K,)."""
    most = 1
    for g in range(len(shapes.faces)):
        most = max(most, shapes.faces[g, 1] - shapes.faces[g, 0])
    return (
        np.empty((most, 3), grid.dtype),
        np.empty(grid.shape[1], grid.dtype),
        np.empty(grid.shape[1], np.int32),
    )


@numba.njit(nogil=True, cache=True)
def penetration(geoms, shapes, pads, fields, off_sinking, depth, rate):
    """Write depth [m] and rate [m/s] of the taxels into ``depth`` and ``rate`` (N, P, K), which are zeros before; with or without
    the part's penetration into a sprung pad's plate (``off_sinking``).

    ``geoms``, ``shapes``, ``pads`` and ``fields`` are ``FeltGeoms``, ``ShapeTables``, ``Pads`` and ``Fields``."""
    grid = pads.grid
    position, velocity = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    under, deepest, nearest = _work_space(shapes, grid)
    plate_depth, plate_rate = (
        np.empty(grid.shape[1], np.float32),
        np.empty(grid.shape[1], np.float32),
    )
    # Most pairs end in the innermost lines: no views of arrays there, which cost more than the numbers.
    geom, feels, bound, half = geoms.geom, geoms.feels, geoms.bound_m, pads.half_m
    geom_pos, site_pos, site_mat = fields.geom_xpos, fields.site_xpos, fields.site_xmat
    for n in range(len(depth)):
        for p in range(len(pads.site)):
            site, met = pads.site[p], False
            x, y, z = site_pos[n, site, 0], site_pos[n, site, 1], site_pos[n, site, 2]
            xx, xy, xz = (
                site_mat[n, site, 0],
                site_mat[n, site, 1],
                site_mat[n, site, 2],
            )
            yx, yy, yz = (
                site_mat[n, site, 3],
                site_mat[n, site, 4],
                site_mat[n, site, 5],
            )
            zx, zy, zz = (
                site_mat[n, site, 6],
                site_mat[n, site, 7],
                site_mat[n, site, 8],
            )
            for g in range(len(geom)):
                at = geom[g]
                dx, dy, dz = (
                    geom_pos[n, at, 0] - x,
                    geom_pos[n, at, 1] - y,
                    geom_pos[n, at, 2] - z,
                )
                is_near = (
                    feels[p, g]
                    and abs(_sum3(dx, xx, dy, yx, dz, zx)) < bound[g] + half[0]
                )
                is_near = (
                    is_near and abs(_sum3(dx, xy, dy, yy, dz, zy)) < bound[g] + half[1]
                )
                is_near = (
                    is_near and abs(_sum3(dx, xz, dy, yz, dz, zz)) < bound[g] + half[2]
                )
                if not (
                    is_near and _place(geoms, pads, fields, n, p, g, position, velocity)
                ):
                    continue
                met = True
                if shapes.kind[g] == SOLID:
                    _in_solid(
                        shapes,
                        g,
                        position,
                        velocity,
                        grid,
                        depth[n, p],
                        rate[n, p],
                        under,
                        deepest,
                        nearest,
                    )
                else:
                    _in_round(
                        shapes, g, position, velocity, grid, depth[n, p], rate[n, p]
                    )
            if met and off_sinking:
                for s in range(len(pads.sprung)):
                    if pads.sprung[s] == p:
                        _compressed(pads, fields, n, s, plate_depth, plate_rate)
                        take_off_sinking(
                            depth[n, p], rate[n, p], plate_depth, plate_rate
                        )


@numba.njit(nogil=True, cache=True)
def compression(pads, fields, depth, rate):
    """Write compression [m] and its rate [m/s] of the plates of the sprung pads into ``depth`` and ``rate`` (N, P', K). ``pads``
    and ``fields`` are a ``Pads`` and a ``Fields``."""
    for n in range(len(depth)):
        for s in range(len(pads.sprung)):
            _compressed(pads, fields, n, s, depth[n, s], rate[n, s])


def depth_in_body(
    shapes: ShapeTables, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] and rate [m/s] of n pads' taxels, (n, K) float32 each and 0 outside, in a body that holds all ``shapes``.

    Args:
        shapes: in double precision.
        position: (n, 3, 3): ``position @ grid`` are the taxels' coordinates in the body's frame [m].
        velocity: (n, 3, 3): ``velocity @ grid`` are their velocities there [m/s].
        grid: (3, K) rows x, y, 1 of the taxels.
    """
    depth, rate = np.zeros((2, len(position), grid.shape[1]), np.float32)
    position, velocity, grid = (
        np.ascontiguousarray(array, np.float64) for array in (position, velocity, grid)
    )
    _in_body(shapes, position, velocity, grid, depth, rate)
    return depth, rate


@numba.njit(nogil=True, cache=True)
def _in_body(shapes, position, velocity, grid, depth, rate):
    at, speed = np.empty((3, 3)), np.empty((3, 3))
    under, deepest, nearest = _work_space(shapes, grid)
    for n in range(len(position)):
        for g in range(len(shapes.kind)):
            pose, there, moving = shapes.body_from_geom[g], position[n], velocity[n]
            for i in range(3):
                for j in range(3):
                    a, b, c = there[0, j], there[1, j], there[2, j]
                    if j == 2:
                        a, b, c = a - pose[0, 3], b - pose[1, 3], c - pose[2, 3]
                    at[i, j] = _sum3(pose[0, i], a, pose[1, i], b, pose[2, i], c)
                    speed[i, j] = _sum3(
                        pose[0, i],
                        moving[0, j],
                        pose[1, i],
                        moving[1, j],
                        pose[2, i],
                        moving[2, j],
                    )
            if shapes.kind[g] == SOLID:
                _in_solid(
                    shapes,
                    g,
                    at,
                    speed,
                    grid,
                    depth[n],
                    rate[n],
                    under,
                    deepest,
                    nearest,
                )
            else:
                _in_round(shapes, g, at, speed, grid, depth[n], rate[n])
