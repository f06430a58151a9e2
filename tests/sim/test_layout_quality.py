"""The work cell laid out for arms of other shapes than the Panda's."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from bare_arm import bare

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import (
    Arm,
    ArmChoice,
    SerialChain,
    UnreachableError,
    coarse_orientation,
    panda,
)
from hrc_learn.kinematics.inverse import follow_poses
from hrc_learn.kinematics.registry import MissingModelError
from hrc_learn.sim import World
from hrc_learn.sim.layout_quality import (
    clearance_quality,
    marked_turns,
    marker_seen,
    path_quality,
)
from hrc_learn.sim.workplace import CellLayout, Workplace, layout_for

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


@cache
def six_joints():
    return bare().with_hand()


def described(name):
    try:
        return ArmChoice(name).work_arm()
    except MissingModelError as error:
        pytest.skip(str(error))


# The search takes a few seconds of each arm.
@pytest.fixture(
    params=["six", *(pytest.param(name, marks=pytest.mark.slow) for name in ("xarm7", "so101"))]
)
def robot(request):
    return six_joints() if request.param == "six" else described(request.param)


@pytest.mark.long
def test_the_arm_gets_to_all_shelves_and_touches_nothing(robot):
    workplace = Workplace.of(robot)
    world = World(workplace.scene)
    start = workplace.home_joints()
    assert robot.chain.limits.contain(start)
    # The door is for elbows that can move aside while the hand stays.
    assert (workplace.scene.cabinet.door_reach > 0) == (robot.null_space != "none")
    share = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None]
    for name in workplace.shelf_names():
        goal, front = workplace.shelf(name), workplace.path_to_shelf(name, lift=0.0)[1]
        to_front = torch.lerp(workplace.home().position, front, share)
        inside = torch.lerp(front, goal.position, share)
        position = torch.cat([to_front, inside])
        path = Pose(position, coarse_orientation(position, workplace.level_at))
        q, error = follow_poses(robot.chain, path, start)
        assert error.max() < 1e-3
        assert robot.chain.limits.contain(q).all()
        assert world.collisions_along(q.numpy()) == []
        # The rule of the expert ends level, as the place on the shelf has it.
        assert path[-1].twist_to(goal).abs().max() < 1e-9


def test_above_the_table_it_turns_by_half_a_turn_with_its_marker_in_view(robot):
    layout = layout_for(robot)
    workplace = layout.workplace
    least, most = workplace.hover_turns
    assert most - least == pytest.approx(np.pi)
    # The demonstrated orientation is among them, or the hand would begin outside.
    assert least <= 0 <= most
    assert layout.seen > 0.9
    assert 0 < layout.quality <= 1
    plate = workplace.scene.arm.marker
    assert plate is not None
    assert marker_seen(robot, workplace.scene.camera, plate, workplace.hover_joints())


@pytest.mark.simulation
def test_a_layout_is_as_good_as_the_worst_of_its_paths(robot):
    layout = layout_for(robot)
    place, clearances = layout.workplace, layout.workplace.arm_clearances
    home, hover = (torch.tensor(q).double() for q in (place.home_posture, place.hover_posture))
    ways = [
        path_quality(
            robot, clearances, [place.path_to_shelf(name)], place.level_at, home[None]
        ).item()
        for name in place.shelf_names()
    ]
    plate, camera = place.scene.arm.marker, place.scene.camera
    assert plate is not None
    above = marked_turns(
        robot, clearances, camera, plate, place.hover(), place.table_reach, hover
    )
    between = home + torch.linspace(0, 1, 25).double()[:, None] * (hover - home)
    clear = clearance_quality(clearances, between, robot.hand_size).min().item()
    assert layout.quality == pytest.approx(min(*ways, above.quality, clear, 1.0))
    assert layout.seen == above.seen
    assert place.hover_turns == above.turns
    assert place.scene.arm.marker == above.plate


@pytest.mark.parametrize(
    ("quality", "seen", "rank"), [(0.4, 1.0, 0.4), (0.4, 0.97, 0.4), (0.9, 0.95, 0.5)]
)
def test_views_without_the_marker_cost_ten_times_their_fraction(quality, seen, rank):
    layout = CellLayout(workplace=Workplace(), quality=quality, seen=seen)
    assert layout.rank == pytest.approx(rank)


def test_the_usual_hand_may_turn_a_little_further_with_its_marker_in_view():
    """An arm that has yielded, or errs, stands otherwise than one that was led straight."""
    workplace, plate = Workplace(), Workplace().scene.arm.marker
    assert plate is not None
    hover, room = workplace.hover(), np.deg2rad(15.0)
    least, most = workplace.hover_turns
    assert most - least == pytest.approx(np.pi)
    aside = torch.tensor([[a, b, 0.0] for a in (-0.1, 0.1) for b in (-0.1, 0.1)]).double()
    there = Pose(hover.position + aside, hover.orientation.expand(4, 4))
    across = Pose(
        torch.lerp(
            hover.position, there.position, torch.linspace(0, 1, 9)[:, None, None].double()
        ),
        there.orientation.expand(9, 4, 4),
    )
    q, error = follow_poses(panda, across, workplace.hover_joints().expand(4, -1))
    assert error.max() < 1e-3
    for end in (least - room, most + room):
        about = torch.zeros(40, 1, 3, dtype=torch.float64)
        about[..., 2] = torch.linspace(0.0, end, 40, dtype=torch.float64)[:, None]
        turned = quaternion.multiply(quaternion.exp(about), hover.orientation)
        path = Pose(there.position.expand(40, 4, 3), turned.expand(40, 4, 4))
        along, error = follow_poses(panda, path, q[-1])
        assert error.max() < 1e-3
        assert panda.limits.contain(along).all()
        assert marker_seen(workplace.robot, workplace.scene.camera, plate, along).all()


def test_a_marker_is_seen_where_no_ray_to_it_meets_a_link():
    workplace = Workplace()
    plate = workplace.scene.arm.marker
    assert plate is not None
    # On the hand's axis, right above the wrist: links come between more often than not.
    plate = replace(plate, position=(0.0, 0.06, 0.02))
    arm = replace(workplace.scene.arm, marker=plate)
    workplace = replace(workplace, scene=replace(workplace.scene, arm=arm))
    world = World(workplace.scene)
    rng = np.random.default_rng(3)
    eye = workplace.scene.camera.pose[:3, 3]
    hover = workplace.hover_joints()
    said, rays = [], []
    for _ in range(60):
        q = hover + torch.from_numpy(rng.uniform(-0.5, 0.5, 7))
        world.reset(q.numpy())
        site = world.data.site("hand_marker")
        half = plate.marker.plate_size / 2
        corners = site.xpos + np.array(
            [
                site.xmat.reshape(3, 3) @ [a * half, b * half, 0.0]
                for a in (-1, 1)
                for b in (-1, 1)
            ]
        )
        blocked = []
        for corner in corners:
            way = corner - eye
            hit = np.zeros(1, dtype=np.int32)
            distance = mujoco.mj_ray(
                world.model, world.data, eye, way, None, 1, -1, hit, np.zeros(3)
            )
            body = "" if hit[0] < 0 else world.model.body(world.model.geom_bodyid[hit[0]]).name
            blocked.append(body.startswith("link") and 0 <= distance < 1)
        in_view = workplace.scene.camera.in_view(corners).all()
        rays.append(not any(blocked) and bool(in_view))
        said.append(bool(marker_seen(workplace.robot, workplace.scene.camera, plate, q)))
    assert said == rays
    assert 5 < sum(said) < 55


@pytest.mark.long
def test_an_arm_too_small_for_the_cell_is_refused():
    small = bare()
    chain = small.chain
    mounts = chain.mounts.clone()
    mounts[:, :3, 3] *= 0.3
    shrunk = SerialChain(
        joint_names=chain.joint_names,
        mounts=mounts,
        flange=chain.flange,
        tcp=chain.tcp,
        limits=chain.limits,
        ready=chain.ready,
    )
    with pytest.raises(UnreachableError, match=r"cut .* too small"):
        layout_for(Arm(name="cut", chain=shrunk, capsules=small.whole.capsules).with_hand())


def test_the_cell_of_frankas_is_the_usual_one():
    fr3 = Workplace.of(ArmChoice("fr3").work_arm())
    usual = Workplace()
    assert fr3.home_position == usual.home_position
    assert fr3.hover_turns == usual.hover_turns
    assert fr3.scene.boxes() == usual.scene.boxes()
    assert fr3.scene.arm.marker == usual.scene.arm.marker
    q = fr3.home_joints()
    assert float((q - Workplace().home_joints()).abs().max()) < 1e-6
    assert fr3.robot.chain is not panda
