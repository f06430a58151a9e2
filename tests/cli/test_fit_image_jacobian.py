"""`hrc fit image-jacobian`: files and figures of the fit, and `hrc evaluate` of its model."""

import json
import re

import pytest
import torch
from commands import done
from pinhole import wander
from sampling import generator

from hrc_learn.demos import DatasetWriter
from hrc_learn.jacobian import RBFImageJacobian
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace

FRAMES = 60


@pytest.mark.long
def test_it_writes_a_model_like_the_camera_of_the_work_cell(tmp_path):
    poses = wander(FRAMES, 4, rng=generator(0))
    workplace = Workplace()
    camera, world = workplace.scene.camera, World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    marker = poses.apply(torch.from_numpy(world.hand_marker_offset()))
    features = torch.from_numpy(camera.project(marker.numpy()))
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
    assert "held-out error, relative to image motion" in output
    assert "too few to learn" not in output
    (focal,) = re.findall(r"focal length (\d+) px", output)
    assert int(focal) == pytest.approx(camera.focal[0], rel=0.02)
    metrics = json.loads((model / "metrics.json").read_text())
    assert json.loads((tmp_path / "values.json").read_text()) == metrics
    assert 0 < metrics["held_out_relative"] < 0.02
    assert (model / "fit.rrd").is_file()
    RBFImageJacobian.load(model / "jacobian")

    # Compared with the simulator's camera, the pixels were its own.
    evaluate = ("evaluate", "--model", model, "--dataset", tmp_path / "set")
    asked = done(*evaluate, "--out", tmp_path / "figures", status=2)
    assert "--out is for primitives" in asked.error
    outcome = done(*evaluate, "--json", tmp_path / "errors.json")
    errors = json.loads((tmp_path / "errors.json").read_text())
    kinds = ("relative_error_median", "relative_error_p95", "within_1_sigma", "within_2_sigma")
    assert [*errors] == [f"{grid}_{kind}" for grid in ("upright", "tilted") for kind in kinds]
    for grid in ("upright", "tilted"):
        median, most, *within = (errors[f"{grid}_{kind}"] for kind in kinds)
        assert 0 < median < most < 0.05
        assert 0 < within[0] <= within[1] <= 1
    assert errors["tilted_relative_error_median"] != errors["upright_relative_error_median"]
    done(*evaluate, "--episodes", "2", "--json", tmp_path / "one.json")
    assert errors != json.loads((tmp_path / "one.json").read_text())  # another place of poses
    (limited,) = [row for row in outcome.output.splitlines() if " ok " in row]
    assert "upright relative error median" in limited
    assert "0.05" in limited
