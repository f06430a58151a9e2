import math
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from bare_arm import bare
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import (
    ArmChoice,
    JointLimits,
    LinkCapsule,
    UnreachableError,
    panda,
)
from hrc_learn.kinematics import arm as registered
from hrc_learn.kinematics.arm import _behind
from hrc_learn.kinematics.drawing import arm_meshes
from hrc_learn.kinematics.inverse import follow_poses, solutions_from


def poses_of(chain, count, seed=0):
    rng = torch.Generator().manual_seed(seed)
    share = torch.rand(count, len(chain.joint_names), generator=rng, dtype=torch.float64)
    lower, upper = chain.limits.lower, chain.limits.upper
    q = lower + (0.1 + 0.8 * share) * (upper - lower)
    return q, chain.forward(q)


@pytest.mark.parametrize("left_out", [(2,), ()])
def test_solutions_reach_the_pose_within_the_limits(left_out):
    arm = bare(left_out).with_hand()
    starts, poses = poses_of(arm.chain, 40)
    found_of_all = solutions_from(arm.chain, poses[:5], starts)
    for i in range(5):
        found = found_of_all[i]
        found = found[found.isfinite().all(-1)]
        assert len(found)
        assert arm.chain.limits.contain(found).all()
        error = arm.chain.forward(found).twist_to(poses[i]).abs().max()
        assert error < 1e-9


def test_the_nearest_is_where_the_pose_came_from():
    arm = bare().with_hand()
    q, poses = poses_of(arm.chain, 10, seed=1)
    for i in range(len(q)):
        found = arm.inverse(poses[i], near=q[i] + 0.02)
        # Six joints have finitely many solutions: the one beside is the same.
        torch.testing.assert_close(found, q[i], atol=1e-7, rtol=0)


def test_joints_that_turn_twice_around_stay_near():
    turning = bare()
    limits = turning.chain.limits
    turning.chain.limits = JointLimits(
        **{**vars(limits), "lower": limits.lower - 6.0, "upper": limits.upper + 6.0}
    )
    arm = turning.with_hand()
    q, _ = poses_of(bare().chain, 3, seed=2)
    pose = arm.chain.forward(q)
    for i in range(3):
        away = q[i] + torch.tensor([2 * math.pi, 0, 0, 0, 0, 0], dtype=torch.float64)
        found = arm.inverse(pose[i], near=away)
        torch.testing.assert_close(found, away, atol=1e-7, rtol=0)


def test_joints_that_slide_go_on_sliding_and_are_not_turned():
    described = bare((), slides=(0,))
    limits = described.chain.limits
    # So far that it could go by the length of a whole turn, were it one [m].
    far = limits.upper.clone()
    far[0] = 9.0
    described.chain.limits = JointLimits(**{**vars(limits), "upper": far})
    arm = described.with_hand()
    q, _ = poses_of(bare(()).chain, 3, seed=2)
    pose = described.with_tool(arm.chain.tcp).forward(q)
    assert arm.chain.forward(q).twist_to(pose).abs().max() < 1e-12
    away = torch.zeros(7, dtype=torch.float64)
    away[0] = 2 * math.pi
    for i in range(3):
        found = arm.inverse(pose[i], near=q[i] + away)
        assert arm.chain.forward(found).twist_to(pose[i]).abs().max() < 1e-6


def test_postures_differ_and_the_first_is_the_most_comfortable():
    arm = bare().with_hand()
    _, poses = poses_of(arm.chain, 10, seed=3)
    several = [found for found in (arm.postures(poses[i]) for i in range(10)) if len(found) > 1]
    assert several
    for found in several:
        assert torch.pdist(found).min() > 1e-3
        # Further from both singularities and limits than the first: no other is.
        smallest = torch.linalg.svdvals(arm.chain.jacobian(found))[:, -1]
        limits = arm.chain.limits
        room = torch.minimum(found - limits.lower, limits.upper - found).amin(-1)
        better = (smallest > smallest[0]) & (room > room[0])
        enough = (room[0] > 0.3) & (smallest[0] > 0.1)
        assert enough or not better.any()


def test_a_pose_out_of_reach_is_refused():
    arm = bare().with_hand()
    far = Pose(torch.tensor([3.0, 0.0, 0.0]).double(), torch.tensor([1.0, 0, 0, 0]).double())
    with pytest.raises(UnreachableError, match=r"\(3\.000, 0\.000, 0\.000\) m"):
        arm.inverse(far, near=arm.chain.ready)
    with pytest.raises(UnreachableError):
        arm.postures(far)


def test_it_carries_our_hand_in_place_of_its_own():
    described = bare()
    arm = described.with_hand()
    hand = arm.chain.forward(arm.chain.ready).position
    flange = described.chain.forward(described.chain.ready)
    along = torch.tensor([0.0, 0.0, 0.1034], dtype=torch.float64)
    torch.testing.assert_close(hand, flange.apply(along))
    assert max(arm.body.links) == 6
    own = [c for c in panda.whole.capsules if c.link == 9]
    assert [c.radius for c in arm.whole.capsules if c.link == 8] == [c.radius for c in own]
    assert arm.masses[1:7] == (2.0,) * 6
    assert {(0, 2), (5, 8), (6, 8)} == set(arm.whole.overlapping)


@pytest.mark.parametrize(
    ("left_out", "null_space"), [((2,), "none"), ((), "free")], ids=["6", "7"]
)
def test_what_null_space_is_left(left_out, null_space):
    arm = bare(left_out).with_hand()
    rank = np.linalg.matrix_rank(arm.chain.jacobian(arm.chain.ready).numpy())
    assert arm.null_space == null_space
    assert (arm.joints - rank > 0) == (null_space == "free")
    assert panda.null_space == "arm angle"


def test_too_few_joints_are_refused():
    with pytest.raises(ValueError, match="cut has 4 joints"):
        bare((2, 4, 6)).with_hand()


def test_five_joints_reach_the_position_and_the_nearest_orientation():
    arm = bare((2, 4)).with_hand()
    assert (arm.task, bare().with_hand().task) == ("nearest pose", "pose")
    rng, limits = torch.Generator().manual_seed(4), arm.limits
    middle, half = (limits.lower + limits.upper) / 2, (limits.upper - limits.lower) / 2
    q = middle + 0.4 * half * (2 * torch.rand(20, 5, generator=rng, dtype=torch.float64) - 1)
    poses = arm.forward(q)
    turn = 0.1 * torch.randn(20, 3, generator=rng, dtype=torch.float64)
    wanted = Pose(poses.position, quaternion.multiply(quaternion.exp(turn), poses.orientation))
    found = arm.inverse(wanted, near=q)
    assert limits.contain(found).all()
    reached = arm.forward(found)
    torch.testing.assert_close(reached.position, wanted.position, atol=1e-6, rtol=0)
    angle = quaternion.angle(reached.orientation, wanted.orientation)
    assert (angle < quaternion.angle(poses.orientation, wanted.orientation)).all()
    # No joint motion that keeps the position turns the tool nearer: the slope is zero.
    still = torch.linalg.svd(arm.jacobian(found)[:, :3]).Vh[:, 3:]
    for k in range(2):
        beside = [arm.forward(found + step * still[:, k]) for step in (1e-4, -1e-4)]
        first, second = (quaternion.angle(b.orientation, wanted.orientation) for b in beside)
        assert ((first - second).abs() / 2e-4 < 1e-4).all()


@pytest.mark.long
def test_a_pose_of_another_direction_is_no_nearest_one():
    arm = bare((2, 4)).with_hand()
    _, poses = poses_of(arm, 5, seed=6)
    away = quaternion.exp(torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))
    refused = 0
    for i in range(5):
        turned = Pose(poses[i].position, quaternion.multiply(away, poses[i].orientation))
        try:
            found = arm.forward(arm.inverse(turned, near=arm.ready))
        except UnreachableError:
            refused += 1
        else:
            assert quaternion.angle(found.orientation, turned.orientation) < 0.7
    assert refused


@pytest.mark.skipif(find_spec("cmeel") is None, reason="example-robot-data is not installed")
def test_the_hand_of_an_so101_replaces_its_jaws():
    described, held = registered("so101"), ArmChoice("so101").work_arm()
    q = described.ready
    tips, jaws = held.forward(q).position, described.forward(q).position
    # The jaws end beside the axis of wrist_roll, the hand on it.
    assert float((tips - jaws).norm()) < 0.01
    axis = held.link_poses(q).matrix()[-1]
    across = torch.linalg.cross(held.forward(q).position - axis[:3, 3], axis[:3, 2], dim=-1)
    assert float(across.norm()) < 1e-3
    assert max(c.end[2] for c in held.body.capsules if c.link == 5) <= 0.0
    assert ArmChoice("so101:gripper_frame_link").work_arm().body.capsules == held.body.capsules


@pytest.mark.skipif(find_spec("cmeel") is None, reason="example-robot-data is not installed")
def test_settings_of_hand_and_tool_belong_to_the_registered_tip():
    usual = ArmChoice("ur3").work_arm().hand_size
    assert ArmChoice("ur3:tool0").work_arm().hand_size == usual == 0.6
    assert ArmChoice("ur3:wrist_3_link").work_arm().hand_size == 1.0
    other = registered("so100", tip="wrist", ready=[0.0, 0.5, -0.5, 0.0])
    assert torch.equal(other.tcp, torch.eye(4, dtype=torch.float64))


def test_a_choice_opens_the_same_arm_each_time():
    assert ArmChoice().work_arm() is panda
    fr3 = ArmChoice("fr3").work_arm()
    assert fr3.chain.joint_names[0] == "fr3_joint1"
    assert ArmChoice("fr3").work_arm() is fr3


def test_an_arm_that_there_is_not_is_named():
    with pytest.raises(ValueError, match=r"no arm 'pandora': there are panda, fr3"):
        ArmChoice("pandora").work_arm()


def test_the_nearest_of_frankas_is_the_best_of_a_scan_of_joint_7():
    lower, upper = float(panda.limits.lower[6]) + 0.02, float(panda.limits.upper[6]) - 0.02
    q, poses = poses_of(panda, 6, seed=4)
    for i in range(len(q)):
        near = (q[i] + 0.3).clamp(panda.limits.lower, panda.limits.upper)
        found = panda.inverse(poses[i], near=near, samples=15)
        scanned = []
        for q7 in [float(near[6]), *torch.linspace(lower, upper, 15).tolist()]:
            try:
                scanned.append(panda.inverse(poses[i], q7, near=near))
            except UnreachableError:
                continue
        least = min(float((other - near).norm()) for other in scanned)
        assert float((found - near).norm()) == pytest.approx(least, abs=1e-6)
        assert panda.forward(found).twist_to(poses[i]).abs().max() < 1e-6


@pytest.mark.parametrize("of", ["panda", "cut"])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 2)])
def test_the_nearest_of_many_poses_are_those_of_each(batch, of):
    arm = panda if of == "panda" else bare().with_hand()
    q, poses = poses_of(arm.chain, 4, seed=6)
    near = (q + 0.2).clamp(arm.chain.limits.lower, arm.chain.limits.upper)
    count = math.prod(batch)
    shaped = Pose(
        poses.position[:count].reshape(*batch, 3), poses.orientation[:count].reshape(*batch, 4)
    )
    found = arm.inverse(shaped, near=near[:count].reshape(*batch, -1), samples=9)
    assert found.shape == (*batch, arm.joints)
    for i, row in enumerate(found.reshape(count, -1)):
        torch.testing.assert_close(row, arm.inverse(poses[i], near=near[i], samples=9))
    # One wish for all of them.
    same = arm.inverse(shaped, near=near[0], samples=9).reshape(count, -1)
    torch.testing.assert_close(same[-1], arm.inverse(poses[count - 1], near=near[0], samples=9))


@pytest.mark.parametrize("of", ["panda", "cut"])
@pytest.mark.parametrize("batch", [(0,), (3, 0), (0, 3)])
def test_no_pose_has_no_solution(batch, of):
    arm = panda if of == "panda" else bare().with_hand()
    poses = Pose(torch.zeros(*batch, 3).double(), torch.zeros(*batch, 4).double())
    for near in (None, arm.ready):
        assert arm.inverse(poses, near=near, samples=9).shape == (*batch, arm.joints)


@pytest.mark.parametrize("of", ["panda", "cut"])
def test_the_first_of_many_poses_out_of_reach_is_named(of):
    arm = panda if of == "panda" else bare().with_hand()
    _, poses = poses_of(arm.chain, 3, seed=7)
    position = poses.position.clone()
    position[1, 0], position[2, 0] = 2.5, 3.5
    with pytest.raises(UnreachableError, match=r"position \(2\.500,"):
        arm.inverse(Pose(position, poses.orientation), near=arm.ready, samples=9)


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_solutions_of_many_poses_are_those_of_each(batch):
    chain = bare().chain
    starts, poses = poses_of(chain, 12, seed=5)
    count = math.prod(batch)
    many = Pose(
        poses.position[:count].reshape(*batch, 3), poses.orientation[:count].reshape(*batch, 4)
    )
    found = solutions_from(chain, many, starts).reshape(count, 12, -1)
    for i in range(count):
        torch.testing.assert_close(
            found[i], solutions_from(chain, poses[i], starts), equal_nan=True
        )
    assert found.isfinite().any()
    assert found.isnan().any()


def test_joints_led_along_a_path_stay_on_it_and_move_steadily():
    chain = bare(()).chain
    start = chain.ready + 0.05
    begin = chain.forward(start)
    share = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    aside = torch.tensor([0.05, -0.08, 0.06], dtype=torch.float64)
    path = Pose(begin.position + share * aside, begin.orientation.expand(40, 4))
    rows = torch.stack([start, start])
    q, error = follow_poses(chain, path, rows)
    assert q.shape == (40, 2, 7)
    assert error.max() < 1e-6
    reached = chain.forward(q[:, 0]).twist_to(path).abs().max()
    assert reached < 1e-6
    # As the arm's own resolved rate leads there: dq = J^+ dx, integrated in small steps.
    slow = start.clone()
    for _ in range(2000):
        J = chain.jacobian(slow)
        twist = torch.cat([aside, torch.zeros(3, dtype=torch.float64)]) / 2000
        slow = slow + torch.linalg.pinv(J) @ twist
    torch.testing.assert_close(q[-1, 0], slow, atol=2e-3, rtol=0)


@pytest.mark.skipif(find_spec("cmeel") is None, reason="example-robot-data is not installed")
def test_five_joints_stay_on_a_path_where_one_of_them_stops_at_its_limit():
    chain = registered("so101")
    # The tool points down and moves outwards, until the wrist cannot bend any further.
    start = torch.tensor([0.35, -0.15, 0.05, 1.6, 1.9], dtype=torch.float64)
    begin = chain.forward(start)
    share = torch.linspace(0, 1, 12, dtype=torch.float64)[:, None]
    aside = torch.tensor([0.075, 0.0, 0.01], dtype=torch.float64)
    path = Pose(begin.position + share * aside, begin.orientation.expand(12, 4))
    q, _ = follow_poses(chain, path, start)
    assert q[-1, 3] == pytest.approx(float(chain.limits.upper[3]))
    missed = chain.forward(q).twist_to(path)
    assert missed[:, :3].norm(dim=-1).max() < 1e-3  # 18 mm without a correction
    assert 0.02 < missed[:, 3:].norm(dim=-1).max() < 0.3
    # Without a null space, a wanted posture changes nothing.
    wished, _ = follow_poses(chain, path, start, (q + 0.3).clone())
    torch.testing.assert_close(wished, q, atol=0, rtol=0)


def test_a_path_out_of_reach_is_not_followed():
    chain = bare(()).chain
    begin = chain.forward(chain.ready)
    share = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    away = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    path = Pose(begin.position + share * away, begin.orientation.expand(20, 4))
    q, error = follow_poses(chain, path, chain.ready)
    assert error[0] < 1e-6 < 0.5 < error[-1]
    assert chain.limits.contain(q).all()


@pytest.mark.skipif(find_spec("gym_aloha") is None, reason="gym-aloha is not installed")
def test_a_hand_of_the_cell_points_where_the_arm_approaches():
    # The ViperX's description approaches along its gripper's x axis, not along z.
    described, held = registered("viperx"), ArmChoice("viperx").work_arm()
    approach, pointed = described.tcp[:3, 2], held.tcp[:3, 3]
    torch.testing.assert_close(pointed / pointed.norm(), approach, rtol=0, atol=1e-12)
    assert held.hand_size == pytest.approx(0.7)
    assert float(pointed.norm()) == pytest.approx(0.7 * float(panda.tcp[:3, 3].norm()))


@pytest.mark.skipif(find_spec("gym_aloha") is None, reason="gym-aloha is not installed")
def test_a_small_hand_is_drawn_small():
    # A hand drawn at full size hid its own marker from the camera.
    meshes = arm_meshes(ArmChoice("viperx").work_arm(), "hand")
    assert all(mesh.scale == pytest.approx((0.7, 0.7, 0.7)) for mesh in meshes)
    assert all(mesh.scale == (1.0, 1.0, 1.0) for mesh in arm_meshes(panda, "hand"))


def test_a_capsule_ends_where_a_hand_begins():
    """Ends before the hand's base plane go back until the round end is behind it."""
    hand = torch.eye(4, dtype=torch.float64)
    hand[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix())
    hand[:3, 3] = torch.tensor([0.1, 0.2, 0.3])
    place = hand[:3, 3].numpy(), hand[:3, :3].numpy()

    def capsule(start, end):
        ends = [place[0] + place[1] @ np.array(x) for x in (start, end)]
        first, last = (tuple(x.tolist()) for x in ends)
        return LinkCapsule(link=3, start=first, end=last, radius=0.04)

    behind = capsule((0.0, 0.0, -0.2), (0.05, 0.0, -0.01))
    assert _behind(behind, hand) == behind
    cut = _behind(capsule((0.02, 0.0, -0.2), (0.0, 0.03, 0.1)), hand)
    expected = capsule((0.02, 0.0, -0.2), (0.0, 0.03, -0.04))
    np.testing.assert_allclose(cut.start, expected.start, atol=1e-12)
    np.testing.assert_allclose(cut.end, expected.end, atol=1e-12)
    assert (cut.link, cut.radius) == (3, 0.04)
    assert _behind(capsule((0.0, 0.0, 0.01), (0.0, 0.0, 0.1)), hand) is None
    other = _behind(capsule((0.0, 0.0, 0.1), (0.0, 0.0, -0.2)), hand)
    np.testing.assert_allclose(other.start, capsule((0, 0, -0.04), (0, 0, 0)).start, atol=1e-12)
