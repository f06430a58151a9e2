"""Meshes, by the volume they enclose: the divergence theorem shares no code with them."""

import numpy as np
import pytest

from hrc_learn.geometry import Body, Box, Capsule, MeshFile
from hrc_learn.teleoperation.headset import (
    body_meshes,
    body_shape,
    box_mesh,
    capsule_mesh,
    simplified,
)

TETRAHEDRON = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def volume(mesh):
    """Signed: positive where all faces are counter-clockwise as seen from outside."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def edges_meet_in_pairs(mesh):
    """Whether each edge belongs to two faces that run through it in opposite directions."""
    place = np.unique(mesh.vertices.round(9), axis=0, return_inverse=True)[1].ravel()
    corners = place[mesh.faces]
    edges = [(f[i], f[(i + 1) % 3]) for f in corners.tolist() for i in range(3)]
    edges = [edge for edge in edges if edge[0] != edge[1]]  # at the poles
    return sorted(edges) == sorted((b, a) for a, b in edges)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((0.0, 0.0, -0.1), (0.0, 0.0, 0.3)),
        ((0.1, 0.0, 0.0), (-0.2, 0.3, 0.5)),
        ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
    ],
)
def test_a_capsule_encloses_its_volume(start, end):
    r, length = 0.06, float(np.linalg.norm(np.subtract(end, start)))
    mesh = capsule_mesh(Capsule(start=start, end=end, radius=r), segments=120)
    expected = np.pi * r**2 * length + 4 / 3 * np.pi * r**3
    # Flat faces cut the round ones' corners: 120 of them by 0.1 %.
    assert volume(mesh) == pytest.approx(expected, rel=2e-3)
    assert edges_meet_in_pairs(mesh)
    axis = np.subtract(end, start)
    share = np.clip((mesh.vertices - start) @ axis / max(axis @ axis, 1e-12), 0, 1)
    distance = np.linalg.norm(mesh.vertices - start - share[:, None] * axis, axis=1)
    np.testing.assert_allclose(distance, r, atol=1e-12)


def test_a_box_is_closed_and_as_large_as_it_says():
    mesh = box_mesh(Box(centre=(0.1, -0.2, 0.3), half_size=(0.1, 0.2, 0.3)))
    assert volume(mesh) == pytest.approx(8 * 0.1 * 0.2 * 0.3)
    assert edges_meet_in_pairs(mesh)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [0.0, -0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.2, 0.0, 0.6], atol=1e-12)


def test_a_body_is_all_its_shapes():
    capsule = Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 1.0), radius=0.1)
    box = Box(centre=(2.0, 0.0, 0.0), half_size=(0.1, 0.1, 0.1))
    body = Body(
        name="link1",
        position=np.zeros((1, 3)),
        orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        capsules=(capsule, capsule),
        boxes=(box,),
    )
    total = 2 * volume(capsule_mesh(capsule)) + volume(box_mesh(box))
    ((colour, mesh),) = body_meshes(body).items()
    assert colour == capsule.colour
    assert volume(mesh) == pytest.approx(total)


def test_a_body_with_meshes_is_drawn_in_their_colours(tmp_path):
    (tmp_path / "tetrahedron.obj").write_text(TETRAHEDRON)
    red, plate_colour = (0.8, 0.1, 0.1, 1.0), (0.2, 0.2, 0.2, 1.0)
    shapes = [
        MeshFile(path=tmp_path / "tetrahedron.obj", colour=red),
        MeshFile(path=tmp_path / "tetrahedron.obj", colour=red, scale=(-2.0, 1.0, 1.0)),
    ]
    size = (0.1, 0.1, 0.1)
    body = Body(
        name="link1",
        position=np.zeros((1, 3)),
        orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        capsules=(Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 1.0), radius=0.1),),
        boxes=(
            Box(centre=(2.0, 0.0, 0.0), half_size=size),
            Box(centre=(2.0, 0.0, 0.0), half_size=size, name="plate", colour=plate_colour),
        ),
        meshes=tuple(shapes),
    )
    drawn = body_meshes(body)
    assert set(drawn) == {red, plate_colour}
    # The mirrored one has its outside outside as well: their volumes add up.
    assert volume(drawn[red]) == pytest.approx((1 + 2) / 6)
    assert volume(drawn[plate_colour]) == pytest.approx(8 * 0.1**3)


def test_many_triangles_become_few_and_the_surface_stays():
    end, r = np.array([0.0, 0.0, 0.3]), 0.06
    fine = capsule_mesh(
        Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.3), radius=r), segments=200
    )
    few = simplified(fine)
    assert len(fine.faces) > 10_000
    assert 500 < len(few.faces) <= 1500
    assert edges_meet_in_pairs(few)
    share = np.clip(few.vertices @ end / (end @ end), 0, 1)
    distance = np.linalg.norm(few.vertices - share[:, None] * end, axis=1)
    np.testing.assert_allclose(distance, r, atol=1e-3)
    assert volume(few) == pytest.approx(volume(fine), rel=0.02)
    assert simplified(few) is few


def test_edges_with_two_normals_do_not_tear():
    """Files give such an edge its corners twice, once for each side's normals."""
    capsule = capsule_mesh(
        Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.3), radius=0.06), segments=200
    )
    torn = type(capsule)(
        capsule.vertices[capsule.faces.ravel()],
        np.arange(capsule.faces.size).reshape(-1, 3),
        process=False,
    )
    few = simplified(torn)
    assert len(few.faces) <= 1500
    assert edges_meet_in_pairs(few)
    assert volume(few) == pytest.approx(volume(capsule), rel=0.02)


def test_a_body_of_fine_meshes_is_drawn_by_few_triangles(tmp_path):
    fine = capsule_mesh(Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.3), radius=0.06), 100)
    lines = [*(f"v {x} {y} {z}" for x, y, z in fine.vertices.tolist())]
    lines += [f"f {a} {b} {c}" for a, b, c in (fine.faces + 1).tolist()]
    (tmp_path / "fine.obj").write_text("\n".join(lines))
    colours = (0.8, 0.1, 0.1, 1.0), (0.2, 0.2, 0.2, 1.0)
    body = Body(
        name="link1",
        position=np.zeros((1, 3)),
        orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        capsules=(),
        meshes=tuple(MeshFile(path=tmp_path / "fine.obj", colour=c) for c in colours),
    )
    assert len(fine.faces) > 5000
    for mesh in body_meshes(body).values():
        assert len(mesh.faces) <= 1500
        assert volume(mesh) == pytest.approx(volume(fine), rel=0.02)
    whole = body_shape(body)
    assert len(whole.faces) <= 1500
    np.testing.assert_allclose(np.ptp(whole.vertices, axis=0), [0.12, 0.12, 0.42], atol=2e-3)


def test_a_mesh_of_which_parts_would_be_lost_stays_as_it_is():
    """Triangles that share no edge with others may go without costing any volume."""
    capsule = capsule_mesh(
        Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.3), radius=0.06), segments=200
    )
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.5, 0.5, (400, 1, 3))
    loose = (at + rng.normal(0, 1e-3, (400, 3, 3))).reshape(-1, 3)
    faces = len(capsule.vertices) + np.arange(1200).reshape(-1, 3)
    whole = type(capsule)(
        np.concatenate([capsule.vertices, loose]),
        np.concatenate([capsule.faces, faces]),
        process=False,
    )
    drawn = simplified(whole)
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(drawn.vertices, 0), end(whole.vertices, 0), atol=2e-3)
