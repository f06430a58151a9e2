"""A step of any policy's preprocessor that notices a camera that was moved."""

import json
import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import ProcessorStepRegistry

from hrc_learn.demos import DatasetWriter
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.perspective import from_base, marker_pixels, moved, pixels_and_depth
from hrc_learn.lerobot import camera_watch
from hrc_learn.lerobot.arm_values import HAND, MARKER, PIXELS
from hrc_learn.lerobot.camera_watch import CAMERA_WATCH, CameraWatchStep, add_camera_watch
from hrc_learn.lerobot.smoothing import PREPROCESSOR
from hrc_learn.vision.camera_model import IMAGE_SIZE

FPS = 25
CAMERA = torch.tensor(
    [
        *(np.log(1500.0), 720.0, 540.0, 0.0),  # log of the focal length, centre, lens
        *(np.pi - 0.2, 0.1, 0.05),  # rotation
        *(-0.4, 0.05, 1.1),  # shift
        *(0.0, 0.06, 0.03),  # marker
    ],
    dtype=torch.float64,
)


def episode(rng, camera=CAMERA, frames=60):
    """Poses of a tool as vectors, and the pixels of its marker."""
    time = np.linspace(0, 1, frames)[:, None]
    wave = sum(rng.normal(0, 0.05, 3) * np.sin(2 * np.pi * k * time) for k in (0.5, 1.0, 1.5))
    turn = np.sin(2 * np.pi * time) * rng.normal(0, 0.2, 3)
    pose = Pose(
        torch.from_numpy(np.array([0.45, 0.0, 0.2]) + wave),
        quaternion.exp(torch.from_numpy(turn)),
    )
    pixels = marker_pixels(camera, pose)[0].numpy() + rng.normal(0, 0.1, (frames, 2))
    return pose, pixels


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root, rng = tmp_path_factory.mktemp("sets") / "set", np.random.default_rng(0)
    names = [name.removesuffix(".pos") for name in ("a.pos", *HAND, *MARKER)]
    with DatasetWriter(root, FPS, "any", names) as writer:
        for _ in range(4):
            writer.start_episode("look")
            pose, pixels = episode(rng)
            for k, pixel in enumerate(pixels):
                state = [0.01 * k, *pose[k].vector().tolist(), *pixel, 1.0]
                writer.add_frame(joint_position=state)
            writer.save_episode()
    return root


@pytest.fixture(scope="module")
def config(dataset, tmp_path_factory):
    """As the checkpoint's file has it."""
    folder = tmp_path_factory.mktemp("checkpoint")
    watch = {"registry_name": CAMERA_WATCH, "config": {}}  # of an earlier call, to be replaced
    steps = [watch, {"registry_name": "to_batch_processor", "config": {}}]
    (folder / PREPROCESSOR).write_text(json.dumps({"name": "policy", "steps": steps}))
    add_camera_watch(folder, dataset)
    first, *others = json.loads((folder / PREPROCESSOR).read_text())["steps"]
    assert [other["registry_name"] for other in others] == ["to_batch_processor"]
    assert first["registry_name"] == CAMERA_WATCH
    return first["config"]


@pytest.fixture
def step(config):
    """As LeRobot makes it of the checkpoint's file."""
    return ProcessorStepRegistry.get(CAMERA_WATCH)(**config)


def rollout(step, pose, pixels):
    """Show the step an episode as a robot would."""
    for k, pixel in enumerate(pixels):
        state = torch.tensor([[0.0, *pose[k].vector(), *pixel, 1.0]], dtype=torch.float32)
        transition = {TransitionKey.OBSERVATION: {"observation.state": state}}
        assert step(transition) is transition


@pytest.mark.long
def test_a_camera_that_stands_still_is_left_in_peace(step, caplog):
    rng = np.random.default_rng(1)
    for _ in range(2):
        rollout(step, *episode(rng))
        step.reset()
    assert not caplog.records


@pytest.mark.long
def test_a_moved_camera_is_warned_about_once_an_episode(step, caplog):
    caplog.set_level(logging.WARNING)
    rng = np.random.default_rng(2)
    twist = torch.tensor([0.0, np.deg2rad(0.5), 0.0, 0.004, 0.0, 0.0]).double()
    there = moved(CAMERA, twist)
    pose, pixels = episode(rng, there)
    rollout(step, pose, pixels)
    (record,) = caplog.records
    assert "camera moved by" in record.getMessage()
    assert step.motion.displacement > 5
    step.reset()
    assert step.motion is None
    rollout(step, pose[:40], pixels[:40])
    assert len(caplog.records) == 2


OBJECT = np.array([0.5, 0.03, 0.02])


def object_pixel(camera):
    return pixels_and_depth(camera, from_base(camera, torch.from_numpy(OBJECT)[None]))[0][0]


def looking(step, pose, pixels, camera, visible=1.0):
    """What a policy sees of the marker and of an object, both in its state, at the end."""
    seen = object_pixel(camera)
    for k, pixel in enumerate(pixels):
        state = torch.tensor([*pose[k].vector(), *pixel, visible, *seen]).float()[None]
        before = state.clone()
        transition = step({TransitionKey.OBSERVATION: {"observation.state": state}})
        assert torch.equal(state, before)
    return transition[TransitionKey.OBSERVATION]["observation.state"][0].numpy()


@pytest.fixture
def correcting(step):
    columns = {"pose_columns": [*range(6)], "marker_columns": [6, 7, 8]}
    more = {"correct": True, "object_columns": [9, 10], "object_height": OBJECT[2]}
    return CameraWatchStep(**step.get_config() | columns | more)


@pytest.mark.long
def test_a_policy_sees_what_it_would_if_the_camera_had_not_been_moved(correcting, caplog):
    rng = np.random.default_rng(4)
    knocked = moved(CAMERA, torch.tensor([0.1, 0.02, 0.05, 0.05, -0.03, 0.02]).double())
    unmoved = object_pixel(CAMERA)
    for _ in range(2):
        pose, pixels = episode(rng, knocked)
        state = looking(correcting, pose, pixels, knocked)
        np.testing.assert_allclose(state[9:], unmoved, atol=4.0)
        there = marker_pixels(CAMERA, pose[-1:])[0][0].numpy()
        np.testing.assert_allclose(state[6:8], there, atol=2.0)
        assert np.abs(pixels[-1] - there).max() > 50.0
        correcting.reset()
        # Known from the first frame on, before the arm has moved.
        state = looking(correcting, pose[:1], pixels[:1], knocked)
        np.testing.assert_allclose(state[9:], unmoved, atol=4.0)
    assert len([r for r in caplog.records if "corrected" in r.getMessage()]) == 1
    again = CameraWatchStep(**correcting.get_config())
    assert again.get_config() == correcting.get_config()


def test_a_policy_sees_what_there_is_while_the_camera_stands_still(correcting):
    pose, pixels = episode(np.random.default_rng(5))
    state = looking(correcting, pose, pixels, CAMERA)
    np.testing.assert_allclose(state[6:8], pixels[-1], rtol=1e-6)
    np.testing.assert_allclose(state[9:], object_pixel(CAMERA), rtol=1e-6)


def test_a_hidden_marker_stays_where_it_was_corrected_to(correcting):
    knocked = moved(CAMERA, torch.tensor([0.1, 0.02, 0.05, 0.05, -0.03, 0.02]).double())
    pose, pixels = episode(np.random.default_rng(7), knocked, frames=3)
    shown = looking(correcting, pose[:2], pixels[:2], knocked)[6:8]
    assert np.abs(shown - pixels[1]).max() > 50.0
    # A robot repeats the last pixel, or says that there is none.
    for pixel, expected in ((pixels[1], shown), (np.zeros(2), np.zeros(2))):
        hidden = looking(correcting, pose[2:], pixel[None], knocked, visible=0.0)
        np.testing.assert_array_equal(hidden[6:8], expected)


def test_a_false_alarm_is_taken_back(correcting):
    pose, pixels = episode(np.random.default_rng(8))
    looking(correcting, pose[:1], pixels[:1] + np.array([150.0, -80.0]), CAMERA)
    assert correcting.motion is not None
    looking(correcting, pose[1:], pixels[1:], CAMERA)
    assert correcting.motion is None


def test_an_unseen_marker_and_missing_observations_are_passed_over(step):
    pose, pixels = episode(np.random.default_rng(3))
    rollout(step, pose, np.full_like(pixels, np.nan))
    assert step.motion is None
    step({TransitionKey.OBSERVATION: None})
    step({TransitionKey.OBSERVATION: {"observation.environment_state": torch.zeros(1, 3)}})


def test_several_environments_at_once_are_refused(step):
    observation = {"observation.state": torch.zeros(2, 10)}
    with pytest.raises(ValueError, match="batch_size"):
        step({TransitionKey.OBSERVATION: observation})


def test_settings_that_make_no_sense_are_refused(step):
    for fps in (0.0, float("inf")):
        with pytest.raises(ValueError, match="fps must be positive"):
            CameraWatchStep(**step.get_config() | {"fps": fps})


def test_what_is_missing_is_named(dataset, tmp_path):
    with pytest.raises(FileNotFoundError, match=PREPROCESSOR):
        add_camera_watch(tmp_path, dataset)
    (tmp_path / PREPROCESSOR).write_text(json.dumps({"steps": []}))
    with DatasetWriter(tmp_path / "bare", FPS, "any", ["a"]) as writer:
        writer.start_episode("look")
        for k in range(5):
            writer.add_frame(joint_position=[0.01 * k])
        writer.save_episode()
    info = tmp_path / "bare" / "meta" / "info.json"
    state = json.loads(info.read_text())["features"]["observation.state"]
    # Names by group, as some converters write them, and no names.
    for names in (state["names"], {"motors": state["names"]}, None):
        content = json.loads(info.read_text())
        content["features"]["observation.state"]["names"] = names
        info.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"ee\.x"):
            add_camera_watch(tmp_path, tmp_path / "bare")


@pytest.mark.parametrize("correct", [False, True])
def test_objects_are_corrected_from_a_dataset_in_which_they_were_taken(
    tmp_path, correct, step, monkeypatch
):
    """Each lies where the tool was lowest, and was seen from the first frame on."""
    fitted = []

    def fit(watched, fps, size):  # the same camera again
        fitted.append((watched, fps, size))
        return step._watch.reference

    monkeypatch.setattr(camera_watch.CameraReference, "fit", fit)
    rng, root = np.random.default_rng(6), tmp_path / "set"
    names = [name.removesuffix(".pos") for name in (*PIXELS, *HAND, *MARKER)]
    with DatasetWriter(root, FPS, "any", names) as writer:
        for _ in range(5):
            writer.start_episode("take")
            pose, pixels = episode(rng)
            taken = pose.position[pose.position[:, 2].argmin()]
            seen = pixels_and_depth(CAMERA, from_base(CAMERA, taken[None]))[0][0]
            for k, pixel in enumerate(pixels):
                there = seen if k == 0 else 0 * seen  # hidden by the tool later
                visible = float(k != 3)
                state = [*there.tolist(), *pose[k].vector().tolist(), *pixel, visible]
                writer.add_frame(joint_position=state)
            writer.save_episode()
    (tmp_path / PREPROCESSOR).write_text(json.dumps({"steps": []}))
    add_camera_watch(tmp_path, root, correct=correct)
    ((watched, fps, size),) = fitted
    assert (len(watched), fps, size) == (5, FPS, IMAGE_SIZE)
    last = watched[-1]
    np.testing.assert_allclose(last.feature, pixels, rtol=1e-6)
    np.testing.assert_allclose(last.pose.vector(), pose.vector(), atol=1e-6)
    assert last.visible.tolist() == [k != 3 for k in range(len(pixels))]
    (entry,) = json.loads((tmp_path / PREPROCESSOR).read_text())["steps"]
    config = entry["config"]
    assert config["correct"] == correct
    assert config["pose_columns"] == [*range(2, 8)]
    assert config["marker_columns"] == [8, 9, 10]
    assert config["object_columns"] == ([0, 1] if correct else None)
    if not correct:
        assert config["object_height"] == 0.0
        return
    columns = {"pose_columns": [*range(6)], "marker_columns": [6, 7, 8]}
    corrected = CameraWatchStep(**config | columns | {"object_columns": [9, 10]})
    knocked = moved(CAMERA, torch.tensor([0.03, 0.02, 0.02, 0.02, -0.01, 0.02]).double())
    pose, pixels = episode(rng, knocked)
    lowest = pose.position[:, 2].min()  # nearly the plane of the objects
    there = torch.tensor([0.5, 0.03, float(lowest)]).double()[None]
    before, now = (pixels_and_depth(c, from_base(c, there))[0][0] for c in (CAMERA, knocked))
    for k, pixel in enumerate(pixels):
        state = torch.tensor([*pose[k].vector(), *pixel, 1.0, *now]).float()[None]
        made = corrected({TransitionKey.OBSERVATION: {"observation.state": state}})
    found = made[TransitionKey.OBSERVATION]["observation.state"][0, 9:]
    assert (found - before).norm() < 0.2 * (now - before).norm()


@pytest.mark.parametrize(("visible", "seen"), [(0.5, True), (0.49, False)])
def test_a_marker_counts_from_a_visibility_of_a_half(step, visible, seen):
    pose, pixels = episode(np.random.default_rng(7))
    looks = []
    step._watch.update = lambda time, pose, pixel: looks.append(time)
    for k in range(3):
        state = torch.tensor([[0.0, *pose[k].vector(), *pixels[k], visible]])
        step({TransitionKey.OBSERVATION: {"observation.state": state}})
    assert looks == ([1 / FPS, 2 / FPS, 3 / FPS] if seen else [])
    assert step.transform_features({"a": {}}) == {"a": {}}


@pytest.mark.parametrize("corrects", [False, True])
def test_a_motion_is_warned_about_at_first_and_a_correction_each_time(step, caplog, corrects):
    """A watch finds it at the second and third call; `reset` begins the next episode."""
    caplog.set_level(logging.WARNING)
    found = iter([None, "camera moved by 1", "camera moved by 2", None])
    step.correct = corrects
    step._watch = SimpleNamespace(update=lambda *given: next(found), clear=lambda: None)
    pose, pixels = episode(np.random.default_rng(1), frames=4)
    rollout(step, pose, pixels)
    said = [record.getMessage() for record in caplog.records]
    if corrects:
        assert [text.split(" since ")[0][-1] for text in said] == ["1", "2"]
        assert all("its pixels are corrected" in text for text in said)
    else:
        (text,) = said
        assert text.startswith("camera moved by 1 since the demonstrations: move it back")
    assert step.motion == "camera moved by 2"
    step.reset()
    assert (step.motion is None) == (not corrects)
