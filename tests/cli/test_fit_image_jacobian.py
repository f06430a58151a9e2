"""`hrc fit image-jacobian`: what its dashboard shows beside the fit."""

import shutil

import cv2
import numpy as np
import pytest
from commands import done
from pinhole import Pinhole, wander
from rrd_reading import Rrd
from sampling import generator

from hrc_learn.demos import DatasetWriter

FRAMES = 60


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A wandering tool, seen by two cameras whose images grow brighter frame by frame."""
    root = tmp_path_factory.mktemp("seen") / "set"
    poses = wander(FRAMES, 2, rng=generator(0))
    features = Pinhole.overhead(roll=0.7).project(poses)
    cameras = {"left.rgb": (48, 64), "right.rgb": (48, 64)}
    with DatasetWriter(root, 20, "any", cameras=cameras) as writer:
        for episode in range(2):
            writer.start_episode("look")
            for k in range(FRAMES):
                image = np.full((48, 64, 3), 4 * k, dtype=np.uint8)
                writer.add_frame(
                    position=poses.position[episode, k].numpy(),
                    orientation=poses.orientation[episode, k].numpy(),
                    feature=features[episode, k].numpy(),
                    feature_visible=True,
                    images={"left.rgb": image, "right.rgb": image},
                )
            writer.save_episode()
    return root


def fitted(dataset, out):
    options = ("--no-learn", "--json", out.with_suffix(".json"))
    return done("fit", "image-jacobian", "--dataset", dataset, "--out", out, *options)


def test_the_dashboard_shows_what_cameras_saw_at_the_end(dataset, tmp_path):
    fitted(dataset, tmp_path / "model")
    rrd = Rrd(tmp_path / "model" / "fit.rrd")
    names = {e.removeprefix("images/") for e in rrd.entities if e.startswith("images/")}
    assert names == {
        f"End_of_episode_{episode}_{side}_rgb"
        for episode in (0, 1)
        for side in ("left", "right")
    }
    ((blob,),) = rrd.column(
        "images/End_of_episode_1_left_rgb", "EncodedImage:blob", static=True
    )
    image = cv2.imdecode(np.array(blob, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image.mean() == pytest.approx(4 * (FRAMES - 1), abs=6)


def test_a_broken_video_is_said_and_the_rest_is_fitted(dataset, tmp_path):
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    video = min((root / "videos").rglob("*left*/**/*.mp4"))
    video.write_bytes(video.read_bytes()[:100])
    outcome = fitted(root, tmp_path / "model")
    assert "note: " in outcome.output
    assert "left" in outcome.output.split("note: ", 1)[1]
    names = {e for e in Rrd(tmp_path / "model" / "fit.rrd").entities if e.startswith("images/")}
    assert names == {
        f"images/End_of_episode_{seen}_rgb" for seen in ("0_right", "1_left", "1_right")
    }
