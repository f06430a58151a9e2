from pathlib import Path

import numpy as np
import pytest

from hrc_learn.geometry import MeshFile, read_mesh
from hrc_learn.kinematics import drawing


@pytest.fixture
def installed(monkeypatch):
    """Whether the package with the meshes is there."""

    def put(folder: Path | None) -> None:
        monkeypatch.setattr(drawing, "_mesh_folder", lambda: folder)

    return put


def test_the_pandas_parts_have_files(installed):
    installed(Path("meshes"))
    assert drawing.panda_meshes("link7") == (MeshFile(path=Path("meshes/link7.dae")),)
    (right,), (left,) = (drawing.panda_meshes(f"finger_{side}") for side in ("right", "left"))
    assert right.path == left.path
    assert right.orientation == (0, 0, 0, 1)  # half a turn about z
    assert drawing.panda_meshes("tool")[0].path == drawing.panda_meshes("hand")[0].path
    assert drawing.panda_meshes("box") == ()


def test_without_the_package_there_are_none(installed):
    installed(None)
    assert drawing.panda_meshes("link0") == ()


@pytest.mark.parametrize("name", drawing._PARTS)
def test_the_package_holds_every_part_of_the_panda_in_metres(name):
    if drawing._mesh_folder() is None:
        pytest.skip("example-robot-data is not installed")
    (mesh,) = drawing.panda_meshes(name)
    corners = np.concatenate([part.vertices for part in read_mesh(mesh.path)])
    size = np.ptp(corners, axis=0)
    assert 0.02 < size.min() < size.max() < 0.35
