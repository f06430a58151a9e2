"""Measures of experiments by themselves, on made-up runs whose answer is known."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.experiments import surroundings
from hrc_learn.experiments.collaboration_metrics import collaboration_metrics
from hrc_learn.experiments.grasping_experiment import (
    ROTATION_SCALE,
    compare_with_truth,
    held_out_grid,
)
from hrc_learn.experiments.surroundings import points_to_see, unmarked_for, workplace_for
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.perspective import MARKER
from hrc_learn.kinematics import gripper_down, panda
from hrc_learn.sim import World
from hrc_learn.sim.hand_over import Reach
from hrc_learn.sim.scene import UnmarkedLook, overhead_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.receiving import Receipt

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

METRICS = {metric.name: metric for metric in collaboration_metrics(1, 0.0)}
CAMERA, OFFSET = overhead_camera(), np.array([0.01, -0.02, 0.09])


def value(name, **run):
    return METRICS[name].of(SimpleNamespace(**run))


def handed(receipt):
    reaches = (Reach("other", 1.0, 2.0), Reach("hand over", 10.0, 12.0))
    plan = SimpleNamespace(reaches=reaches, place=np.array([0.5, 0.0, 0.4]))
    picks = [SimpleNamespace(receipt=None), SimpleNamespace(receipt=receipt)]
    return {"picks": picks, "hand_over": plan}


def test_the_worst_placed_object_counts_and_what_was_not_released_does_not():
    """Boxes 3 mm and 5 mm off on the table, turned by 2 and 1 degrees about the vertical."""
    poses, picks = {}, []
    goal = Pose(torch.tensor([0.4, 0.1, 0.3]).double(), gripper_down())
    placed = (("a", [3e-3, 0], 2.0), ("b", [3e-3, 4e-3], 1.0), ("c", [0.5, 0.5], 40.0))
    for name, shift, angle in placed:
        turn = quaternion.exp(torch.tensor([0, 0, math.radians(angle)], dtype=torch.float64))
        poses[name] = np.eye(4)
        poses[name][:3, :3] = quaternion.to_matrix(turn).numpy()
        poses[name][:3, 3] = goal.position.numpy() + np.array([*shift, 0.2])
        release = None if name == "c" else 1.0
        item = SimpleNamespace(name=name)
        picks.append(SimpleNamespace(release=release, item=item, goal=goal))
    world = SimpleNamespace(object_pose=poses.__getitem__)
    assert value("place error", picks=picks, world=world) == pytest.approx(5.0)
    assert value("place tilt", picks=picks, world=world) == pytest.approx(2.0)
    assert value("place error", picks=picks[2:], world=world) is None
    assert value("place tilt", picks=picks[2:], world=world) is None


def test_a_hand_over_is_measured_from_its_reach_and_left_out_without_one():
    receipt = Receipt(
        recognised=10.5,
        seen=10.2,
        predicted=np.array([0.53, 0.04, 0.4]),
        taken=13.5,
        passed_over=2,
    )
    expected = {
        "hand-over recognised before it began": 0.0,
        "other movements passed over": 2.0,
        "hand-over recognised at this fraction of the movement": 25.0,
        "hand-over place, error when recognised": 50.0,
        "time until the object was held": 3.5,
    }
    for name, number in expected.items():
        assert value(name, **handed(receipt)) == pytest.approx(number)
        assert value(name, picks=[SimpleNamespace(receipt=receipt)], hand_over=None) is None
        assert value(name, **handed(Receipt())) is None  # it was not recognised
    early = Receipt(seen=9.9, predicted=np.zeros(3))
    assert value("hand-over recognised before it began", **handed(early)) == 1.0
    assert value("time until the object was held", **handed(early)) is None


def test_pulls_are_measured_over_all_of_them():
    effects = [
        SimpleNamespace(tool=tool, elbow=elbow)
        for tool, elbow in ((1e-3, 0.1), (math.nan, 0.3), (3e-3, 0.2))
    ]
    run = {"pulls": True, "pull_effects": effects}
    assert value("end effector deviation", **run) == pytest.approx(3.0)
    assert value("elbow moved", **run) == pytest.approx(200.0)
    assert value("pulls", **run) == 3
    for name in ("end effector deviation", "elbow moved", "pulls"):
        assert value(name, pulls=True, pull_effects=[]) is None
    assert value("end effector rotation", **run) is None


@pytest.mark.parametrize("mode", ["ssm", "pfl"])
def test_contacts_over_the_limit_count_only_where_contacts_are_allowed(mode):
    separation = SimpleNamespace(separation=SimpleNamespace(mode=mode))
    run = {
        "near_worker": SimpleNamespace(force=np.array([0.5, 1.0, 1.1, 2.0])),
        "cell": SimpleNamespace(config=SimpleNamespace(safety=separation)),
    }
    assert value("contacts over the limit", **run) == (None if mode == "ssm" else 2)
    assert value("contact force relative to its limit", **run) == 2.0
    assert value("contacts over the limit", **run | {"near_worker": None}) is None


def test_a_held_out_grid_lies_near_the_demonstrations_and_is_tilted_as_asked():
    way = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    demonstrated = torch.cat([0.3 + 0.2 * way, 0.4 - 0.1 * way, 0.2 + 0 * way], dim=-1)
    grid = held_out_grid(demonstrated, points=21)
    distance = torch.cdist(grid.position, demonstrated).amin(dim=1)
    assert 21 < len(distance) < 21**3
    assert distance.max() < 0.02
    assert (grid.position.amin(0) >= demonstrated.amin(0)).all()
    assert (grid.position.amax(0) <= demonstrated.amax(0)).all()
    np.testing.assert_allclose(grid.orientation, gripper_down().expand(len(distance), 4))
    tilted = held_out_grid(demonstrated, points=21, tilt=0.1, seed=1)
    assert torch.equal(tilted.position, grid.position)
    back = quaternion.multiply(tilted.orientation, quaternion.conjugate(grid.orientation))
    turn = quaternion.log(back)
    assert 0.09 < turn.abs().max() <= 0.1 + 1e-9
    assert turn.amin() < -0.05
    again = held_out_grid(demonstrated, points=21, tilt=0.1, seed=2)
    assert not torch.equal(again.orientation, tilted.orientation)


class Network:
    """An estimate that is wrong by known factors, with known uncertainties."""

    def __init__(self, poses, linear, angular, sigma):
        truth = true_jacobian(poses)
        factor = torch.tensor([linear] * 3 + [angular] * 3, dtype=torch.float64)
        self.estimate, self.sigma = truth * (1 + factor), sigma

    def __call__(self, poses):
        return self.estimate

    def uncertainty(self, poses):
        return self.sigma


def true_jacobian(poses):
    """Pixels for twists of the tool, by finite differences of what the camera projects."""
    step, columns = 1e-6, []
    for k in range(6):
        sides = []
        for sign in (1.0, -1.0):
            twist = torch.zeros(6, dtype=torch.float64)
            twist[k] = sign * step
            turned = quaternion.multiply(quaternion.exp(twist[3:]), poses.orientation)
            moved = Pose(poses.position + twist[:3], turned)
            sides.append(CAMERA.project(moved.apply(torch.from_numpy(OFFSET)).numpy()))
        columns.append((sides[0] - sides[1]) / (2 * step))
    return torch.from_numpy(np.stack(columns, axis=-1))


def test_errors_of_an_image_jacobian_are_relative_and_uncertainties_shares_of_entries():
    place = torch.tensor([0.3, 0.5, 0.15], dtype=torch.float64)
    shift = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [0, -0.06, 0.02]], dtype=torch.float64)
    poses = Pose(place + shift, gripper_down().expand(3, 4))
    # The same factor in each entry is the relative error, whatever the scale of rotations.
    uniform = Network(poses, 0.1, 0.1, torch.full((3, 6), 1e9, dtype=torch.float64))
    found = compare_with_truth(uniform, poses, CAMERA, OFFSET)
    assert found["relative_error_median"] == pytest.approx(0.1, rel=1e-3)
    assert found["relative_error_p95"] == pytest.approx(0.1, rel=1e-3)
    assert (found["within_1_sigma"], found["within_2_sigma"]) == (1.0, 1.0)
    # Rotations alone are wrong: they count in metres.
    turned = Network(poses, 0.0, 0.5, torch.full((3, 6), 1e9, dtype=torch.float64))
    found = compare_with_truth(turned, poses, CAMERA, OFFSET)
    truth = true_jacobian(poses)
    linear, angular = truth[..., :3], truth[..., 3:] / ROTATION_SCALE
    whole = (linear.square().sum((1, 2)) + angular.square().sum((1, 2))).sqrt()
    share = 0.5 * angular.square().sum((1, 2)).sqrt() / whole
    assert found["relative_error_median"] == pytest.approx(float(share.median()), rel=1e-3)
    assert found["relative_error_p95"] == pytest.approx(float(share.quantile(0.95)), rel=1e-3)
    # One of three: below 1 sigma; between 1 and 2; beyond both.
    sigma = (0.1 * truth.abs()).amin(dim=1) + 1e-12
    sigma = sigma.expand(3, 6) * torch.tensor([[1e6], [0.6], [1e-3]], dtype=torch.float64)
    same = true_jacobian(poses).abs()
    error = 0.1 * same / sigma[:, None, :]
    found = compare_with_truth(Network(poses, 0.1, 0.1, sigma), poses, CAMERA, OFFSET)
    for number in (1, 2):
        expected = float((error < number).double().mean())
        assert found[f"within_{number}_sigma"] == pytest.approx(expected, abs=0.03)
    assert found["within_1_sigma"] < found["within_2_sigma"] < 1


def test_a_camera_must_see_the_objects_and_the_gripper_wherever_it_turns():
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    points = points_to_see(workplace, world)
    low, high = points.min(axis=0), points.max(axis=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = workplace.random_object_pose((0.1, 0.08, 0.0), rng, math.pi)
        assert (low[:2] < pose[:2, 3]).all()
        assert (high[:2] > pose[:2, 3]).all()
    world.reset(workplace.hover_joints().numpy())
    marker = world.arm.tcp_pose() @ np.append(world.hand_marker_offset(), 1.0)
    assert low[2] < marker[2] <= high[2] + 1e-3
    assert np.abs(points - marker[:3]).max(axis=-1).min() < 0.25


def test_what_a_scene_cannot_be_is_said():
    for shelves in ((), ("lower", "middle", "upper", "lower")):
        with pytest.raises(
            ValueError, match=f"{len(shelves)} shelves are named, but there are"
        ):
            workplace_for(shelves, panda)
    skill = SimpleNamespace(jacobian=SimpleNamespace(camera=None), landmarks=None)
    with pytest.raises(ValueError, match="--markerless needs a model that was learned without"):
        unmarked_for(Workplace(), skill, None, 0)


def test_a_run_without_markers_has_another_look_than_the_demonstrations(monkeypatch):
    """Demonstrations use the seeds from 0 on; a run uses none of these."""
    seen = []
    monkeypatch.setattr(
        surroundings,
        "unmarked",
        lambda scene, look, point: seen.append((scene, look.seed, point)) or scene,
    )
    camera = torch.arange(13.0).double()
    skill: Any = SimpleNamespace(jacobian=SimpleNamespace(camera=camera), landmarks="seen")
    workplace = Workplace()
    with shapes_unchecked():
        for seed in (0, 7):
            assert unmarked_for(workplace, skill, UnmarkedLook(), seed) == workplace
    (scene, first, point), (_, second, _) = seen
    assert scene is workplace.scene
    assert second - first == 7
    assert first >= 10_000
    # The point of the tool that the camera model sees, at the end of its parameters.
    np.testing.assert_array_equal(point, camera[MARKER].numpy())
