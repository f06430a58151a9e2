"""Meshes, by the volume they enclose: the divergence theorem shares no code with them."""

import numpy as np
import pytest

from hrc_learn.geometry import Body, Box, Capsule, MeshFile
from hrc_learn.teleoperation import headset
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


@pytest.fixture(autouse=True)
def kept(tmp_path_factory, monkeypatch):
    """Folder of the cached meshes."""
    home = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    return home / "hrc_learn" / "meshes"


@pytest.fixture
def decimated(monkeypatch):
    """Meshes that were simplified, rather than taken from the cache."""
    meshes, simplify = [], headset._decimated
    monkeypatch.setattr(
        headset, "_decimated", lambda mesh: meshes.append(mesh) or simplify(mesh)
    )
    return meshes


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


def fine_capsule(length=0.3):
    capsule = Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.0, length), radius=0.06)
    return capsule_mesh(capsule, segments=60)


def assert_same(mesh, other):
    for name in ("vertices", "faces", "vertex_normals", "face_normals"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(other, name))


@pytest.mark.parametrize("largest_change", [2e-3, -1.0], ids=["simplified", "unchanged"])
def test_a_mesh_from_the_cache_is_the_one_that_was_computed(
    kept, decimated, monkeypatch, largest_change
):
    monkeypatch.setattr(headset, "_OFF", largest_change)
    first, again = simplified(fine_capsule()), simplified(fine_capsule())
    assert len(decimated) == 1
    assert (len(first.faces) <= 1500) == (largest_change > 0)
    assert_same(again, first)
    (file,) = kept.iterdir()  # no workspace is left
    assert file.suffix == ".npz"


def test_another_mesh_is_not_taken_for_one_in_the_cache(decimated):
    meshes = [fine_capsule(), fine_capsule(0.3 + 1e-12), fine_capsule()]
    meshes[2].faces = meshes[2].faces[::-1]
    results = [simplified(mesh) for mesh in meshes]
    assert len(decimated) == 3
    assert np.ptp(results[1].vertices[:, 2]) == pytest.approx(0.42, abs=2e-3)


def test_another_version_of_the_code_or_the_library_simplifies_anew(
    tmp_path, decimated, monkeypatch
):
    simplified(fine_capsule())
    monkeypatch.setattr(headset, "version", lambda name: "another")
    simplified(fine_capsule())
    (tmp_path / "code.py").write_text("another")
    monkeypatch.setattr(headset, "__file__", str(tmp_path / "code.py"))
    simplified(fine_capsule())
    assert len(decimated) == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: content[:300] + bytes([content[300] ^ 1]) + content[301:],
        lambda content: b"no archive",
    ],
    ids=["empty", "half", "cut", "one bit", "other"],
)
def test_a_damaged_file_in_the_cache_is_ignored_and_replaced(kept, decimated, damage):
    first = simplified(fine_capsule())
    (file,) = kept.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert_same(simplified(fine_capsule()), first)
    assert len(decimated) == 2
    assert_same(simplified(fine_capsule()), first)
    assert len(decimated) == 2


def test_a_cache_that_cannot_be_written_is_no_error(kept, decimated):
    kept.parent.write_text("a file where the folder should be")
    assert_same(simplified(fine_capsule()), simplified(fine_capsule()))
    assert len(decimated) == 2
