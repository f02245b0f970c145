import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from depthreg.rendering.embree import RayTree

CORNERS = np.array([[0, 1, 2]])


def _soup(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Loose triangles in a box of 2 m, 5 m ahead along y."""
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32) + np.float32([0, 5, 0])
    return points, np.arange(300, dtype=np.int32).reshape(-1, 3)


def _fan(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit directions (3, N) that leave the origin about along y."""
    rays = rng.normal(0, 0.2, (3, count)).astype(np.float32) + np.float32([[0], [1], [0]])
    return rays / np.linalg.norm(rays, axis=0)


@pytest.mark.parametrize("width", [8, 16])
@pytest.mark.parametrize("count", [0, 1, 16, 333, 20000])
def test_packets_meet_what_embreexs_single_rays_meet(width: int, count: int) -> None:
    rng = np.random.default_rng(0)
    points, corners = _soup(rng)
    rays = _fan(rng, count)
    tree, single = RayTree(points, corners), EmbreeScene(robust=True)
    tree._width = width  # processors differ in what they choose
    TriangleMesh(single, points, corners)
    faces, reach = tree.first_hits(np.zeros(3), rays)
    expected = single.run(np.zeros((count, 3), np.float32), np.ascontiguousarray(rays.T), output=True)
    np.testing.assert_array_equal(faces, expected["primID"])
    hit = faces >= 0
    assert count < 333 or 0.2 < hit.mean() < 0.8
    np.testing.assert_allclose(reach[hit], expected["tfar"][hit], rtol=1e-5)
    assert np.isinf(reach[~hit]).all()


@pytest.mark.parametrize("width", [8, 16])
def test_a_ray_is_blocked_by_what_stands_within_its_reach(width: int) -> None:
    rng = np.random.default_rng(1)
    tree = RayTree(*_soup(rng))
    tree._width = width
    rays = _fan(rng, 333)
    faces, first = tree.first_hits(np.zeros(3), rays)
    hit, starts = faces >= 0, np.zeros((3, 333), np.float32)
    np.testing.assert_array_equal(tree.blocked(starts, rays, np.full(333, np.inf)), hit)
    np.testing.assert_array_equal(tree.blocked(starts, rays, np.where(hit, 1.01 * first, 99)), hit)
    assert not tree.blocked(starts, rays, np.where(hit, 0.99 * first, 99))[hit].any()


def test_rays_from_many_places_each_start_at_their_own() -> None:
    tree = RayTree(np.array([[-1, 5, -1], [1, 5, -1], [0, 5, 2]], np.float32), CORNERS)
    y = np.linspace(0, 9.9, 37, dtype=np.float32)
    starts = np.stack([0 * y, y, 0 * y])
    np.testing.assert_array_equal(
        tree.blocked(starts, np.float32([[0], [1], [0]]) + 0 * starts, np.full(37, np.inf)), y < 5
    )


@pytest.mark.parametrize("part", [-3e-20, -1e-18, -1e-16, 0.0, -0.0, 1e-18])
def test_directions_that_all_but_lie_in_a_plane_of_the_axes_lose_no_packet(part: float) -> None:
    # Embree once took the whole packet for a miss where one ray had a part of -3e-20.
    wall = trimesh.creation.box(bounds=[(-300, 9, -300), (300, 10, 300)]).subdivide().subdivide().subdivide()
    rays = np.stack([np.linspace(-0.3, 0, 16), np.ones(16), np.full(16, -0.02)]).astype(np.float32)
    rays[0, -1] = part
    faces, reach = RayTree(wall.vertices, wall.faces).first_hits(np.zeros(3), rays)
    assert (faces >= 0).all()
    np.testing.assert_allclose(reach, 9, rtol=1e-5)  # directions needn't have unit length


def test_no_ray_slips_through_where_faces_meet() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    middles = (ball.vertices[ball.edges_unique[:, 0]] + ball.vertices[ball.edges_unique[:, 1]]) / 2
    towards = np.concatenate([ball.vertices, middles]).T.astype(np.float32)
    faces, _ = RayTree(ball.vertices, ball.faces).first_hits(np.zeros(3), towards)
    assert (faces >= 0).all()
