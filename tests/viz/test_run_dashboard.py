"""Recordings of runs, finished and going on, read again."""

import threading
import time
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import rerun as rr
from PIL import Image
from rrd_reading import Rrd
from sample_runs import OPTIONAL, sample_run, until

from hrc_learn.geometry import Box, Capsule, MeshFile
from hrc_learn.log import Event, RunRecording, StepLog
from hrc_learn.viz import palette
from hrc_learn.viz.panels import run_tabs
from hrc_learn.viz.rerun_stream import capsules, samples, thin
from hrc_learn.viz.run_dashboard import (
    LogStream,
    live_dashboard,
    live_sender,
    record_run,
    run_layout,
)


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
    every = [c for tab in run_tabs(run, True) for plot in tab.plots for c in plot.curves]
    assert len(every) > 30
    for curves in every:
        np.testing.assert_array_equal(rrd.scalars(curves.path), curves.values)
        np.testing.assert_allclose(rrd.time(curves.path), run.time, atol=1e-9)
        kind = "SeriesPoints" if curves.marks else "SeriesLines"
        names = rrd.column(curves.path, f"{kind}:names", static=True)
        assert names == [list(curves.names)]


def test_the_layout_comes_with_the_data(rrd):
    assert rrd.blueprints == 1
    assert rrd.column("__properties", "RecordingInfo:name", static=True) == [["Grasp"]]


def names_of(part) -> set[str]:
    """Names of the views and tabs of a layout."""
    inner = set().union(*map(names_of, getattr(part, "contents", None) or ()))
    return inner | {part.name} if isinstance(getattr(part, "name", None), str) else inner


def test_empty_plots_are_left_out_of_finished_runs():
    nothing = np.full(len(sample_run().time), np.nan)
    run = sample_run(elbow_motion=nothing, potentials={"x": nothing}, potential_rate=None)
    elbow, lyapunov = "Elbow: displacement [mm]", "Lyapunov"
    over, going_on = (names_of(run_layout(run, f).root_container) for f in (True, False))
    assert {elbow, lyapunov} <= going_on  # it may come
    assert not {elbow, lyapunov} & over
    assert "Person" in over
    assert elbow in names_of(run_layout(sample_run()).root_container)


def test_bodies_have_their_recorded_poses(run, rrd):
    (body,) = run.bodies
    time = rrd.time("world/bodies/hand")
    assert (np.diff(time) < 0.05).all()
    at = np.searchsorted(run.time, time - 1e-9)
    translation = np.array(rrd.column("world/bodies/hand", "Transform3D:translation"))[:, 0]
    quaternion = np.array(rrd.column("world/bodies/hand", "Transform3D:quaternion"))[:, 0]
    np.testing.assert_allclose(translation, body.position[at], atol=1e-6)
    # Rerun writes x, y, z, w in single precision.
    np.testing.assert_allclose(quaternion[:, [3, 0, 1, 2]], body.orientation[at], atol=1e-6)


def test_the_region_of_the_controller_is_drawn_while_it_acts(tmp_path):
    run = sample_run()
    steps = len(run.time)
    region = np.full((steps, 6), np.nan)
    region[20:60] = [0.3, 0.4, 0.2, 0.1, 0.1, 0.003]
    region[60:90] = [0.4, 0.2, 0.4, 0.06, 0.08, 0.003]
    drawn = (np.arange(steps) >= 60) & (np.arange(steps) < 90)
    said = Event(float(run.time[60]), "The region drawn leads the end effector.")
    path = tmp_path / "run.rrd"
    record_run(path, sample_run(active_region=region, drawn=drawn, remarks=(said,)))
    rrd = Rrd(path)
    at = np.searchsorted(run.time, rrd.time("world/active_region") - 1e-9)
    boxes = rrd.column("world/active_region", "Boxes3D:centers")
    assert [len(row) for row in boxes] == [int(20 <= k < 90) for k in at]
    first, last = np.searchsorted(at, [20, 89])
    np.testing.assert_allclose(boxes[last][0], [0.4, 0.2, 0.4], atol=1e-6)
    halves = rrd.column("world/active_region", "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves[first][0], [0.1, 0.1, 0.003], atol=1e-6)
    colours = rrd.column("world/active_region", "Boxes3D:colors")
    for k, colour in ((first, palette.TARGET), (last, palette.PERSON)):
        assert colours[k] == [int.from_bytes(palette.rgba(colour))]
    assert any("region drawn" in text for (text,) in rrd.column("phases", "TextLog:text"))


def test_an_arrow_joins_worker_and_robot_where_they_are_nearest(tmp_path):
    nearest = sample_run().worker_nearest.copy()
    nearest[:50] = np.nan
    path = tmp_path / "run.rrd"
    record_run(path, sample_run(worker_nearest=nearest))
    rrd = Rrd(path)
    time = rrd.time("world/worker_distance")
    starts, arrows = (
        rrd.column("world/worker_distance", f"Arrows3D:{part}")
        for part in ("origins", "vectors")
    )
    at = np.searchsorted(sample_run().time, time - 1e-9)
    assert any(at < 50)
    for k, start, arrow in zip(at, starts, arrows, strict=True):
        assert len(start) == len(arrow) == (k >= 50)
        if len(start):
            ends = np.array([start[0], np.add(start[0], arrow[0])])
            np.testing.assert_allclose(ends, nearest[k], atol=1e-6)


def test_an_arrow_shows_a_push_while_it_lasts(run, rrd):
    time = rrd.time("world/push")
    at = np.searchsorted(run.time, time - 1e-9)
    pushed = np.isfinite(run.push[at, 0, 0])
    assert 0 < pushed.sum() < len(pushed)
    vectors = rrd.column("world/push", "Arrows3D:vectors")
    assert [len(row) for row in vectors] == pushed.astype(int).tolist()
    k = int(pushed.argmax())
    np.testing.assert_allclose(
        vectors[k][0], run.push[at[k], 1] - run.push[at[k], 0], atol=1e-6
    )
    origins = rrd.column("world/push", "Arrows3D:origins")
    np.testing.assert_allclose(origins[k][0], run.push[at[k], 0], atol=1e-6)


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


def test_marks_vanish_while_the_feature_is_hidden(run, rrd):
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


def test_the_path_in_the_image_skips_hidden_features(rrd):
    for (strip,) in rrd.column("world/camera/image/path", "LineStrips2D:strips"):
        assert np.isfinite(strip).all()


def test_static_shapes_are_recorded(run, rrd):
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
    mappings = {name: {} for name in ("potentials", "safety", "worker_distance", "hindered")}
    empty = {"bodies": (), "boxes": (), "phases": ()}
    record_run(tmp_path / "bare.rrd", sample_run(**fields, **mappings, **empty))
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


def test_every_step_arrives_once_and_in_order(tmp_path):
    log = StepLog(block=64)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    with live_sender(LogStream(log, stream, ["joint", "error"]).send, period=0.002):
        for k in range(1000):
            log.append(time=k / 1000, joint=np.full(7, k), error=-k, unsent=0.0)
            if k % 50 == 0:
                time.sleep(0.002)
    stream.disconnect()
    rrd = Rrd(tmp_path / "live.rrd")
    order = np.argsort(rrd.time("live/joint"), kind="stable")
    k = np.arange(1000)
    np.testing.assert_allclose(rrd.time("live/joint")[order], k / 1000, atol=1e-9)
    np.testing.assert_array_equal(rrd.scalars("live/joint")[order], k[:, None] + np.zeros(7))
    assert sorted(rrd.scalars("live/error")[:, 0]) == (-k[::-1]).tolist()
    assert "live/unsent" not in rrd.entities


def test_an_error_of_the_thread_is_raised_at_the_end_of_the_block():
    log = StepLog()
    log.append(time=0.0)
    sender = live_sender(LogStream(log, rr.RecordingStream("test"), ["speed"]).send)
    with pytest.raises(ValueError, match="speed"), sender:
        pass


def test_an_error_of_the_loop_comes_first():
    def fail() -> None:
        raise ValueError

    with pytest.raises(ZeroDivisionError), live_sender(fail):
        raise ZeroDivisionError
    assert "live_sender" not in {thread.name for thread in threading.enumerate()}


def test_rows_are_read_whole_while_another_thread_appends():
    log, done, torn = StepLog(block=16), threading.Event(), []

    def read() -> None:
        seen = 0
        while not done.is_set() or seen < len(log):
            for rows in log.blocks(seen):
                expected = np.arange(seen, seen + len(rows))
                if (rows["a"] != expected).any() or (rows["b"] != expected[:, None]).any():
                    torn.append(seen)
                seen += len(rows)

    reader = threading.Thread(target=read)
    reader.start()
    for k in range(20_000):
        log.append(a=k, b=np.full(30, k))
    done.set()
    reader.join()
    assert torn == []


def test_a_run_sent_as_it_grows_arrives_like_a_finished_one(tmp_path):
    run = sample_run()
    # No step, a few, as many as before, and so on: as a thread happens to come.
    lengths = iter([None, 1, 1, 37, 90, 150])
    drawn = threading.Event()

    def snapshot():
        steps = next(lengths, len(run.time))
        if steps == len(run.time):
            drawn.set()
        return None if steps is None else until(run, steps)

    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    with live_dashboard(stream, snapshot, period=0.001):
        assert drawn.wait(timeout=60)
    stream.disconnect()
    record_run(tmp_path / "saved.rrd", run)
    live, saved = Rrd(tmp_path / "live.rrd"), Rrd(tmp_path / "saved.rrd")
    assert live.entities == saved.entities
    for curves in (c for tab in run_tabs(run) for plot in tab.plots for c in plot.curves):
        order = np.argsort(live.time(curves.path), kind="stable")
        np.testing.assert_array_equal(live.scalars(curves.path)[order], curves.values)
    assert sorted(live.column("phases", "TextLog:text")) == saved.column(
        "phases", "TextLog:text"
    )
    assert len(live.column("world/camera/image", "EncodedImage:blob")) == 3
    for entity in ("world/scene", "world/camera", "world/bodies/hand/capsules"):
        assert live.rows(entity, static=True) == saved.rows(entity, static=True) == 1, entity
    # The last samples are the same; in between a growing run is sampled a little more often.
    for entity, component in (
        ("world/bodies/hand", "Transform3D:translation"),
        ("world/paths/run", "LineStrips3D:strips"),
        ("world/camera/image/target", "LineStrips2D:strips"),
    ):
        last = [
            rrd.column(entity, component)[rrd.time(entity).argmax()] for rrd in (live, saved)
        ]
        assert last[0] == last[1], entity
        assert set(saved.time(entity)[[0, -1]]) <= set(live.time(entity))


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


def test_a_mesh_is_drawn_instead_of_capsules(tmp_path):
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
