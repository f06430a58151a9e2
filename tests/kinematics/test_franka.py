import frankik
import pytest
import torch
from arm_samples import joint_positions
from sampling import generator, within
from torch.testing import assert_close

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import UnreachableError, arm, fr3, panda


def solvable_configurations(count, rng):
    """Where the closed form is known to find the configuration again.

    It leaves out the elbow folded past q4 = -0.467, and errs at the shoulder singularity.
    """
    q = joint_positions(2 * count + 20, rng=rng)
    q = q[(q[:, 3] < -0.48) & (q[:, 1].abs() > 0.02)]
    return q[:count]


def test_recovers_the_configuration_it_starts_from():
    q = solvable_configurations(300, generator(1))
    found = panda.inverse(panda.forward(q), q[:, 6], near=q)
    assert_close(found, q, rtol=0, atol=1e-6)


def test_every_branch_reaches_the_pose_within_limits():
    q = solvable_configurations(200, generator(2))
    pose = panda.forward(q)
    branches = panda.solutions(pose, q[:, 6])
    valid = ~branches.isnan().any(-1)
    assert bool(valid[:, 0].all())
    assert bool((valid[:, 1:] <= valid[:, :-1]).all()), "rows of NaN come last"
    assert bool(panda.limits.contain(branches[valid]).all())
    wanted = pose.matrix()[:, None].expand(-1, 4, 4, 4)[valid]
    assert_close(panda.forward(branches[valid]).matrix(), wanted, rtol=0, atol=1e-9)
    assert_close(branches[..., 6][valid], q[:, 6, None].expand(-1, 4)[valid])


def test_finds_the_branches_of_the_library_itself():
    """frankik takes the flange where it returns the tool centre point."""
    for q in solvable_configurations(50, generator(3)):
        flange = panda.link_poses(q)[7].matrix()
        theirs = torch.from_numpy(
            frankik.ik_full(flange.numpy(), q.numpy(), q[6].item(), False)
        )
        theirs = theirs[~theirs.isnan().any(-1)]
        ours = panda.solutions(panda.forward(q), q[6])
        ours = ours[~ours.isnan().any(-1)]
        distance = torch.cdist(theirs, ours).amin(-1)
        assert float(distance.max()) < 1e-6
        tip = torch.from_numpy(frankik.fk(q.numpy()))
        assert_close(panda.forward(q).matrix(), tip, rtol=0, atol=1e-9)


def test_nearest_branch_is_chosen():
    q = solvable_configurations(200, generator(4))
    pose = panda.forward(q)
    branches = panda.solutions(pose, q[:, 6])
    count = (~branches.isnan().any(-1)).sum(-1)
    i = int(count.argmax())
    assert int(count[i]) >= 2
    for branch in branches[i, : count[i]]:
        assert_close(panda.inverse(pose[i], q[i, 6], near=branch + 0.01), branch)


def test_without_near_the_branch_is_the_one_nearest_to_ready():
    found = panda.inverse(panda.forward(panda.ready), panda.ready[6])
    assert_close(found, panda.ready, rtol=0, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (1,), (2, 1, 3)])
def test_batches_and_broadcasts(batch):
    q = solvable_configurations(6, generator(5))[: torch.Size(batch).numel()].reshape(*batch, 7)
    pose = panda.forward(q)
    assert panda.solutions(pose, q[..., 6]).shape == (*batch, 4, 7)
    assert panda.solutions(pose, 0.3).shape == (*batch, 4, 7)
    assert_close(panda.inverse(pose, q[..., 6], near=q), q, rtol=0, atol=1e-6)


def test_one_pose_with_several_values_of_joint_7():
    q7 = torch.linspace(0.5, 1.0, 5, dtype=torch.float64)
    pose = panda.forward(panda.ready)
    found = panda.inverse(pose, q7)
    assert_close(found[:, 6], q7)
    wanted = pose.matrix().expand(5, 4, 4)
    assert_close(panda.forward(found).matrix(), wanted, rtol=0, atol=1e-9)


def test_dtype_follows_the_pose():
    pose = panda.forward(panda.ready)
    single = Pose(pose.position.float(), pose.orientation.float())
    found = panda.inverse(single, torch.pi / 4)
    assert found.dtype == torch.float32
    assert_close(found, panda.ready.float(), rtol=0, atol=1e-5)


def test_unreachable_pose_names_itself_and_says_what_to_do():
    ready = panda.forward(panda.ready)
    far = Pose(
        ready.position + torch.tensor([3.0, 0, 0], dtype=torch.float64), ready.orientation
    )
    with pytest.raises(UnreachableError, match=r"position \(3\.30.*0\.7854 rad.*other values"):
        panda.inverse(far, torch.pi / 4)
    both = Pose(torch.stack([ready.position, far.position]), ready.orientation.expand(2, 4))
    with pytest.raises(UnreachableError, match=r"pose \[1\] of \[2\]"):
        panda.inverse(both, torch.pi / 4)
    assert bool(panda.solutions(far, torch.pi / 4).isnan().all())


def test_joint_7_outside_its_limits_is_unreachable():
    with pytest.raises(ValueError, match=r"joint 7 at 3\.0000 rad"):
        panda.inverse(panda.forward(panda.ready), 3.0)


def test_position_limits_are_those_of_the_inverse_kinematics_library():
    def theirs(values):
        return torch.tensor(values, dtype=torch.float64)

    assert_close(panda.limits.lower, theirs(frankik.q_min_panda), rtol=0, atol=1e-4)
    assert_close(panda.limits.upper, theirs(frankik.q_max_panda), rtol=0, atol=1e-4)


def test_contain_tells_inside_from_outside():
    limits = panda.limits
    q = within(limits.lower, limits.upper, 3, 2, rng=generator(1))
    assert limits.contain(q).shape == (3, 2)
    assert bool(limits.contain(q).all())
    assert bool(limits.contain(limits.lower))
    for joint in range(7):
        outside = q.clone()
        outside[..., joint] = limits.upper[joint] + 1e-6
        assert not bool(limits.contain(outside).any())
    assert bool(limits.contain(limits.middle.float()))


def research_3_configurations(count):
    """Of the FR3 within the range of the Panda too, elbow and shoulder as for that."""
    lower = fr3.limits.lower.maximum(panda.limits.lower)
    upper = fr3.limits.upper.minimum(panda.limits.upper)
    q = within(lower, upper, 2 * count + 20, rng=generator(6))
    return q[(q[:, 3] < -0.48) & (q[:, 1].abs() > 0.02)][:count]


def test_the_research_3_has_the_inverse_within_limits_of_its_own():
    q = research_3_configurations(300)
    pose = fr3.forward(q)
    assert_close(fr3.inverse(pose, q[:, 6], near=q), q, rtol=0, atol=1e-6)
    branches = fr3.solutions(pose, q[:, 6])
    valid = ~branches.isnan().any(-1)
    assert bool(fr3.limits.contain(branches[valid]).all())
    wanted = pose.matrix()[:, None].expand(-1, 4, 4, 4)[valid]
    assert_close(fr3.forward(branches[valid]).matrix(), wanted, rtol=0, atol=1e-9)


def test_its_wrist_bends_further_than_the_pandas():
    """Where all joints are in the narrow range of frankik's FR3."""
    q = fr3.ready.clone()
    q[5], q[6] = 4.0, 0.3
    pose = fr3.forward(q)
    assert_close(fr3.inverse(pose, q[6], near=q), q, rtol=0, atol=1e-6)
    found = panda.solutions(pose, q[6])
    assert not bool(((found - q).abs().amax(-1) < 1e-3).any())


def test_arms_by_their_name():
    assert arm("panda") is panda
    assert arm("fr3") is fr3
    assert fr3.joint_names[6] == "fr3_joint7"
