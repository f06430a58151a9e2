import numpy as np
import pytest
from rrd_reading import Rrd
from sample_runs import NAMES, sample_fit

from hrc_learn.viz.fit_dashboard import record_fit


def test_demonstrations_and_reproductions_are_recorded(tmp_path):
    fit = sample_fit()
    record_fit(tmp_path / "fit.rrd", fit)
    rrd = Rrd(tmp_path / "fit.rrd")
    assert rrd.blueprints == 1
    for i, time in enumerate(fit.time):
        for j, name in enumerate(NAMES):
            root = f"demonstration_{i + 1}/{name}"
            demo, done = rrd.scalars(f"{root}/demonstration"), rrd.scalars(f"{root}/position")
            np.testing.assert_array_equal(demo[:, 0], fit.demos[i][:, j])
            np.testing.assert_array_equal(done[:, 0], fit.reproductions[i][:, j])
            np.testing.assert_allclose(rrd.time(f"{root}/position"), time, atol=1e-9)
        error = rrd.scalars(f"demonstration_{i + 1}/error")
        np.testing.assert_allclose(error, 1.0, atol=1e-9)  # 1 mrad everywhere
    (strips,) = rrd.column("world/demonstrations", "LineStrips3D:strips", static=True)
    assert [len(strip) for strip in strips] == [len(path) for path in fit.demo_paths]


def test_the_summary_lists_every_residual(tmp_path):
    record_fit(tmp_path / "fit.rrd", sample_fit())
    ((text,),) = Rrd(tmp_path / "fit.rrd").column("summary", "TextDocument:text", static=True)
    for line in ("# Placing", "| 50 (used) | 0.0001 |", "| 10 | 0.01 |", "| 2 | 3.00 | 1 |"):
        assert line in text.splitlines()


@pytest.mark.parametrize("most", [1, 2, 10])
def test_only_the_first_demonstrations_get_a_tab(tmp_path, most):
    record_fit(tmp_path / "fit.rrd", sample_fit(), most=most)
    entities = Rrd(tmp_path / "fit.rrd").entities
    shown = {e.split("/")[0] for e in entities if e.startswith("demonstration_")}
    assert len(shown) == min(most, 3)


def test_a_fit_of_an_unknown_robot_has_no_paths(tmp_path):
    fit = sample_fit(demo_paths=(), reproduction_paths=(), joint_limits=None, residual={})
    record_fit(tmp_path / "fit.rrd", fit)
    entities = Rrd(tmp_path / "fit.rrd").entities
    assert not {e for e in entities if e.startswith("world/")}
    assert not {e for e in entities if e.endswith("/limits")}
