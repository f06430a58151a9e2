import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rrd_reading import Rrd
from sample_runs import sample_run

from hrc_learn.geometry import Box, MeshFile
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
    mesh = MeshFile(path=tmp_path / "cube.stl", turn=math.pi)
    body = replace(body, boxes=(*body.boxes, plate), mesh=mesh)
    record_run(tmp_path / "run.rrd", replace(run, bodies=(body,)))
    rrd = Rrd(tmp_path / "run.rrd")
    ((blob,),) = rrd.column("world/bodies/hand/mesh", "Asset3D:blob", static=True)
    assert bytes(blob).decode() == CUBE
    ((turn,),) = rrd.column(
        "world/bodies/hand/mesh", "Transform3D:rotation_axis_angle", static=True
    )
    assert turn["angle"] == pytest.approx(math.pi)
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
    assert meshes.panda_mesh("link7") == MeshFile(path=Path("meshes/link7.dae"))
    right, left = (meshes.panda_mesh(f"finger_{side}") for side in ("right", "left"))
    assert right.path == left.path
    assert right.turn == pytest.approx(np.pi)
    assert meshes.panda_mesh("tool").path == meshes.panda_mesh("hand").path
    assert meshes.panda_mesh("box") is None


def test_without_the_package_there_are_none(installed):
    installed(None)
    assert meshes.panda_mesh("link0") is None


def test_every_file_of_the_package_is_there():
    if meshes._folder() is None:
        pytest.skip("the extra `meshes` is not installed")
    for part in meshes._PARTS:
        assert meshes.panda_mesh(part).path.is_file()
