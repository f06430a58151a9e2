"""Capsule distances of the kinematics against MuJoCo, which shares no code with them."""

import mujoco
import numpy as np
import pytest
import sampling
import torch
from grasp_trials import PEDESTAL, TABLE

from hrc_learn.kinematics import CapsuleArm, panda
from hrc_learn.kinematics.collision import segment_box_distance
from hrc_learn.kinematics.franka import LINK_CAPSULES
from hrc_learn.sim import SceneConfig, whole_arm
from hrc_learn.sim.arm_model import FINGER_STROKE
from hrc_learn.sim.scene import build_scene
from hrc_learn.sim.step_checks import body_geoms

FAR = 3.0


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene(SceneConfig()).compile()


def geom_names() -> list[str]:
    """Of the links' capsules in the model, in the order of `LINK_CAPSULES`."""
    links = [capsule.link for capsule in LINK_CAPSULES]
    numbers = [links[:i].count(link) for i, link in enumerate(links)]
    return [
        f"link{link}_{k}" if link else "link0" for link, k in zip(links, numbers, strict=True)
    ]


def postures(count: int) -> torch.Tensor:
    limits = panda.limits
    return sampling.within(limits.lower, limits.upper, count, rng=sampling.generator())


def place(model: mujoco.MjModel, q: torch.Tensor) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for name, angle in zip(panda.joint_names, q.tolist(), strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    return data


def test_distances_of_links_are_those_of_the_simulator(model):
    ids = [model.geom(name).id for name in geom_names()]
    pairs = [(k, pair) for k, pair in enumerate(panda.whole.pairs) if max(pair) < len(ids)]
    assert len(pairs) > 40
    for q in postures(12):
        data = place(model, q)
        ours = panda.whole.pair_distances(q)
        for k, (a, b) in pairs:
            theirs = mujoco.mj_geomDistance(model, data, ids[a], ids[b], FAR, None)
            assert ours[k].item() == pytest.approx(theirs, abs=1e-6)


def test_the_distance_from_the_table_is_that_of_the_simulator(model):
    """The hand is a box there and a capsule round it here: links alone are compared."""
    table = SceneConfig().table
    arm = type(panda.whole)(panda, LINK_CAPSULES)
    ids = [model.geom(name).id for name in geom_names() if name != "link0"]
    top = model.geom("table").id
    q = postures(40)
    ours = arm.box_distance(q, torch.tensor(table.centre), torch.tensor(table.half_size))
    touched = 0
    for distance, posture in zip(ours.tolist(), q, strict=True):
        data = place(model, posture)
        theirs = min(mujoco.mj_geomDistance(model, data, i, top, FAR, None) for i in ids)
        if theirs > 1e-3:
            assert distance == pytest.approx(theirs, abs=1e-5)
        else:  # depths inside a box are measured differently
            touched += 1
            assert distance <= 1e-3
    assert touched > 0


def test_no_box_that_is_left_out_is_the_nearest():
    """Several at once: the least of what each gives by itself, the links one by one."""
    rng = sampling.generator(3)
    centre = 1.6 * torch.rand(9, 3, generator=rng, dtype=torch.float64) - 0.8
    half_size = 0.02 + 0.3 * torch.rand(9, 3, generator=rng, dtype=torch.float64)
    q = postures(50)
    ends = panda.whole.segments(q)
    each = torch.stack(
        [
            segment_box_distance(ends[:, k], centre[b], half_size[b]) - panda.whole.radius[k]
            for k, link in enumerate(panda.whole.links)
            for b in range(9)
            if link > 0
        ]
    )
    ours = panda.whole.box_distance(q, centre, half_size)
    torch.testing.assert_close(ours, each.amin(0), atol=1e-12, rtol=0)
    # A posture that is not known is at no distance.
    q[7, 2] = torch.nan
    unknown = panda.whole.box_distance(q.reshape(5, 10, 7), centre, half_size).isnan()
    assert unknown.nonzero().tolist() == [[0, 7]]


HAND = ("hand", *(f"finger_{side}{pad}" for side in ("left", "right") for pad in ("", "_pad")))


@pytest.mark.parametrize(
    ("arm", "geoms"),
    [(panda.whole, HAND), (whole_arm(SceneConfig().arm), (*HAND, "hand_marker_plate"))],
    ids=["hand", "hand and plate"],
)
@pytest.mark.parametrize("opening", [0.0, 0.02, FINGER_STROKE])
def test_the_hand_lies_within_its_capsules(model, arm, geoms, opening):
    """So a hand that touches something there touches it here."""
    corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    for q in postures(5):
        data = place(model, q)
        for finger in ("finger_left", "finger_right"):
            data.joint(finger).qpos[0] = opening
        mujoco.mj_kinematics(model, data)
        for name in geoms:
            geom, pose = model.geom(name), data.geom(name)
            points = pose.xpos + (corners * geom.size) @ pose.xmat.reshape(3, 3).T
            assert (outside(arm, q, torch.from_numpy(points)) < 1e-3).all()


def test_the_whole_arm_is_all_that_can_touch(model):
    """Links, hand, fingers and plate: there is no other geom of the arm that collides."""
    arm = body_geoms(model, ["link0"]) & (model.geom_contype != 0)
    names = {model.geom(int(g)).name for g in np.flatnonzero(arm)}
    assert names == {*geom_names(), *HAND, "hand_marker_plate"}


def outside(arm: CapsuleArm, q: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """How far points lie out of an arm's capsules [m]."""
    ends = arm.segments(q)
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    offset = points[:, None] - start
    t = ((offset * along).sum(-1) / (along * along).sum(-1)).clamp(0, 1)
    return ((offset - t[..., None] * along).norm(dim=-1) - arm.radius).amin(-1)


def test_the_trials_have_the_table_and_the_pedestal_of_the_simulator(model):
    for (centre, half_size), name in ((TABLE, "table"), (PEDESTAL, "pedestal")):
        geom = model.geom(name)
        place = model.body(geom.bodyid[0]).pos + geom.pos
        assert place.tolist() == pytest.approx(centre)
        assert geom.size.tolist() == pytest.approx(half_size)


def test_links_touch_where_the_simulator_says_so(model):
    names = geom_names()
    number = {model.geom(name).id: k for k, name in enumerate(names)}
    q = postures(600)
    found = 0
    for posture, ours in zip(q, panda.whole.pair_distances(q).tolist(), strict=True):
        contacts = place(model, posture).contact.geom
        geoms = [tuple(sorted(number.get(int(g), -1) for g in pair)) for pair in contacts]
        theirs = {pair for pair in geoms if pair[0] >= 0}
        touching = {
            pair
            for pair, distance in zip(panda.whole.pairs, ours, strict=True)
            if distance < 0 and max(pair) < len(names)
        }
        assert touching == theirs
        found += len(theirs)
    assert found > 10
