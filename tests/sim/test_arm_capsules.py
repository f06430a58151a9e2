"""Capsule distances of the kinematics against MuJoCo, which shares no code with them."""

import mujoco
import numpy as np
import pytest
import sampling
import torch

from hrc_learn.experiments.controller.grasp_trials import PEDESTAL, TABLE
from hrc_learn.kinematics import LINK_CAPSULES, panda, panda_capsules
from hrc_learn.sim import SceneConfig, build_scene

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
    pairs = [(k, pair) for k, pair in enumerate(panda_capsules.pairs) if max(pair) < len(ids)]
    assert len(pairs) > 40
    for q in postures(12):
        data = place(model, q)
        ours = panda_capsules.pair_distances(q)
        for k, (a, b) in pairs:
            theirs = mujoco.mj_geomDistance(model, data, ids[a], ids[b], FAR, None)
            assert ours[k].item() == pytest.approx(theirs, abs=1e-6)


def test_the_distance_from_the_table_is_that_of_the_simulator(model):
    """The hand is a box there and a capsule round it here: links alone are compared."""
    table = SceneConfig().table
    arm = type(panda_capsules)(panda, LINK_CAPSULES)
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


def test_the_hand_lies_within_its_capsules(model):
    """So a hand that touches something there touches it here."""
    geoms = [model.geom(name) for name in ("hand", "finger_left", "finger_left_pad")]
    corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    for q in postures(5):
        data = place(model, q)
        data.joint("finger_left").qpos[0] = 0.02
        mujoco.mj_kinematics(model, data)
        ends = panda_capsules.segments(q)[len(LINK_CAPSULES) :]
        for geom in geoms:
            pose = data.geom(geom.name)
            points = pose.xpos + (corners * geom.size) @ pose.xmat.reshape(3, 3).T
            assert (outside(torch.from_numpy(points), ends) < 1e-3).all()


def outside(points: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """How far points lie out of the hand's capsules [m]."""
    radius = torch.tensor([c.radius for c in panda_capsules.capsules[len(LINK_CAPSULES) :]])
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    offset = points[:, None] - start
    t = ((offset * along).sum(-1) / (along * along).sum(-1)).clamp(0, 1)
    return ((offset - t[..., None] * along).norm(dim=-1) - radius).amin(-1)


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
    for posture, ours in zip(q, panda_capsules.pair_distances(q).tolist(), strict=True):
        contacts = place(model, posture).contact.geom
        geoms = [tuple(sorted(number.get(int(g), -1) for g in pair)) for pair in contacts]
        theirs = {pair for pair in geoms if pair[0] >= 0}
        touching = {
            pair
            for pair, distance in zip(panda_capsules.pairs, ours, strict=True)
            if distance < 0 and max(pair) < len(names)
        }
        assert touching == theirs
        found += len(theirs)
    assert found > 10
