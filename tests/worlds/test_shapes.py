"""Solids against trimesh's own geometry."""

import numpy as np
import pytest
import trimesh

from depthreg.worlds.scene import Material
from depthreg.worlds.shapes import Part, assemble, join, unit_mesh

SOLIDS = ("box", "cylinder", "rod", "sphere", "ball", "cone", "shade", "pot", "wedge", "bowl", "bottle")
GREY = Material((0.5, 0.5, 0.5))


@pytest.mark.parametrize("shape", [*SOLIDS, "foliage"])
def test_a_unit_solid_stands_on_the_floor_and_fits_the_unit_box(shape: str) -> None:
    vertices, _ = unit_mesh(shape)
    assert vertices[:, 2].min() >= -1e-9
    assert np.abs(vertices[:, :2]).max() <= 0.5 + 1e-9
    assert vertices[:, 2].max() <= 1 + 1e-9


@pytest.mark.parametrize("shape", SOLIDS)
def test_a_solid_is_closed_with_its_faces_outwards(shape: str) -> None:
    mesh = trimesh.Trimesh(*unit_mesh(shape))  # merges equal vertices
    assert mesh.is_watertight
    assert mesh.volume > 0.05


def test_a_part_is_scaled_turned_and_moved_as_trimesh_does_it() -> None:
    part = Part("wedge", (2.0, 3.0, 0.5), (1.0, -2.0, 0.25), GREY, yaw_deg=33.0)
    (ours,) = assemble("ramp", [part], at_m=(5.0, 6.0, 7.0), yaw_deg=-71.0)
    vertices, faces = unit_mesh("wedge")
    expected = trimesh.Trimesh(vertices * (2.0, 3.0, 0.5), faces, process=False)
    for angle_deg, shift in ((33.0, (1.0, -2.0, 0.25)), (-71.0, (5.0, 6.0, 7.0))):
        turn = trimesh.transformations.rotation_matrix(np.radians(angle_deg), [0, 0, 1])
        expected.apply_transform(turn)
        expected.apply_translation(shift)
    np.testing.assert_allclose(ours.mesh.vertices, expected.vertices, atol=1e-12)


def test_joined_parts_keep_their_volumes() -> None:
    parts = [Part("box", (1, 2, 3), (0, 0, 0), GREY), Part("box", (1, 1, 1), (9, 0, 0), GREY, 45.0)]
    assert join(parts).volume == pytest.approx(7.0)


def test_parts_of_one_material_become_one_object() -> None:
    red = Material((0.8, 0.1, 0.1))
    parts = [Part("box", (1, 1, 1), (x, 0, 0), m) for x, m in ((0, GREY), (2, red), (4, GREY))]
    objects = assemble("thing", parts)
    assert [o.material for o in objects] == [GREY, red]
    assert [len(o.mesh.faces) for o in objects] == [24, 12]


def test_shared_unit_meshes_cannot_be_spoilt() -> None:
    with pytest.raises(ValueError, match="read-only"):
        unit_mesh("box")[0][0] = 7
