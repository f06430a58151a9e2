import numpy as np
import pytest

from hrc_learn.geometry import MeshFile, read_mesh

CUBE_CORNERS = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
# Counter-clockwise from outside.
SIDES = [
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
]
TRIANGLES = [(a, b, c) for s in SIDES for a, b, c in ((s[0], s[1], s[2]), (s[0], s[2], s[3]))]


def obj(path, colour=False):
    lines = ["mtllib cube.mtl", "usemtl red"] if colour else []
    lines += ["v {} {} {}".format(*corner) for corner in CUBE_CORNERS]
    # Mixed: polygons, texture indices, and counting from the end.
    lines += ["f " + " ".join(f"{k + 1}/1/1" for k in side) for side in SIDES[:3]]
    lines += ["f " + " ".join(str(k - 8) for k in side) for side in SIDES[3:]]
    path.write_text("\n".join(lines))
    (path.parent / "cube.mtl").write_text("newmtl red\nKd 0.5 0.25 0.125\n")
    return path


def binary_stl(path):
    record = np.zeros(12, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    record["corners"] = np.array(CUBE_CORNERS)[np.array(TRIANGLES)]
    path.write_bytes(b"solid, though binary".ljust(80) + (12).to_bytes(4, "little"))
    with path.open("ab") as file:
        file.write(record.tobytes())
    return path


def text_stl(path):
    facets = [
        "facet normal 0 0 0\n outer loop\n"
        + "\n".join("  vertex {} {} {}".format(*CUBE_CORNERS[k]) for k in triangle)
        + "\n endloop\nendfacet"
        for triangle in TRIANGLES
    ]
    path.write_text("\n".join(["solid x", *facets, "endsolid x"]))
    return path


def collada(path, node="", unit="1"):
    """A cube in polygons, in a node with the transforms given."""
    numbers = " ".join(str(value) for corner in CUBE_CORNERS for value in corner)
    corners = " ".join(f"{k} 0" for side in SIDES for k in side)
    path.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}"/><up_axis>Y_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique><phong><diffuse>
<color>0.5 0.25 0.125 1</color></diffuse></phong></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="n" count="24">{numbers}</float_array><technique_common>
<accessor source="#n" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="6" material="s"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#p" offset="1"/>
<vcount>4 4 4 4 4 4</vcount><p>{corners}</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node>{node}<node><instance_geometry url="#g">
<bind_material><technique_common><instance_material symbol="s" target="#m"/>
</technique_common></bind_material></instance_geometry></node></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""")
    return path


def volume(part):
    a, b, c = part.vertices[part.faces].transpose(1, 0, 2)
    return np.linalg.det(np.stack([a, b, c], axis=-1)).sum() / 6


@pytest.mark.parametrize(
    ("write", "name"),
    [(obj, "c.obj"), (binary_stl, "b.stl"), (text_stl, "t.STL"), (collada, "c.dae")],
)
def test_a_cube_is_a_cube_in_every_format(tmp_path, write, name):
    (part,) = read_mesh(write(tmp_path / name))
    assert volume(part) == pytest.approx(1.0)
    assert part.faces.shape == (12, 3)
    # Its edges are sharp: every side has its own four corners, whose normals are its own.
    assert part.vertices.shape == (24, 3)
    assert sorted(map(tuple, np.abs(part.normals).round(9).tolist())) == sorted(
        [axis for axis in ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)) for _ in range(8)]
    )
    outward = part.normals * (part.vertices - 0.5)
    assert (outward.sum(-1) > 0).all()


def test_a_round_surface_is_shaded_smoothly(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in ring]
    after = [(k + 1) % 24 for k in range(24)]
    lines += [f"f {k + 1} {n + 1} {n + 25} {k + 25}" for k, n in enumerate(after)]
    (tmp_path / "tube.obj").write_text("\n".join(lines))
    (part,) = read_mesh(tmp_path / "tube.obj")
    assert len(part.vertices) == 48  # nothing is split
    radial = part.vertices * [1, 1, 0]
    # The last step of area weighting: 15 degrees from side to side, cut into triangles.
    assert ((radial * part.normals).sum(-1) > np.cos(np.deg2rad(4))).all()


def test_colours_come_from_the_materials(tmp_path):
    for part in (
        *read_mesh(obj(tmp_path / "red.obj", True)),
        *read_mesh(collada(tmp_path / "r.dae")),
    ):
        assert part.colour == pytest.approx((0.5, 0.25, 0.125, 1.0), abs=1 / 255)
    (plain,) = read_mesh(binary_stl(tmp_path / "plain.stl"))
    assert plain.colour is None
    assert plain.placed(MeshFile(path=tmp_path, colour=(0.0, 1.0, 0.0, 1.0))).colour[1] == 1.0


def test_collada_places_its_nodes(tmp_path):
    node = (
        "<translate>0 0 5</translate><rotate>0 0 1 90</rotate><scale>2 1 1</scale>"
        "<matrix>1 0 0 10 0 1 0 0 0 0 1 0 0 0 0 1</matrix>"
    )
    (part,) = read_mesh(collada(tmp_path / "c.dae", node, unit="0.01"))
    # x to 10..11, doubled to 20..22, turned onto y; in centimetres, read in float32.
    np.testing.assert_allclose(part.vertices.min(0), [-0.01, 0.20, 0.05], atol=1e-7)
    np.testing.assert_allclose(part.vertices.max(0), [0.00, 0.22, 0.06], atol=1e-7)


def test_a_mirrored_node_keeps_its_outside(tmp_path):
    (part,) = read_mesh(collada(tmp_path / "c.dae", "<scale>-1 1 1</scale>"))
    assert volume(part) == pytest.approx(1.0)


def test_a_placed_part_is_turned_moved_and_scaled(tmp_path):
    (part,) = read_mesh(obj(tmp_path / "c.obj"))
    half = np.sqrt(0.5)
    placed = part.placed(
        MeshFile(
            path=tmp_path,
            position=(0.0, 0.0, 7.0),
            orientation=(half, 0.0, 0.0, half),  # a quarter turn about z
            scale=(3.0, 1.0, 1.0),
        )
    )
    np.testing.assert_allclose(placed.vertices.min(0), [-1, 0, 7], atol=1e-12)
    np.testing.assert_allclose(placed.vertices.max(0), [0, 3, 8], atol=1e-12)
    assert volume(placed) == pytest.approx(3.0)
    np.testing.assert_allclose(np.linalg.norm(placed.normals, axis=-1), 1.0)


def test_what_is_no_mesh_is_refused_by_name(tmp_path):
    (tmp_path / "a.fbx").write_text("")
    with pytest.raises(ValueError, match=r"a\.fbx is not a mesh that trimesh reads"):
        read_mesh(tmp_path / "a.fbx")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"empty\.obj holds no triangle"):
        read_mesh(tmp_path / "empty.obj")
    (tmp_path / "cut.stl").write_text("solid\nvertex 0 0 0\nvertex 1 0 0\n")
    with pytest.raises(ValueError, match=r"cut\.stl (holds no triangle|is not a mesh)"):
        read_mesh(tmp_path / "cut.stl")
