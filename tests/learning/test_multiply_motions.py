"""New motions: their segments, their ends in new scenes, continuity and limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from multiply_samples import BLOCKS, END, FPS, GRASP, block, demonstrations

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import ArmChoice, arm, panda
from hrc_learn.learning.multiply_motions import (
    Draws,
    MotionSource,
    Segmentation,
    _stopped,
    find_segments,
)

N = len(BLOCKS)


@pytest.fixture(scope="module")
def demos():
    return demonstrations()


@pytest.fixture(scope="module")
def tool(demos):
    return [panda.forward(torch.from_numpy(demo.joint_position)) for demo in demos]


@pytest.fixture(scope="module")
def objects():
    far = [Pose(torch.tensor([0.3, 0.5, 0.2]).double(), BLOCKS[0].orientation)] * N
    return {"block": Pose.stack(BLOCKS), "shelf": Pose.stack(far)}


@pytest.fixture(scope="module")
def segments(demos, tool, objects):
    return find_segments(demos, objects, tool)


@pytest.fixture(scope="module")
def source(demos, tool, objects, segments):
    joints = [torch.from_numpy(demo.joint_position) for demo in demos]
    return MotionSource.fit(demos, tool, objects, segments, panda, joints)


def draws(blocks, weights=None, speed=1.0, start=(0.0, 0.0, 0.0)):
    """Choices of one motion for each pose of the block, the weights in turn one and zero."""
    B = len(blocks)
    weights = torch.eye(N).double()[torch.arange(B) % N] if weights is None else weights
    shelf = Pose(torch.tensor([[0.3, 0.5, 0.2]]).double(), BLOCKS[0].orientation[None])
    return Draws(
        scene={"block": Pose.stack(blocks), "shelf": shelf[[0] * B]},
        weights=weights,
        speed=torch.full((B,), float(speed)).double(),
        start=torch.tensor(start).double().expand(B, 3),
    )


def test_segments_begin_where_the_gripper_moves_and_follow_the_block(segments):
    assert segments.frames == ("block", "block")
    for cuts in segments.cuts.values():
        assert cuts[0] == 0
        assert cuts[-1] == END - 1
        assert abs(cuts[1] - GRASP) <= 2


def test_a_motion_that_does_not_turn_with_its_object_follows_its_position(demos, tool):
    """The demonstrations agree where the block is, not in how it is turned."""
    turned = [
        block(*at.position[:2].tolist(), yaw) for at, yaw in zip(BLOCKS, (2, 0, 1), strict=True)
    ]
    own = [at.inverse() @ pose for at, pose in zip(BLOCKS, tool, strict=True)]
    upright = [
        Pose(at.position, torch.tensor([1.0, 0, 0, 0]).double()) @ pose
        for at, pose in zip(BLOCKS, own, strict=True)
    ]
    found = find_segments(demos, {"block": Pose.stack(turned)}, upright)
    assert found.frames == ("block position", "block position")


def test_a_motion_that_ends_where_no_object_is_stays_in_the_base(demos):
    fixed = Pose(torch.tensor([0.4, -0.3, 0.3]).double(), BLOCKS[2].orientation)
    still = [
        Pose(fixed.position.expand(END, 3), fixed.orientation.expand(END, 4)) for _ in demos
    ]
    bare = [replace(demo, gripper=None) for demo in demos]
    found = find_segments(bare, {"block": Pose.stack(BLOCKS)}, still)
    assert found.frames == ("base",)


def test_new_motions_grasp_the_block_as_demonstrated(source, tool):
    """At the cut the tool has the demonstrated pose relative to the block, wherever it is."""
    blocks = [block(0.48, 0.15, 0.8), block(0.6, -0.05, -0.7), block(0.4, -0.12, 0.1)]
    made = source.motions(draws(blocks, start=(0.02, -0.03, 0.01)))
    assert [motion.reason for motion in made] == ["", "", ""]
    for k, at in enumerate(blocks):
        begun = panda.forward(made[k].joints[0]).position - tool[k][0].position
        torch.testing.assert_close(
            begun, torch.tensor([0.02, -0.03, 0.01]).double(), rtol=0, atol=1.5e-3
        )
        grasp = int(torch.where(made[k].phase >= GRASP)[0][0])
        found = panda.forward(made[k].joints[grasp])
        T, shown = at.matrix().numpy(), np.linalg.inv(BLOCKS[k].matrix().numpy())
        expected = T @ shown @ tool[k][GRASP].matrix().numpy()
        assert np.abs(found.matrix().numpy() - expected)[:3, 3].max() < 1.5e-3
        assert np.abs(found.matrix().numpy() - expected)[:3, :3].max() < 5e-3


def test_the_demonstrated_scene_gives_the_demonstration(source, demos):
    made = source.motions(draws(BLOCKS))
    for k, demo in enumerate(demos):
        assert len(made[k].joints) == END
        # Smoothing and the basis leave a few milliradians.
        assert np.abs(made[k].joints.numpy() - demo.joint_position).max() < 0.02


def test_segments_are_joined_with_continuous_velocity(source):
    """No step of the velocity between frames is larger at the cut than elsewhere."""
    made = source.motions(draws([block(0.48, 0.2, 1.0), block(0.6, -0.2, -0.9)]))
    for k in range(2):
        q = made[k].joints.numpy()
        steps = np.abs(np.diff(q, n=2, axis=0)).max(-1) * FPS
        grasp = int(torch.where(made[k].phase >= GRASP)[0][0])
        assert (
            steps[grasp - 3 : grasp + 3].max()
            <= np.delete(steps, range(grasp - 3, grasp + 3)).max()
        )


def test_fast_motions_are_slowed_down_to_the_limits(source):
    made = source.motions(draws(BLOCKS, speed=12.0))
    assert [motion.reason for motion in made] == ["", "", ""]
    for k in range(N):
        q = made[k].joints
        for order, limit in enumerate((panda.limits.velocity, panda.limits.acceleration), 1):
            rate = torch.diff(q, n=order, dim=0).abs() * FPS**order
            assert bool((rate <= limit).all())


def test_what_cannot_be_reached_says_so(source):
    made = source.motions(draws([block(1.4, 0.0, 0.0), BLOCKS[1]]))
    assert made[0].reason.startswith("not reached")
    assert made[1].reason == ""


def test_obstacles_are_found(demos, tool, objects, segments):
    joints = [torch.from_numpy(demo.joint_position) for demo in demos]
    wall = torch.tensor([[0.3, 0.0, 0.5, 0.05, 0.5, 0.3]]).double()
    source = MotionSource.fit(demos, tool, objects, segments, panda, joints, wall)
    found = {motion.reason for motion in source.motions(draws(BLOCKS))}
    assert found == {"collides with an obstacle"}


def test_demonstrations_cut_off_while_moving_end_at_rest(demos, tool, objects):
    """A sudden stop would be beyond the limits of acceleration at any speed."""
    last = 52  # while the block is lifted
    short = [
        replace(
            demo,
            **{name: getattr(demo, name)[:last] for name in ("time", "joint_position")},
            gripper=demo.gripper[:last],
            command_position=None,
        )
        for demo in demos
    ]
    tool = [pose[:last] for pose in tool]
    joints = [torch.from_numpy(demo.joint_position) for demo in short]
    segments = find_segments(short, objects, tool)
    source = MotionSource.fit(short, tool, objects, segments, panda, joints)
    for made, pose, demo in zip(source.motions(draws(BLOCKS)), tool, short, strict=True):
        assert made.reason == ""
        speed = made.joints.diff(dim=0).abs().amax(-1)
        assert np.abs(np.diff(demo.joint_position, axis=0))[-1].max() > 0.2 * speed.max()
        assert speed[-1] < 0.03 * speed.max()
        reached = panda.forward(made.joints[-1]).position
        torch.testing.assert_close(reached, pose[-1].position, rtol=0, atol=2e-3)


def test_another_arm_starts_in_a_posture_that_follows_the_demonstrations(
    demos, tool, objects, segments
):
    """From the first posture, with a wall beside the elbow, the arm would collide."""
    ur5e = arm("ur5e")
    postures = ur5e.postures(tool[0][0])
    free = MotionSource.fit(demos, tool, objects, segments, ur5e, postures)
    elbow = ur5e.joint_origins(free.near[0])[2]
    wall = torch.cat([elbow, torch.full((3,), 0.05).double()])[None]
    source = MotionSource.fit(demos, tool, objects, segments, ur5e, postures, wall)
    assert not torch.equal(source.near, free.near)
    assert {motion.reason for motion in source.motions(draws(BLOCKS))} == {""}


def test_five_joints_reach_the_positions(demos, tool, objects, segments):
    so101 = ArmChoice("so101").work_arm()
    moved = torch.tensor([0.0, 0.0, -0.08]).double()
    tool = [Pose(0.4 * pose.position + moved, pose.orientation) for pose in tool]
    objects = {n: Pose(0.4 * p.position + moved, p.orientation) for n, p in objects.items()}
    postures = so101.postures(tool[0][0])
    source = MotionSource.fit(demos, tool, objects, segments, so101, postures)
    given = draws(BLOCKS)
    given = replace(given, scene=objects)
    for made, pose in zip(source.motions(given), tool, strict=True):
        assert made.reason == ""
        grasp = int(torch.where(made.phase >= GRASP)[0][0])
        reached = so101.forward(made.joints[grasp]).position
        torch.testing.assert_close(reached, pose[GRASP].position, rtol=0, atol=2e-3)


def test_gradients_flow_to_the_scene(source):
    given = draws(BLOCKS)
    place = given.scene["block"].position.clone().requires_grad_()
    scene = {**given.scene, "block": Pose(place, given.scene["block"].orientation)}
    poses = source.poses(
        Draws(scene=scene, weights=given.weights, speed=given.speed, start=given.start)
    )
    poses.pose.position[0, -1, 0].backward()
    assert place.grad is not None
    assert place.grad[0, 0].item() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("frames", "cuts", "message"),
    [
        (("lid", "block"), (0, 40, 63), "no frame 'lid'"),
        (("block", "block"), (0, 63), "needs 3 cuts"),
        (("block", "block"), (0, 58, 63), "6 frames or more apart"),
        (("block", "block"), (0, 40, END), f"cuts of 0 to {END - 1}"),
    ],
)
def test_wrong_segments_are_refused(demos, objects, frames, cuts, message):
    wrong = Segmentation(frames=frames, cuts={demo.episode: cuts for demo in demos})
    with pytest.raises(ValueError, match=message):
        wrong.check(demos, objects)


def test_segments_of_six_frames_up_to_the_last_frame_are_taken(demos, objects):
    cuts = {demo.episode: (0, END - 7, END - 1) for demo in demos}
    Segmentation(frames=("block", "block"), cuts=cuts).check(demos, objects)


def test_a_gripper_that_closes_slowly_switches_where_it_begins_to(demos, objects, tool):
    slow = np.interp(np.arange(END), [36, 46], [0.08, 0.04])
    found = find_segments([replace(demo, gripper=slow) for demo in demos], objects, tool)
    assert {cuts[1] for cuts in found.cuts.values()} == {36}


def test_demonstrations_with_other_switches_are_refused(demos, tool, objects):
    other = [*demos[:-1], replace(demos[-1], gripper=np.full(END, 0.08))]
    with pytest.raises(ValueError, match="episode 2: 0"):
        find_segments(other, objects, tool)


@pytest.mark.parametrize("part", [0.1, 0.25, 0.5, 1.0])
def test_a_motion_comes_to_rest_smoothly_in_twice_the_time_of_its_last_part(part):
    """Progress, speed and acceleration are continuous, by derivatives of autograd."""
    ends = torch.tensor([[1 - part, 1 + part]], dtype=torch.float64)

    def derivatives(s):
        s = s.clone().requires_grad_()
        value = _stopped(s, part)
        speed = torch.autograd.grad(value.sum(), s, create_graph=True)[0]
        bend = torch.autograd.grad(speed.sum(), s)[0] if speed.requires_grad else 0 * s
        return value.detach(), speed.detach(), bend.detach()

    near = 1e-6
    inside = derivatives(ends + near * torch.tensor([[1.0, -1.0]]).double())
    outside = derivatives(ends - near * torch.tensor([[1.0, -1.0]]).double())
    expected = torch.tensor([[1 - part, 1.0]]).double()
    for value, speed, bend in (inside, outside):
        torch.testing.assert_close(value, expected, rtol=0, atol=2e-6)
        torch.testing.assert_close(
            speed, torch.tensor([[1.0, 0.0]]).double(), rtol=0, atol=1e-4
        )
        torch.testing.assert_close(bend, 0 * bend, rtol=0, atol=1e-3)
    s = torch.linspace(0, 1 + part, 301, dtype=torch.float64)[None]
    value, speed, bend = derivatives(s)
    before = s <= 1 - part
    torch.testing.assert_close(value[before], s[before], rtol=0, atol=0)
    assert (speed >= -1e-12).all()
    assert (speed <= 1 + 1e-12).all()
    assert (bend <= 1e-9).all()
    assert torch.equal(_stopped(s + 2.0, part), torch.ones_like(s))
