"""The Research 3 against its models of MuJoCo and Pinocchio, which share no code with ours."""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from sampling import generator, within

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import fr3
from hrc_learn.kinematics.franka import LINK_CAPSULES

_SPEC = find_spec("franky_sim")
pytestmark = pytest.mark.skipif(_SPEC is None, reason="franky-sim has models of the FR3")


def assets() -> Path:
    assert _SPEC is not None
    assert _SPEC.submodule_search_locations is not None
    return Path(_SPEC.submodule_search_locations[0]) / "assets"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(assets() / "fr3.xml"))
    spec.meshdir = str(assets() / "meshes")  # where franky-sim has them
    return spec.compile()


def solve(model: mujoco.MjModel, q: torch.Tensor) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for i, angle in enumerate(q.tolist()):
        data.joint(f"fr3_joint{i + 1}").qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


COUNTS = [100, pytest.param(10_000, marks=pytest.mark.slow)]


def states(count: int) -> torch.Tensor:
    return within(fr3.limits.lower, fr3.limits.upper, count, rng=generator())


@pytest.mark.parametrize("count", COUNTS)
def test_it_is_where_mujoco_has_it(model, count):
    q = states(count)
    links, J = fr3.link_poses(q), fr3.jacobian(q).numpy()
    places = links.position.numpy()
    turns = quaternion.to_matrix(links.orientation).numpy()
    linear, angular = np.zeros((2, 3, model.nv))
    bodies = [model.body(f"fr3_link{i}").id for i in range(1, 8)]
    for k in range(count):
        data = solve(model, q[k])
        np.testing.assert_allclose(places[k, :7], data.xpos[bodies], rtol=0, atol=1e-9)
        theirs = data.xmat[bodies].reshape(7, 3, 3)
        np.testing.assert_allclose(turns[k, :7], theirs, rtol=0, atol=1e-9)
        # The hand's frame is the flange, turned by an angle given there to 7 digits.
        hand = model.body("hand").id
        np.testing.assert_allclose(places[k, 7], data.xpos[hand], rtol=0, atol=1e-9)
        mujoco.mj_jac(model, data, linear, angular, places[k, 8], bodies[-1])
        theirs = np.vstack([linear[:, :7], angular[:, :7]])
        np.testing.assert_allclose(J[k], theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", COUNTS)
def test_it_is_where_pinocchio_has_it(count):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(assets() / "fr3_clean.urdf"))
    data, flange = model.createData(), model.getFrameId("link8")
    q = states(count)
    ours = fr3.link_poses(q)[..., 7].matrix().numpy()
    tip, J = fr3.forward(q).position.numpy(), fr3.jacobian(q).numpy()
    for k in range(count):
        angles = q[k].numpy()
        pin.framesForwardKinematics(model, data, angles)
        frame = data.oMf[flange]
        np.testing.assert_allclose(ours[k, :3, 3], frame.translation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours[k, :3, :3], frame.rotation, rtol=0, atol=1e-9)
        theirs = pin.computeFrameJacobian(model, data, angles, flange, pin.LOCAL_WORLD_ALIGNED)
        # Of the flange there, of the tool centre point here.
        theirs[:3] += np.cross(theirs[3:].T, tip[k] - frame.translation).T
        np.testing.assert_allclose(J[k], theirs, rtol=0, atol=1e-9)


def test_its_meshes_stick_out_of_the_capsules_by_no_more_than_is_said(model):
    data = solve(model, fr3.ready)
    ends = fr3.whole.segments(fr3.ready)
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    furthest: dict[str, float] = {}
    for geom in range(model.ngeom):
        name, mesh = model.body(model.geom_bodyid[geom]).name, model.geom_dataid[geom]
        if mesh < 0 or not (name.startswith("fr3_link") or name == "hand"):
            continue
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        R = data.geom_xmat[geom].reshape(3, 3)
        points = model.mesh_vert[first : first + count] @ R.T + data.geom_xpos[geom]
        p = torch.from_numpy(points).double()[:, None]
        share = ((p - start) * along).sum(-1) / along.square().sum(-1)
        nearest = start + share.clamp(0, 1)[..., None] * along
        out = ((p - nearest).norm(dim=-1) - fr3.whole.radius).amin(-1)
        furthest[name] = max(furthest.get(name, -1.0), float(out.max()))
    assert len(furthest) == 9
    assert 0.04 < furthest.pop("fr3_link0") < 0.047
    assert furthest.pop("hand") < 0.0095
    assert 0.029 < max(furthest.values()) < 0.0305
    assert len(fr3.whole.capsules) == len(LINK_CAPSULES) + 2
