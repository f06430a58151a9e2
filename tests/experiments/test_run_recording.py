"""A dashboard beside a work cell: all that is logged arrives, whatever the thread catches."""

from contextlib import contextmanager

import numpy as np
import rerun as rr
import torch
from rrd_reading import Rrd

from hrc_learn.experiments.run_recording import LiveViewConfig, live_view
from hrc_learn.kinematics import panda
from hrc_learn.sim import MotionLog, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.viz import run_dashboard as servers


def test_a_cell_is_shown_while_it_works(tmp_path, monkeypatch):
    @contextmanager
    def into_a_file(port, data_port):
        stream = rr.RecordingStream("test")
        stream.save(tmp_path / "live.rrd")
        yield servers.DashboardServer(stream, f"http://viewer:{port}", f"data:{data_port}")
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
    config = LiveViewConfig(port=1, data_port=2, period=0.01)
    with (
        torch.inference_mode(),
        live_view("Held", config, opened.append)(cell, world, motion),
    ):
        cell.begin_phase("hold")
        cell.hold_pose(0.3)
    assert opened == ["http://viewer:1"]
    rrd = Rrd(tmp_path / "live.rrd")
    path = "joints/panda_joint4/position"
    order = np.argsort(rrd.time(path), kind="stable")
    np.testing.assert_allclose(rrd.time(path)[order], cell.log["time"], atol=1e-9)
    np.testing.assert_array_equal(rrd.scalars(path)[order, 0], cell.log["joint_position"][:, 3])
    assert rrd.column("phases", "TextLog:text") == [["0.0 s: hold"]]
    assert rrd.column("__properties", "RecordingInfo:name", static=True) == [["Held"]]
    assert "world/bodies/link4" in rrd.entities
