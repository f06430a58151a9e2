"""A dashboard beside a work cell: all that is logged arrives, whatever the thread catches."""

from contextlib import contextmanager

import numpy as np
import rerun as rr
import torch
from rrd_reading import Rrd

from hrc_learn.experiments.experiment import live_view
from hrc_learn.experiments.run_recorder import push_arrows
from hrc_learn.kinematics import panda
from hrc_learn.sim import MotionLog, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.teleoperation import dashboard_page as servers


def test_a_cell_is_shown_while_it_works(tmp_path, monkeypatch):
    @contextmanager
    def into_a_file():
        stream = rr.RecordingStream("test")
        stream.save(tmp_path / "live.rrd")
        yield stream, "http://viewer"
        stream.disconnect()

    monkeypatch.setattr(servers, "serve_stream", into_a_file)
    workplace, opened = Workplace(), []
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    motion = MotionLog(world)
    cell = WorkCell(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=ScriptedPerturbation(panda, ()),
        advance=motion.advance,
    )
    with (
        torch.inference_mode(),
        live_view("Held", opened.append)(cell, world, motion),
    ):
        cell.begin_phase("hold")
        cell.hold_pose(0.3)
    assert opened == ["http://viewer"]
    rrd = Rrd(tmp_path / "live.rrd")
    path = "joints/panda_joint4/position"
    order = np.argsort(rrd.time(path), kind="stable")
    np.testing.assert_allclose(rrd.time(path)[order], cell.log["time"], atol=1e-9)
    np.testing.assert_array_equal(rrd.scalars(path)[order, 0], cell.log["joint_position"][:, 3])
    assert rrd.column("phases", "TextLog:text") == [["0.0 s: hold"]]
    assert rrd.column("__properties", "RecordingInfo:name", static=True) == [["Held"]]
    assert "world/bodies/link4" in rrd.entities


def test_a_push_points_where_it_would_move_the_elbow():
    generator = torch.Generator().manual_seed(0)
    limits = panda.limits
    share = torch.rand(20, 7, generator=generator, dtype=torch.float64)
    q = torch.lerp(limits.lower, limits.upper, share)
    force = torch.randn(20, 3, 1, generator=generator, dtype=torch.float64)
    elbow = panda.joint_jacobian(q, 4)[:, :3]
    d = 20.0 * (elbow.mT @ force)[..., 0]
    d[:5] = 0.1  # nobody push_arrows
    shown = push_arrows(panda, q.numpy(), d.numpy())
    assert np.isnan(shown[:5]).all()
    way = shown[5:, 1] - shown[5:, 0]
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), 0.45)
    np.testing.assert_allclose(shown[5:, 0], panda.joint_origins(q)[5:, 3].numpy())
    # By automatic differentiation along what of d leaves the tool where it is.
    null = torch.linalg.qr(panda.jacobian(q).mT, mode="complete").Q[..., 6:]
    rate = (null @ (null.mT @ d[..., None]))[..., 0]
    _, moved = torch.func.jvp(panda.joint_origins, (q,), (rate,))
    moved = moved[5:, 3].numpy()
    moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
    np.testing.assert_allclose(way / 0.45, moved, atol=1e-9)
