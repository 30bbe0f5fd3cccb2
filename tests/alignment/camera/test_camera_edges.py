"""Edges of the twin and of pictures, against squares and steps whose place is known."""

import cv2
import numpy as np
import pytest

from taccorl.alignment.camera.edges import PictureEdges, twin_edges
from taccorl.sim.cameras import Intrinsics

SMALL = Intrinsics(rows=60, columns=80, fx_px=70.0, fy_px=70.0, cx_px=39.5, cy_px=29.5)


def test_the_outline_of_a_square_is_where_the_square_is():
    bodies, depth = np.zeros((60, 80), int), np.full((60, 80), np.inf)
    bodies[20:40, 30:50], depth[20:40, 30:50] = 5, 0.7
    edges = twin_edges(bodies, depth, SMALL)
    assert len(edges.points) == 80 and (edges.bodies == 5).all()
    np.testing.assert_allclose(edges.points[:, 2], -0.7)
    u = SMALL.cx_px + SMALL.fx_px * edges.points[:, 0] / 0.7
    v = SMALL.cy_px - SMALL.fy_px * edges.points[:, 1] / 0.7
    # Pixels 30 … 49 are 29.5 … 49.5 wide.
    assert (u.min(), u.max(), v.min(), v.max()) == pytest.approx(
        (29.5, 49.5, 19.5, 39.5)
    )
    sides = (np.abs(u - 29.5) < 0.1) & (np.abs(v - 29.5) < 6)
    assert sides.sum() == 12
    assert (np.abs(edges.normals[sides, 0]) > 0.99).all()


def test_a_nearer_body_owns_the_edge_between_two():
    bodies, depth = np.ones((60, 80), int), np.full((60, 80), 1.0)
    bodies[:, 40:], depth[:, 40:] = 2, 0.5
    edges = twin_edges(bodies, depth, SMALL)
    assert set(edges.bodies.tolist()) == {2}
    np.testing.assert_allclose(edges.points[:, 2], -0.5)


def test_a_part_that_stands_before_the_rest_of_its_body_has_an_edge_and_a_slanted_face_has_none():
    bodies, depth = (
        np.ones((60, 80), int),
        np.repeat((0.5 + 0.02 * np.arange(80))[None], 60, 0),
    )  # 2 cm a pixel
    assert not len(twin_edges(bodies, depth, SMALL).points)
    depth[:, 40:] += 0.3
    edges = twin_edges(bodies, depth, SMALL)
    assert len(edges.points) == 60
    np.testing.assert_allclose(edges.points[:, 2], -(0.5 + 0.02 * 39))


@pytest.mark.parametrize("at_px", [30.0, 30.25, 30.5, 30.8])
def test_an_edge_of_a_picture_is_found_to_a_tenth_of_a_pixel(at_px: float):
    columns = np.arange(80)
    dark = np.clip(at_px - columns + 0.5, 0, 1)  # share of each pixel left of the edge
    picture = np.repeat((200 - 120 * dark)[None], 60, 0)
    picture = np.repeat(
        cv2.GaussianBlur(picture, (0, 0), 0.7).astype(np.uint8)[..., None], 3, 2
    )
    edges = PictureEdges(picture)
    here, across = (
        np.array([[33.0, 30.0], [33.0, 20.0]]),
        np.array([[1.0, 0.0], [-1.0, 0.0]]),
    )
    pixels, normals, found = edges.match(here, across, 6.0)
    assert found.all()
    np.testing.assert_allclose(pixels[:, 0], at_px, atol=0.1)
    np.testing.assert_allclose(np.abs(normals[:, 0]), 1.0, atol=1e-3)
    assert not edges.match(here, across[:, ::-1], 6.0)[
        2
    ].any()  # an edge that runs the other way
    assert not edges.match(here, across, 2.0)[2].any()  # too far
