from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rrd_reading import Rrd
from sample_runs import sample_run

from hrc_learn.geometry import Box, MeshFile, read_mesh
from hrc_learn.viz import arm_bodies as meshes
from hrc_learn.viz.run_dashboard import record_run

CUBE = """solid cube
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid cube
"""


def test_a_mesh_is_drawn_in_place_of_what_it_shows(tmp_path):
    (tmp_path / "cube.stl").write_text(CUBE)
    run = sample_run()
    (body,) = run.bodies
    plate = Box(centre=(0.0, 0.0, 0.1), half_size=(0.03, 0.03, 0.001), name="marker_plate")
    half_turn = (0.0, 0.0, 0.0, 1.0)
    mesh = MeshFile(
        path=tmp_path / "cube.stl", orientation=half_turn, colour=(1.0, 0.0, 0.0, 1.0)
    )
    body = replace(body, boxes=(*body.boxes, plate), meshes=(mesh,))
    record_run(tmp_path / "run.rrd", replace(run, bodies=(body,)))
    rrd = Rrd(tmp_path / "run.rrd")
    entity = "world/bodies/hand/mesh0_0"
    (corners,) = rrd.column(entity, "Mesh3D:vertex_positions", static=True)
    (normals,) = rrd.column(entity, "Mesh3D:vertex_normals", static=True)
    ((colour,),) = rrd.column(entity, "Mesh3D:albedo_factor", static=True)
    assert sorted(np.round(corners, 6).tolist()) == [[-1, 0, 0], [0, -1, 0], [0, 0, 0]]
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 3, atol=1e-6)
    assert colour == 0xFF0000FF
    assert "world/bodies/hand/capsules" not in rrd.entities
    (labels,) = rrd.column("world/bodies/hand/boxes", "Boxes3D:labels", static=True)
    assert labels == ["marker_plate"]


@pytest.fixture
def installed(monkeypatch):
    """Whether the package with the meshes is there."""

    def put(folder: Path | None) -> None:
        monkeypatch.setattr(meshes, "_folder", lambda: folder)

    return put


def test_the_pandas_parts_have_files(installed):
    installed(Path("meshes"))
    assert meshes.panda_meshes("link7") == (MeshFile(path=Path("meshes/link7.dae")),)
    (right,), (left,) = (meshes.panda_meshes(f"finger_{side}") for side in ("right", "left"))
    assert right.path == left.path
    assert right.orientation == (0, 0, 0, 1)  # half a turn about z
    assert meshes.panda_meshes("tool")[0].path == meshes.panda_meshes("hand")[0].path
    assert meshes.panda_meshes("box") == ()


def test_without_the_package_there_are_none(installed):
    installed(None)
    assert meshes.panda_meshes("link0") == ()


@pytest.mark.parametrize("name", meshes._PARTS)
def test_the_package_holds_every_part_of_the_panda_in_metres(name):
    if meshes._folder() is None:
        pytest.skip("example-robot-data is not installed")
    (mesh,) = meshes.panda_meshes(name)
    corners = np.concatenate([part.vertices for part in read_mesh(mesh.path)])
    size = np.ptp(corners, axis=0)
    assert 0.02 < size.min() < size.max() < 0.35
