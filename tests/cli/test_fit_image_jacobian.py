"""`hrc fit image-jacobian`: files and figures of the fit."""

import json

from commands import done
from pinhole import Pinhole, wander
from sampling import generator

from hrc_learn.demos import DatasetWriter
from hrc_learn.jacobian import RBFImageJacobian

FRAMES = 60


def test_it_writes_a_model_and_a_dashboard(tmp_path):
    poses = wander(FRAMES, 4, rng=generator(0))
    features = Pinhole.overhead(roll=0.7).project(poses)
    with DatasetWriter(tmp_path / "set", 20, "any") as writer:
        for episode in range(4):
            writer.start_episode("look")
            for k in range(FRAMES):
                writer.add_frame(
                    position=poses.position[episode, k].numpy(),
                    orientation=poses.orientation[episode, k].numpy(),
                    feature=features[episode, k].numpy(),
                    feature_visible=True,
                )
            writer.save_episode()
    model = tmp_path / "model"
    options = ("--no-learn", "--json", tmp_path / "values.json")
    output = done("fit", "image-jacobian", tmp_path / "set", "--out", model, *options).output
    assert "held-out error, relative to that motion" in output
    assert "focal length 14" in output
    metrics = json.loads((model / "metrics.json").read_text())
    assert json.loads((tmp_path / "values.json").read_text()) == metrics
    assert 0 < metrics["held_out_relative"] < 0.02
    assert (model / "fit.rrd").is_file()
    RBFImageJacobian.load(model / "jacobian")
