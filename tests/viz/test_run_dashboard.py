from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from rrd_reading import Rrd
from sample_runs import OPTIONAL, sample_run

from hrc_learn.geometry import Capsule
from hrc_learn.viz import RunRecording
from hrc_learn.viz.panels import run_tabs
from hrc_learn.viz.rerun_stream import capsules, samples, thin
from hrc_learn.viz.run_dashboard import record_run


@pytest.fixture(scope="module")
def run() -> RunRecording:
    return sample_run()


@pytest.fixture(scope="module")
def rrd(run, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("rrd") / "run.rrd"
    record_run(path, run)
    assert [file.name for file in path.parent.iterdir()] == ["run.rrd"]
    return Rrd(path)


def test_every_curve_is_recorded_at_every_step(run, rrd):
    every = [c for tab in run_tabs(run) for plot in tab.plots for c in plot.curves]
    assert len(every) > 30
    for curves in every:
        np.testing.assert_array_equal(rrd.scalars(curves.path), curves.values)
        np.testing.assert_allclose(rrd.time(curves.path), run.time, atol=1e-9)
        names = rrd.column(curves.path, "SeriesLines:names", static=True)
        assert names == [list(curves.names)]


def test_the_layout_comes_with_the_data(rrd):
    assert rrd.blueprints == 1
    assert rrd.column("__properties", "RecordingInfo:name", static=True) == [["Grasp"]]


def test_bodies_move_as_they_did(run, rrd):
    (body,) = run.bodies
    time = rrd.time("world/bodies/hand")
    assert (np.diff(time) < 0.05).all()
    at = np.searchsorted(run.time, time - 1e-9)
    translation = np.array(rrd.column("world/bodies/hand", "Transform3D:translation"))[:, 0]
    quaternion = np.array(rrd.column("world/bodies/hand", "Transform3D:quaternion"))[:, 0]
    np.testing.assert_allclose(translation, body.position[at], atol=1e-6)
    # Rerun writes x, y, z, w in single precision.
    np.testing.assert_allclose(quaternion[:, [3, 0, 1, 2]], body.orientation[at], atol=1e-6)


def test_the_path_of_the_run_grows_to_its_end(run, rrd):
    strips = [row[0] for row in rrd.column("world/paths/run", "LineStrips3D:strips")]
    lengths = [len(strip) for strip in strips]
    assert lengths == sorted(lengths)
    assert lengths[0] == 1
    np.testing.assert_allclose(strips[-1][-1], run.position[-1], atol=1e-6)


def test_images_are_jpeg_at_their_times(run, rrd):
    blobs = rrd.column("world/camera/image", "EncodedImage:blob")
    np.testing.assert_allclose(rrd.time("world/camera/image"), run.camera.image_time, atol=1e-9)
    for (blob,), image in zip(blobs, run.camera.images, strict=True):
        decoded = np.asarray(Image.open(BytesIO(bytes(blob))))
        assert decoded.shape == image.shape
        assert abs(decoded.mean() - image.mean()) < 2


def test_marks_vanish_while_there_is_nothing_to_mark(run, rrd):
    time = rrd.time("world/camera/image/feature")
    at = np.searchsorted(run.time, time - 1e-9)
    seen = np.isfinite(run.camera.feature[at, 0])
    rows = rrd.column("world/camera/image/feature", "Points2D:positions")
    assert [len(row) for row in rows] == seen.astype(int).tolist()
    np.testing.assert_allclose(
        [row[0] for row in rows if row], run.camera.feature[at][seen], atol=1e-4
    )
    wanted = np.isfinite(run.camera.target[at, 0])
    crosses = rrd.column("world/camera/image/target", "LineStrips2D:strips")
    assert [len(row) for row in crosses] == (2 * wanted).tolist()
    np.testing.assert_allclose(np.mean(crosses[-1], axis=(0, 1)), run.camera.target[-1])


def test_the_path_in_the_image_skips_what_was_not_seen(rrd):
    for (strip,) in rrd.column("world/camera/image/path", "LineStrips2D:strips"):
        assert np.isfinite(strip).all()


def test_the_still_things_are_there(run, rrd):
    for name, path in (("demonstration", run.demo_path), ("plan", run.plan_path)):
        ((strip,),) = rrd.column(f"world/paths/{name}", "LineStrips3D:strips", static=True)
        np.testing.assert_allclose(strip, path, atol=1e-6)
    (half_size,) = rrd.column("world/region", "Boxes3D:half_sizes", static=True)
    np.testing.assert_allclose(half_size, [run.region.half_size], atol=1e-6)
    ((label,),) = rrd.column("world/scene", "Boxes3D:labels", static=True)
    assert label == "table"
    (resolution,) = rrd.column("world/camera", "Pinhole:resolution", static=True)
    assert resolution == [[160.0, 120.0]]


def test_phases_are_logged_at_their_times(rrd):
    assert rrd.column("phases", "TextLog:text") == [["0.0 s: Approach"], ["1.0 s: Servo"]]
    assert rrd.time("phases").tolist() == [0.0, 1.0]


def test_a_run_without_extras_is_recorded_too(tmp_path):
    fields = dict.fromkeys(OPTIONAL)
    empty = {"potentials": {}, "safety": {}, "bodies": (), "boxes": (), "phases": ()}
    record_run(tmp_path / "bare.rrd", sample_run(**fields, **empty))
    moving = {e for e in Rrd(tmp_path / "bare.rrd").entities if not e.startswith("__")}
    joints = {f"joints/joint{i}/position" for i in range(1, 8)}
    assert moving == joints | {"world", "world/paths/run"}


def test_a_failed_recording_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "run.rrd"
    path.write_bytes(b"old")
    run = sample_run()
    broken = run.bodies[0]
    object.__setattr__(broken, "orientation", np.zeros((3, 4)))
    with pytest.raises(IndexError):
        record_run(path, run)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("end", [[0, 0, 2], [0, 0, -2], [1, 0, 0], [0.3, -0.4, 0.5], [0, 0, 0]])
def test_capsules_reach_from_start_to_end(end):
    start = np.array([0.1, 0.2, 0.3])
    shape = Capsule(start=tuple(start), end=tuple(start + end), radius=0.05)
    sent = capsules((shape,))
    x, y, z, w = np.array(sent.quaternions.pa_array.to_pylist()[0])
    (length,) = sent.lengths.pa_array.to_pylist()
    (begin,) = sent.translations.pa_array.to_pylist()
    turned_z = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(begin + length * np.array(turned_z), start + end, atol=1e-6)


def test_samples_keep_both_ends():
    time = np.arange(1000) / 125
    chosen = samples(time, 10.0)
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert len(chosen) == pytest.approx(81, abs=1)


def test_thinned_paths_keep_both_ends():
    path = np.arange(3000.0).reshape(-1, 3)
    short = thin(path)
    assert len(short) <= 400
    np.testing.assert_array_equal(short[[0, -1]], path[[0, -1]])
    assert thin(path[:50]) is not None
    np.testing.assert_array_equal(thin(path[:50]), path[:50])
