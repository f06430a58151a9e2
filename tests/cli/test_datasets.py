"""The commands for datasets as a user runs them: results, messages, exit status."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from commands import done, hrc
from lerobot_folders import joint_path, write_folder
from rrd_reading import Rrd

from hrc_learn.cli import dashboard_commands, dataset_commands
from hrc_learn.demos import DatasetWriter, load_demos
from hrc_learn.teleoperation import dashboard_page

ROOT = Path(__file__).parents[2]


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "pour.npz"
    np.savez(path, t=3.0 + 0.003 * np.arange(200), q=joint_path(200, 7))
    return path


@pytest.mark.simulation
def test_arrays_are_imported_checked_and_read(recording, tmp_path):
    out = tmp_path / "set"
    status, text, _ = hrc(
        *("import", recording, recording, "--out", out, "--joints", "q", "--time", "t"),
        *("--json", tmp_path / "values.json", "--robot-type", "iiwa14"),
    )
    assert status == 0
    assert "2 demonstrations, 400 frames" in text
    values = json.loads((tmp_path / "values.json").read_text())
    assert values == {"episodes": 2, "frames": 400, "seconds": pytest.approx(1.194), "fps": 333}
    demos = load_demos(out)
    assert demos[1].task == "pour"
    assert demos[1].start_time == 3.0
    np.testing.assert_allclose(demos[1].time, 0.003 * np.arange(200), atol=1e-9)
    np.testing.assert_allclose(demos[1].joint_position, joint_path(200, 7), atol=1e-6)
    # The action is where the next frame is; the last one is to stay.
    command = demos[1].command_position
    np.testing.assert_array_equal(command[:-1], demos[1].joint_position[1:])
    np.testing.assert_array_equal(command[-1], demos[1].joint_position[-1])
    status, text, _ = hrc("check", out, "--json", tmp_path / "check.json")
    assert status == 0
    checked = json.loads((tmp_path / "check.json").read_text())
    assert (checked["errors"], checked["episodes"], checked["frames"]) == (0, 2, 400)
    assert checked["warnings"] >= 1  # the same episode twice
    assert "same motion as episode 0" in text
    assert hrc("check", out, "--strict")[0] == 1


def test_poses_are_imported_in_centimetres(tmp_path):
    angle = np.linspace(0, 1, 50)
    pose = np.column_stack(
        [100 * joint_path(50), np.cos(angle), np.sin(angle), 0 * angle, 0 * angle]
    )
    np.save(tmp_path / "poses.npy", np.stack([pose, pose + 1e-9]))
    status, *_ = hrc(
        *("import", tmp_path / "poses.npy", "--out", tmp_path / "set"),
        *("--columns", "px,py,pz,qw,qx,qy,qz", "--units", "position", "cm", "--duration", "5"),
    )
    assert status == 0
    demos = load_demos(tmp_path / "set")
    assert len(demos) == 2
    np.testing.assert_allclose(demos[0].position, joint_path(50), atol=1e-6)
    assert demos[0].duration == pytest.approx(5)
    action = demos[0].extra["action"]
    np.testing.assert_allclose(action[:-1, :3], demos[0].position[1:], atol=1e-6)
    np.testing.assert_allclose(action[:-1, 3], 2 * angle[1:], atol=1e-6)
    again = ("import", tmp_path / "poses.npy", "--out", tmp_path / "bare", "--no-actions")
    names = ("--columns", "px,py,pz,qw,qx,qy,qz", "--duration", "5")
    # 60 may be centimetres or millimetres.
    assert "the unit is doubtful" in hrc(*again, *names)[2]
    assert hrc(*again, *names, "--units", "position", "cm")[0] == 0
    assert not load_demos(tmp_path / "bare")[0].extra


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--joints", "p", "--time", "t"], "pour.npz, joint_position: there is no column 'p'"),
        (["--joints", "q"], None),
        (["--joints", "q", "--time", "t", "--joint-names", "a"], "1 joint names for 7 columns"),
        (["--position", "q", "--time", "t"], "position needs 3 columns, not 7"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(recording, tmp_path, arguments, message):
    status, _, error = hrc("import", recording, "--out", tmp_path / "set", *arguments)
    if message is None:  # the array of stamps is found by its name
        assert status == 0
        return
    assert status == 2
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pour.npz"]


def test_a_preview_writes_a_mapping_that_can_be_corrected(tmp_path):
    q, path, map_file = joint_path(200, 7), tmp_path / "run.npz", tmp_path / "map.json"
    np.savez(path, t=0.01 * np.arange(200), qpos=q, action=q + 0.01, tactile=q[:, :2])
    status, text, _ = hrc("import", path, "--dry-run", "--mapping", map_file)
    assert status == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map.json", "run.npz"]
    assert "left out: tactile" in text
    said = json.loads(map_file.read_text())
    assert said["columns"] == {"joint_position": ["qpos"], "command_position": ["action"]}
    said["columns"] |= {
        "joint_position": ["qpos[0:6]"],
        "command_position": ["action[0:6]"],
        "gripper": "qpos[6]",
        "observation.tactile": "tactile",
    }
    said |= {"joint_names": list("abcdef"), "units": {"gripper": "m"}}
    map_file.write_text(json.dumps(said))
    assert hrc("import", path, "--out", tmp_path / "set", "--mapping", map_file)[0] == 0
    (demo,) = load_demos(tmp_path / "set")
    assert demo.joint_names == tuple("abcdef")
    np.testing.assert_allclose(demo.gripper, q[:, 6], atol=1e-6)
    np.testing.assert_allclose(demo.command_position, q[:, :6] + 0.01, atol=1e-6)
    np.testing.assert_allclose(demo.extra["observation.tactile"], q[:, :2], atol=1e-6)
    map_file.write_text(json.dumps({"colums": {}}))
    status, _, error = hrc("import", path, "--dry-run", "--mapping", map_file)
    assert status == 2
    assert "map.json: colums: no such setting; did you mean columns?" in error


@pytest.mark.long
@pytest.mark.simulation
def test_commands_and_gripper_are_named_on_the_command_line(tmp_path):
    q, path = joint_path(200, 7), tmp_path / "run.npz"
    np.savez(path, t=0.01 * np.arange(200), q=q, u=q + 0.01, g=0.08 * (q[:, 0] > 0))
    named = ("--joints", "q", "--command", "u", "--gripper", "g")
    assert hrc("import", path, "--out", tmp_path / "set", *named)[0] == 0
    (demo,) = load_demos(tmp_path / "set")
    np.testing.assert_allclose(demo.command_position, q + 0.01, atol=1e-6)
    np.testing.assert_allclose(demo.gripper, 0.08 * (q[:, 0] > 0), atol=1e-6)
    fitted = hrc("fit", tmp_path / "set", "--n-basis", 10)
    assert fitted.status == 0, fitted.error
    assert "no primitive is fitted to the gripper" in " ".join(fitted.output.split())


def test_an_existing_dataset_is_not_touched(recording, tmp_path):
    (tmp_path / "set").mkdir()
    arguments = ("import", recording, "--out", tmp_path / "set", "--joints", "q")
    status, _, error = hrc(*arguments)
    assert status == 2
    assert "already exists" in error


def test_recordings_of_different_robots_do_not_mix(recording, tmp_path):
    np.savez(tmp_path / "other.npz", t=0.003 * np.arange(200), q=joint_path(200, 6))
    status, _, error = hrc(
        *("import", recording, tmp_path / "other.npz"),
        *("--out", tmp_path / "set", "--joints", "q", "--time", "t"),
    )
    assert status == 2
    assert "do not fit into one dataset" in error


@pytest.mark.parametrize("order", [("pose", "position"), ("position", "pose")])
def test_recordings_of_different_arrays_do_not_mix(tmp_path, order):
    position = dict(zip(("px", "py", "pz"), joint_path(50).T, strict=True))
    turn = {"wx": np.zeros(50), "wy": np.zeros(50), "wz": np.linspace(0, 1, 50)}
    np.savez(tmp_path / "position.npz", t=0.01 * np.arange(50), **position)
    np.savez(tmp_path / "pose.npz", t=0.01 * np.arange(50), **position, **turn)
    first, second = (tmp_path / f"{name}.npz" for name in order)
    status, _, error = hrc("import", first, second, "--out", tmp_path / "set")
    assert status == 2
    assert f"{second} and {first} do not fit into one dataset: arrays" in error
    assert not list(tmp_path.glob("set*"))


def test_check_names_the_place_of_an_error(tmp_path):
    q = joint_path()
    q[7, 1] = np.nan
    root = write_folder(
        tmp_path / "set", [{"observation.state": q}], {"observation.state": ["a", "b", "c"]}
    )
    status, text, _ = hrc("check", root)
    assert status == 1
    place = "data/chunk-000/file-000.parquet, episode 0, frame 7, observation.state: b is nan"
    assert place in text


def test_check_of_nothing(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty"):
        status, _, error = hrc("check", tmp_path / name)
        assert (status, error.count("\n")) == (2, 1)
        assert "there is no dataset" in error


def test_findings_are_written_for_other_programs(recording, tmp_path):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q")
    (tmp_path / "set/meta/stats.json").unlink()
    hrc("check", tmp_path / "set", "--out", tmp_path / "found")
    (finding,) = json.loads((tmp_path / "found" / "findings.json").read_text())
    assert finding["level"] == "warning"
    assert "no statistics" in finding["message"]
    assert finding["file"] == "meta/stats.json"
    assert finding["episode"] is None


def test_findings_are_written_even_if_the_camera_check_fails(tmp_path, monkeypatch):
    def refuse(demos):
        raise ValueError(f"no marker was seen in {len(demos)} episodes")

    monkeypatch.setattr(dataset_commands, "feature_trajectories", refuse)
    # Told by their size, the first is in degrees and the second in radians.
    episodes = [{"observation.state": scale * joint_path(60, 2)} for scale in (60, 1)]
    root = write_folder(tmp_path / "set", episodes, {"observation.state": ["a.pos", "b.pos"]})
    written = {name: tmp_path / name for name in ("json", "out")}
    places = [word for name, path in written.items() for word in (f"--{name}", path)]
    status, _, error = hrc(
        "check", root, "--camera", "--units", "joint_position", "rad", *places
    )
    assert (status, error.count("\n")) == (2, 1)
    assert "no marker was seen in 2 episodes" in error  # so they were read as told
    assert all(path.exists() for path in written.values())


@pytest.mark.parametrize(
    ("places", "said", "moved"),
    [
        ((), "the marker is visible in fewer than two episodes, nothing to compare", 0),
        (((0, 1),), "camera stood still in episodes 0, 1", 0),
        (((0,), (1,)), "moved by 3 px in episodes 1", 1),
    ],
)
def test_a_moved_camera_is_reported_with_its_episodes(
    tmp_path, monkeypatch, places, said, moved
):
    groups = [SimpleNamespace(episodes=one, motion="moved by 3 px") for one in places]
    monkeypatch.setattr(dataset_commands, "feature_trajectories", lambda demos: ())
    monkeypatch.setattr(dataset_commands, "camera_placements", lambda *_: groups)
    episodes = [{"observation.state": joint_path(60, 2, seed=k)} for k in range(2)]
    root = write_folder(tmp_path / "set", episodes, {"observation.state": ["a.pos", "b.pos"]})
    outcome = done("check", root, "--camera", "--json", tmp_path / "n.json")
    assert said in outcome.output
    assert json.loads((tmp_path / "n.json").read_text())["camera_moved"] == moved


def test_a_contract_leaves_a_doubtful_unit_open(tmp_path):
    swing = np.sin(np.linspace(0, 6, 80))[:, None] * [95, 90, 80]
    names = ["shoulder_pan.pos", "elbow_flex.pos", "wrist_roll.pos"]
    episode = {"observation.state": swing}
    root = write_folder(tmp_path / "set", [episode] * 2, {"observation.state": names})
    output = done("check", root, "--keep-contract").output
    assert f"contract stored in {root / 'meta/hrc_learn.json'}: edit it there" in output
    assert (
        "unit left open, as the evidence is weak: observation.state/shoulder_pan.pos, "
        in output
    )


def test_a_broken_dataset_is_repaired_checked_and_read(tmp_path):
    q = joint_path(100)
    stuck = np.concatenate([np.repeat(q[:1], 80, axis=0), q])
    stuck[130, 1] = np.nan
    names = {"observation.state": ["a", "b", "c"]}
    root = write_folder(tmp_path / "old", [{"observation.state": stuck}], names, version="v2.0")
    assert hrc("check", root)[0] == 1
    status, _, error = hrc("repair", root, tmp_path / "new")
    assert (status, error.count("\n")) == (2, 1)
    assert "--drop bad-frames" in error
    status, text, _ = hrc(
        *("repair", root, tmp_path / "new", "--drop", "bad-frames", "--fps", 40),
        *("--units", "joint_position", "rad", "--json", tmp_path / "values.json"),
    )
    assert status == 0
    assert "trimmed" in text
    assert "resampled" in text
    assert hrc("check", tmp_path / "new", "--strict")[0] == 0
    values = json.loads((tmp_path / "values.json").read_text())
    assert values["episodes_changed"] == values["episodes"] == 1
    (demo,) = load_demos(tmp_path / "new")
    assert values["frames"] == len(demo) < values["frames_before"] == 180
    assert demo.fps == 40


def record_marker(root, episodes=2, frames=20):
    """A dataset in whose videos marker 7 is seen by a camera that looks down at the gripper."""
    cv2 = pytest.importorskip("cv2")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 60)
    centres = []
    with DatasetWriter(root, 50, "any", cameras={"front": (480, 640)}) as writer:
        for episode in range(episodes):
            writer.start_episode("look")
            phase = np.linspace(0, 3, frames) + episode
            path = np.stack([np.sin(phase), np.cos(1.7 * phase), np.sin(0.9 * phase)], axis=1)
            for position in path * 0.1 + [0.5, 0.0, 0.3]:
                x, y, z = position - [0.5, 0.0, 1.0]  # from the camera
                u, v = round(320 + 500 * y / z), round(240 + 500 * x / z)
                centres.append([u - 0.5, v - 0.5])  # of pixels u - 30 to u + 29
                image = np.full((480, 640, 3), 255, np.uint8)
                image[v - 30 : v + 30, u - 30 : u + 30] = marker[..., None]
                pose = {"position": position, "orientation": [0.0, 1.0, 0.0, 0.0]}
                writer.add_frame(**pose, images={"front": image})
            writer.save_episode()
    return np.array(centres)


@pytest.mark.long
@pytest.mark.simulation
def test_an_image_jacobian_is_fitted_to_a_marker_found_in_the_videos(tmp_path):
    root, values = tmp_path / "set", tmp_path / "values.json"
    truth = record_marker(root)
    words = ("fit", "image-jacobian", root, "--marker", 7, "--no-learn", "--json", values)
    status, text, error = hrc(*words)
    assert status == 0, error
    assert "front.marker_7: 2 episodes searched" in text
    measured = json.loads(values.read_text())
    assert measured["frames_with_marker"] == measured["frames_searched"] == 40
    assert measured["pairs"] > 20
    found = np.concatenate([demo.feature for demo in load_demos(root)])
    np.testing.assert_allclose(found, truth, atol=0.5)
    assert hrc("fit", "image-jacobian", root, "--marker", 70)[0] == 2
    assert "--marker" in hrc("fit", "image-jacobian", root, "--camera", "front").error


def test_no_package_shadows_hugging_faces_datasets():
    assert not list((ROOT / "datasets").glob("__init__.py"))


def test_findings_and_counts_are_kept_in_a_folder(recording, tmp_path):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q")
    out = tmp_path / "found"
    assert hrc("check", "--dataset", tmp_path / "set", "--out", out).status == 0
    counts = json.loads((out / "metrics.json").read_text())
    findings = json.loads((out / "findings.json").read_text())
    assert len(findings) == counts["errors"] + counts["warnings"]
    assert json.loads((out / "made_by.json").read_text())["dataset"] == str(tmp_path / "set")
    assert hrc("check", "--dataset", tmp_path / "set", "--out", out).status == 2


def test_a_copy_is_repaired_beside_the_dataset_unless_told_where(recording, tmp_path):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q")
    assert hrc("repair", "--dataset", tmp_path / "set").status == 0
    assert len(load_demos(tmp_path / "set_repaired")) == 1


def test_demonstrations_are_shown_in_a_recording(recording, tmp_path):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q", "--time", "t")
    out, figures = tmp_path / "new" / "demos.rrd", tmp_path / "figures.json"
    assert hrc("show", tmp_path / "set", "--out", out, "--json", figures).status == 0
    assert out.stat().st_size > 1000
    assert json.loads(figures.read_text()) == {"episodes": 1, "seconds": pytest.approx(0.597)}


def test_images_are_shown_and_a_bad_video_is_listed(tmp_path):
    root, out = tmp_path / "set", tmp_path / "demos.rrd"
    shades = 20 * np.arange(10) + 30
    with DatasetWriter(root, 10, "any", ["a"], cameras={"front": (480, 640)}) as writer:
        for _ in range(2):
            writer.start_episode("look")
            for k, shade in enumerate(shades):
                image = np.full((480, 640, 3), shade, np.uint8)
                writer.add_frame(joint_position=[0.01 * k], images={"front": image})
            writer.save_episode()
    _, second = sorted((root / "videos").glob("**/*.mp4"))
    second.write_bytes(second.read_bytes()[:200])
    shown = hrc("show", root, "--out", out)
    assert shown.status == 0
    assert "left out: " in shown.output
    assert second.name in shown.output
    assert "no arm is drawn: robot type 'any'" in shown.output
    recording, place = Rrd(out), "cameras/front"
    assert len(recording.column(place, "VideoStream:sample", timeline="episode 1")) == 0
    # Every image, as it is encoded: the viewer decodes.
    np.testing.assert_allclose(recording.time(place), 0.1 * np.arange(10), atol=1e-6)
    samples = recording.column(place, "VideoStream:sample", timeline="episode 0")
    ((codec,),) = recording.column(place, "VideoStream:codec", static=True)[:1]
    decoder = av.CodecContext.create({0x61763031: "libdav1d", 0x61766331: "h264"}[codec], "r")
    packets = [av.Packet(np.asarray(sample[0], np.uint8).tobytes()) for sample in samples]
    images = [image for packet in [*packets, None] for image in decoder.decode(packet)]
    shown_shades = [image.to_ndarray(format="rgb24").mean() for image in images]
    np.testing.assert_allclose(shown_shades, shades, atol=4)


def test_a_sample_of_many_demonstrations_is_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(dashboard_commands, "_SHOWN", 2)
    array = np.linspace(0, 1, 180).reshape(3, 20, 3)
    np.save(tmp_path / "three.npy", array)
    columns = ("--columns", "px,py,pz", "--duration", 2)
    made = hrc("import", tmp_path / "three.npy", "--out", tmp_path / "set", *columns)
    assert made.status == 0
    figures = tmp_path / "figures.json"
    arguments = ("show", tmp_path / "set", "--out", tmp_path / "d.rrd", "--json", figures)
    said = hrc(*arguments)
    assert (said.status, "2 of 3 demonstrations" in said.output) == (0, True)
    assert json.loads(figures.read_text())["episodes"] == 2
    hrc(*arguments, "--episodes", 0, 1, 2)
    assert json.loads(figures.read_text())["episodes"] == 3


@pytest.fixture
def viewer(monkeypatch):
    """Command lines that would open a viewer, instead of doing so."""
    opened = []

    def start(command, check):
        assert all(Path(word).is_file() for word in command if word.endswith(".rrd"))
        opened.append(command)
        return subprocess.CompletedProcess(command, 0)

    @contextlib.contextmanager
    def serve(recordings):
        assert all(recording.is_file() for recording in recordings)
        opened.append(["serve", *map(str, recordings)])
        yield "http://127.0.0.1:8080/#token=secret"
        raise KeyboardInterrupt  # instead of waiting for it

    monkeypatch.setattr(dashboard_commands.subprocess, "run", start)
    waiting = SimpleNamespace(Event=lambda: SimpleNamespace(wait=lambda: None))
    monkeypatch.setattr(dashboard_commands, "threading", waiting)
    monkeypatch.setattr(dashboard_page, "serve_recordings", serve)
    monkeypatch.setattr(dashboard_page, "_viewer_contents", dict)
    return opened


def test_recordings_of_a_folder_are_opened_the_run_first(viewer, tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    for name in ("compared.rrd", "run.rrd", "log.npz"):
        (tmp_path / name).touch()
    assert hrc("show", tmp_path).status == 0
    (command,) = viewer
    assert command[:3] == [sys.executable, "-m", "rerun"]
    assert command[3:] == [str(tmp_path / "run.rrd"), str(tmp_path / "compared.rrd")]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="has a screen")
def test_without_a_screen_a_recording_is_served_through_the_gate(viewer, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "run.rrd").touch()
    shown = hrc("show", tmp_path / "run.rrd")
    assert (shown.status, "no screen" in shown.output) == (0, True)
    assert "#token=" in shown.output
    assert viewer == [["serve", str(tmp_path / "run.rrd")]]


def test_demonstrations_are_opened_from_a_recording_that_does_not_stay(
    viewer, recording, tmp_path, monkeypatch
):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q", "--time", "t")
    monkeypatch.setenv("DISPLAY", ":0")
    assert hrc("show", tmp_path / "set").status == 0
    assert not Path(viewer[0][-1]).exists()


def test_demonstrations_are_streamed_to_the_browser(viewer, recording, tmp_path, monkeypatch):
    pages = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(dashboard_commands.webbrowser, "open", pages.append)
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q", "--time", "t")
    shown = hrc("show", tmp_path / "set", "--web", "--json", tmp_path / "figures.json")
    assert shown.status == 0
    (page,) = pages
    assert "/#token=" in page
    assert page in shown.output
    assert not viewer  # no recording is written first
    assert json.loads((tmp_path / "figures.json").read_text())["episodes"] == 1


@pytest.mark.long
@pytest.mark.simulation
def test_a_dataset_is_shown_with_the_arm_that_is_named(recording, tmp_path):
    hrc("import", recording, "--out", tmp_path / "set", "--joints", "q", "--time", "t")
    out = tmp_path / "demos.rrd"
    refused = hrc("show", tmp_path / "set", "--out", out, "--robot", "so101")
    assert (refused.status, "are not those of so101" in refused.error) == (2, True)
    assert not out.exists()
    assert hrc("show", tmp_path / "set", "--out", out, "--robot", "panda").status == 0
    assert "world/bodies/link7" in Rrd(out).entities


def test_paths_that_cannot_be_shown_are_refused(viewer, tmp_path):
    (tmp_path / "run.rrd").touch()
    refused = hrc("show", tmp_path, "--out", tmp_path / "demos.rrd")
    assert (refused.status, "holds recordings" in refused.error) == (2, True)
    assert "there is nothing at" in hrc("show", tmp_path / "nowhere").error
    assert not viewer


def test_saved_episodes_are_recovered(tmp_path):
    writer = DatasetWriter(tmp_path / "set", 50, "any", ["a"])
    for _ in range(2):
        writer.start_episode("move")
        for k in range(10):
            writer.add_frame(joint_position=[0.01 * k])
        writer.save_episode()
    writer.start_episode("move")
    del writer  # as a kill leaves it
    assert hrc("repair", tmp_path / "set", "--dry-run").status == 2  # nothing is written
    outcome = hrc("repair", tmp_path / "set", "--json", tmp_path / "figures.json")
    assert outcome.status == 0, outcome.error
    assert json.loads((tmp_path / "figures.json").read_text()) == {"mended": 1}
    assert len(load_demos(tmp_path / "set")) == 2
    assert not (tmp_path / "set_repaired").exists()
    assert hrc("repair", tmp_path / "set").status == 0  # nothing is left to finish
    assert len(load_demos(tmp_path / "set_repaired")) == 2
