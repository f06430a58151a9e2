"""Columns of new episodes: those of a demonstration, if the motion is the demonstrated one."""

from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetWriter, open_demos
from hrc_learn.demos.dataset_views import arm_of_dataset
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import arm, panda
from hrc_learn.learning.multiply_dataset import MultipliedColumns, _departure, pose_of
from hrc_learn.learning.multiply_motions import NewMotion

pytestmark = pytest.mark.simulation

FPS, FRAMES = 20, 24
TIME = np.arange(FRAMES) / FPS
# The lid is turned by more than half a turn, as a recorder's rotation vector may be.
LID = np.array([0.4, -0.2, 0.1, 0.0, 0.0, 3.3])
BLOCK = np.array([0.5, 0.1, 0.05, *Rotation.from_euler("z", 0.4).as_quat(scalar_first=True)])
CUP = np.array([0.3, 0.3, 0.2])
TOOL = tuple(f"ee.{axis}" for axis in ("x", "y", "z", "wx", "wy", "wz"))


def joints(episode):
    return panda.ready.numpy() + 0.1 * np.sin(TIME[:, None] + np.arange(7) + episode)


def moved(pose, x):
    return np.array([pose[0] + x, *pose[1:]])


class Case(NamedTuple):
    """Demonstrations on disk, and the columns of episodes made of them."""

    source: object
    columns: MultipliedColumns
    other: MultipliedColumns


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("columns") / "demos"
    pose = ("x", "y", "z")
    features = {
        "observation.block": tuple(f"block.{a}" for a in (*pose, "qw", "qx", "qy", "qz")),
        "observation.lid": tuple(f"lid.{a}" for a in (*pose, "wx", "wy", "wz")),
        "observation.cup": ("first", "second", "third"),
        "observation.mood": ("mood", "lamp"),
        "action.tool": (*TOOL, "gripper"),
    }
    with DatasetWriter(folder, FPS, "panda", panda.joint_names, features) as writer:
        for episode in range(2):
            q = joints(episode)
            tool = panda.forward(torch.from_numpy(q))
            turns = Rotation.from_quat(tool.orientation.numpy(), scalar_first=True)
            rate = np.gradient(q, TIME, axis=0)
            vector = turns.as_rotvec()
            flip = np.where((vector @ vector[0]) < 0, 1 - 2 * np.pi / turns.magnitude(), 1)
            place = np.concatenate([tool.position.numpy(), vector * flip[:, None]], axis=1)
            following = np.concatenate([place[1:], place[-1:]])
            writer.start_episode("go")
            for k in range(FRAMES):
                opening = 0.08 - 0.002 * k
                more = {
                    "observation.block": moved(BLOCK, 0.01 * episode),
                    "observation.lid": LID,
                    "observation.cup": CUP + episode,
                    "observation.mood": [k * k / 100, float(k % 8 > 3)],
                    "action.tool": [*following[k], opening + 1],
                }
                writer.add_frame(
                    joint_position=q[k],
                    joint_velocity=rate[k],
                    command_position=q[k] + 0.01,
                    position=tool.position[k].numpy(),
                    orientation=tool.orientation[k].numpy(),
                    gripper=opening,
                    **more,
                )
            writer.save_episode()
    source = open_demos(folder)
    taught, given = arm_of_dataset(source), {"cup": "observation.cup[0:3]"}
    made = (MultipliedColumns(source, taught, robot, given) for robot in (panda, arm("ur5e")))
    return Case(source, *made)


def on_disk(case, episode):
    """Columns of a demonstration, read by PyArrow."""
    path = case.source.folder.root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    rows = np.asarray(table["episode_index"]) == episode
    return {key: np.stack(table[key].to_pylist())[rows] for key in case.columns.features}


def still(pose):
    return np.broadcast_to(pose, (FRAMES, 7)).copy()


def seven(place, turn):
    return np.concatenate([place, turn.as_quat(scalar_first=True)])


def made_again(case, episode=0, **more):
    """Values of the demonstrated motion."""
    q = joints(episode)
    lid = seven(LID[:3], Rotation.from_rotvec(LID[3:]))
    cup = seven(CUP + episode, Rotation.identity())
    block = moved(BLOCK, 0.01 * episode)
    given = {
        "main": episode,
        "phase": np.arange(FRAMES, dtype=float),
        "joints": q,
        "sent": q + 0.01,
        "gripper": 0.08 - 0.002 * np.arange(FRAMES),
        "objects": {"block": still(block), "lid": still(lid), "cup": still(cup)},
    } | more
    return case.columns.values(**given)


@pytest.mark.parametrize("episode", [0, 1])
def test_the_demonstrated_motion_gives_the_columns_of_the_demonstration(case, episode):
    expected, made = on_disk(case, episode), made_again(case, episode)
    assert made.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_allclose(made[key], values, atol=3e-6, err_msg=key)
    assert "time" not in case.columns.features


def tooled(folder, place):
    """Columns of two demonstrations whose recorder has another tool, at `place` of the hand."""
    with DatasetWriter(folder, FPS, "panda", panda.joint_names) as writer:
        for episode in range(2):
            q = joints(episode)
            T = panda.forward(torch.from_numpy(q)).matrix().numpy()
            writer.start_episode("go")
            for k in range(FRAMES):
                position = T[k, :3, :3] @ place(k) + T[k, :3, 3]
                writer.add_frame(joint_position=q[k], command_position=q[k], position=position)
            writer.save_episode()
    source = open_demos(folder)
    return MultipliedColumns(source, arm_of_dataset(source), panda, {})


def test_the_tool_of_the_recorder_is_kept(tmp_path):
    columns = tooled(tmp_path / "demos", lambda _: np.array([0.02, -0.01, 0.12]))
    phase = np.arange(FRAMES, dtype=float)
    made = columns.values(0, phase, joints(1), joints(1), None, {})
    names = columns.features["observation.state"]["names"]
    state = made["observation.state"][:, [names.index(f"ee.{axis}") for axis in "xyz"]]
    tool = panda.forward(torch.from_numpy(joints(1))).matrix().numpy()
    expected = tool[:, :3, :3] @ [0.02, -0.01, 0.12] + tool[:, :3, 3]
    np.testing.assert_allclose(state, expected, atol=1e-6)


def test_tool_positions_that_no_tool_of_the_arm_has_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"mm from where the joints of panda move it"):
        tooled(tmp_path / "demos", lambda k: np.array([0.02 * k, 0.0, 0.0]))


def test_objects_stand_where_their_columns_say(case):
    found = case.columns.objects
    assert found.keys() == {"block", "lid", "cup"}
    np.testing.assert_allclose(found["block"].position[:, 0], (0.5, 0.51), atol=1e-6)
    np.testing.assert_allclose(found["cup"].position, (CUP, CUP + 1), atol=1e-6)
    np.testing.assert_allclose(found["cup"].orientation, [[1, 0, 0, 0]] * 2)
    np.testing.assert_allclose(found["block"].orientation[1], BLOCK[3:], atol=1e-6)
    own = Rotation.from_quat(found["lid"].orientation[0].numpy(), scalar_first=True)
    assert (own * Rotation.from_rotvec(LID[3:]).inv()).magnitude() < 1e-6


def test_objects_and_gripper_move_on_their_own(case):
    away = [0.2, 0.1, 0.3]
    turned = Rotation.from_rotvec([0, 0, 3.5])
    lid = still(seven(LID[:3] + away, turned))
    made = made_again(case, gripper=np.full(FRAMES, 0.03), objects={"lid": lid})
    np.testing.assert_allclose(made["observation.lid"][:, :3], still_three(LID[:3] + away))
    # The rotation vector continues the demonstrated one beyond half a turn.
    np.testing.assert_allclose(made["observation.lid"][:, 3:], still_three([0, 0, 3.5]))
    names = case.columns.features["observation.state"]["names"]
    opening = made["observation.state"][:, names.index("gripper.pos")]
    np.testing.assert_allclose(opening, 0.03)
    block = on_disk(case, 0)["observation.block"]
    np.testing.assert_allclose(made["observation.block"], block, atol=1e-6)


def still_three(values):
    return np.broadcast_to(values, (FRAMES, 3))


def test_other_columns_are_carried_along_between_frames_and_switches_stay_switches(case):
    phase = np.linspace(0, FRAMES - 1.3, FRAMES)
    made = made_again(case, phase=phase, gripper=None)
    shown = on_disk(case, 0)
    mood = np.interp(phase, np.arange(FRAMES), shown["observation.mood"][:, 0])
    np.testing.assert_allclose(made["observation.mood"][:, 0], mood, atol=1e-9)
    lamp = shown["observation.mood"][np.rint(phase).astype(int), 1]
    np.testing.assert_array_equal(made["observation.mood"][:, 1], lamp)
    # A commanded opening comes before the measured one.
    commanded = 1 + 0.08 - 0.002 * phase
    np.testing.assert_allclose(case.columns.gripper(0, phase), commanded, atol=1e-6)


def test_another_arm_puts_its_joints_in_the_place_of_the_demonstrated_ones(case):
    six = arm("ur5e")
    rng = np.random.default_rng(0)
    q = six.ready.numpy() + 0.1 * rng.standard_normal((FRAMES, 6))
    phase = np.arange(FRAMES, dtype=float)
    made = case.other.values(0, phase, q, q + 0.02, None, {})
    features, before = case.other.features, case.columns.features
    old, new = (f["observation.state"]["names"] for f in (before, features))
    assert features["observation.state"]["shape"] == [len(new)] == [len(old) - 2]
    assert new[:6] == [f"{name}.pos" for name in six.joint_names]
    assert new[6] == old[7]
    assert new[7:13] == [f"{name}.vel" for name in six.joint_names]
    assert new[13:] == old[15:]
    assert features["action"]["names"] == [f"{name}.pos" for name in six.joint_names]
    state = made["observation.state"]
    np.testing.assert_allclose(state[:, :6], q)
    np.testing.assert_allclose(state[:, 7:13], np.gradient(q, TIME, axis=0))
    np.testing.assert_allclose(made["action"], q + 0.02)
    tool = six.forward(torch.from_numpy(q)).position.numpy()
    np.testing.assert_allclose(state[:, 13:16], tool)
    np.testing.assert_allclose(made["action.tool"][:-1, :3], tool[1:])
    np.testing.assert_allclose(made["action.tool"][-1, :3], tool[-1])
    np.testing.assert_allclose(state[:, 6], on_disk(case, 0)["observation.state"][:, 7])


@pytest.mark.parametrize("count", [3, 6, 7])
def test_a_pose_is_a_position_with_a_rotation_vector_or_a_quaternion(count):
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    q = 2 * turn.as_quat(scalar_first=True)
    turned = {3: [], 6: turn.as_rotvec(), 7: q}[count]
    pose = pose_of(torch.tensor(np.array([[1.0, 2.0, 3.0, *turned]])))
    np.testing.assert_allclose(pose.position, [[1, 2, 3]])
    expected = [1, 0, 0, 0] if count == 3 else q / 2
    np.testing.assert_allclose(pose.orientation[0], expected, atol=1e-12)


@pytest.mark.parametrize("columns", ["observation.cup[0:2]", "observation.block[0:4]"])
def test_objects_of_other_numbers_of_columns_are_refused(case, columns):
    taught = arm_of_dataset(case.source)
    with pytest.raises(ValueError, match=r"objects\.cup\.columns=.* must have 3, 6 or 7"):
        MultipliedColumns(case.source, taught, panda, {"cup": columns})


def test_changes_of_the_tool_pose_are_no_commands_of_poses(tmp_path):
    q = joints(0)
    place = panda.forward(torch.from_numpy(q)).position.numpy()
    steps = np.diff(place, axis=0, append=place[-1:])
    features = {"action.tool": TOOL[:3]}
    with DatasetWriter(tmp_path / "set", FPS, "panda", panda.joint_names, features) as writer:
        writer.start_episode("go")
        for k in range(FRAMES):
            writer.add_frame(
                joint_position=q[k], position=place[k], **{"action.tool": steps[k]}
            )
        writer.save_episode()
    source = open_demos(tmp_path / "set")
    with pytest.raises(ValueError, match=r"action.tool \(ee.x\) holds changes, not commanded"):
        MultipliedColumns(source, arm_of_dataset(source), panda, {})


FIRST, LAST = 6, 18
"""Frames between which the tool carries a box."""


@pytest.fixture(scope="module")
def carried(tmp_path_factory):
    """Columns of a demonstration that carries a box.

    The opening of its gripper counts the other way: 1 is closed.
    """
    folder = tmp_path_factory.mktemp("carried") / "demos"
    boxes = {
        f"observation.{name}": tuple(
            f"{name}.{a}" for a in ("x", "y", "z", "qw", "qx", "qy", "qz")
        )
        for name in ("box", "other")
    }
    q = joints(0)
    tool = panda.forward(torch.from_numpy(q))
    path = box_path(tool)
    with DatasetWriter(folder, FPS, "panda", panda.joint_names, boxes) as writer:
        writer.start_episode("carry")
        for k in range(FRAMES):
            writer.add_frame(
                joint_position=q[k],
                command_position=q[k],
                gripper=float(FIRST <= k < LAST),
                **{
                    "observation.box": path[k],
                    "observation.other": BLOCK,
                },
            )
        writer.save_episode()
    source = open_demos(folder)
    taught = arm_of_dataset(source)
    return MultipliedColumns(source, taught, panda, {})


def box_path(tool):
    """Pose of a box that slides by 1 mm a frame in the hand that carries it."""
    still = torch.tensor([0.0, 0.0, 1.0, 0.0]).double()
    grip = Pose(torch.tensor([0.01, 0.0, 0.1]).double(), still)
    path = []
    for k in range(FRAMES):
        n = min(max(k, FIRST), LAST)
        slid = Pose(
            torch.tensor([0.001 * (n - FIRST), 0, 0]).double(),
            quaternion.exp(torch.zeros(3).double()),
        )
        pose = tool[n] @ grip @ slid
        path.append(torch.cat([pose.position, pose.orientation]).numpy())
    return np.stack(path)


@pytest.fixture(scope="module")
def leads(tmp_path_factory):
    """Columns of demonstrations whose arm lags three frames behind commands, and sags."""
    folder = tmp_path_factory.mktemp("leads") / "demos"
    features = {"action.tool": TOOL}
    with DatasetWriter(folder, FPS, "panda", panda.joint_names, features) as writer:
        for episode in range(2):
            q = joints(episode)
            tool = panda.forward(torch.from_numpy(q))
            vector = quaternion.log(quaternion.continuous(tool.orientation)).numpy()
            place = np.concatenate([tool.position.numpy(), vector], axis=1)
            writer.start_episode("go")
            for k in range(FRAMES):
                writer.add_frame(
                    joint_position=q[k],
                    command_position=ahead(q)[k],
                    position=place[k, :3],
                    orientation=tool.orientation[k].numpy(),
                    **{"action.tool": ahead(place)[k] + RAISED},
                )
            writer.save_episode()
    source = open_demos(folder)
    return MultipliedColumns(source, arm_of_dataset(source), panda, {})


RAISED = np.array([0.0, 0.0, 0.005, 0.0, 0.0, 0.0])


def ahead(x, frames=3):
    return x[np.arange(frames, len(x) + frames).clip(max=len(x) - 1)]


def test_commands_lead_new_motions_as_the_demonstrated_ones(leads):
    own = leads
    slow = np.stack(
        [np.interp(np.arange(0, FRAMES - 0.6, 0.5), np.arange(FRAMES), x) for x in joints(0).T],
        axis=1,
    )
    phase = np.arange(len(slow)) / 2
    made = own.values(0, phase, slow, slow, None, {})
    tool = panda.forward(torch.from_numpy(slow))
    np.testing.assert_allclose(
        made["action.tool"][:, :3], ahead(tool.position.numpy()) + RAISED[:3], atol=1e-4
    )
    turns = [Rotation.from_rotvec(v) for v in made["action.tool"][:, 3:]]
    for k in (0, 10, len(turns) - 1):
        there = tool.orientation[min(k + 3, len(slow) - 1)].numpy()
        apart = turns[k] * Rotation.from_quat(there, scalar_first=True).inv()
        assert apart.magnitude() < 1e-5


def test_an_object_moves_with_the_tool_where_the_demonstrated_one_did(carried):
    shown = box_path(panda.forward(torch.from_numpy(joints(0))))
    scene = {"box": shown[0], "other": BLOCK, "goal": BLOCK}
    again = NewMotion(
        joints=torch.from_numpy(joints(0)),
        phase=torch.arange(FRAMES).double(),
        source=0,
        reason="",
    )
    made = carried.object_paths(again, scene)
    np.testing.assert_allclose(made["box"], shown, atol=2e-3)
    np.testing.assert_allclose(made["other"], still(BLOCK), atol=1e-6)
    np.testing.assert_array_equal(made["goal"], still(BLOCK))


def test_departures_are_the_last_frames_at_rest(carried):
    """Of the box, which is carried, and of another object, which stays."""
    assert carried.departures() == [[FIRST, FRAMES - 1]]


def test_an_object_that_settles_first_departs_later():
    """As in simulations that drop an object by a few millimetres at the start."""
    height = np.full(40, 0.1)
    height[:3] = [0.104, 0.103, 0.1015]
    height[25:] += 0.002 * np.arange(1, 16)
    path = torch.from_numpy(np.stack([np.zeros(40), np.zeros(40), height], axis=1))
    assert _departure(path) == 24
    # An object that moves slowly from the start departs from its first position.
    drift = torch.zeros(40, 3).double()
    drift[:, 0] = 0.02 * torch.linspace(0, 1, 40) ** 2
    assert _departure(drift) == int((drift[:, 0] <= 1e-3).nonzero().max())


def test_an_object_moves_with_the_tool_elsewhere_and_more_slowly(carried):
    phase = np.arange(0, FRAMES - 0.6, 0.5)
    q = np.stack([np.interp(phase, np.arange(FRAMES), x) for x in joints(0).T], axis=1)
    q[:, 0] += 0.5  # all turns about the axis of the first joint
    turn = Rotation.from_euler("z", 0.5)
    shown = box_path(panda.forward(torch.from_numpy(joints(0))))
    first = seven(
        turn.apply(shown[0, :3]), turn * Rotation.from_quat(shown[0, 3:], scalar_first=True)
    )
    slow = NewMotion(
        joints=torch.from_numpy(q), phase=torch.from_numpy(phase), source=0, reason=""
    )
    made = carried.object_paths(slow, {"box": first})["box"]
    np.testing.assert_allclose(made[::2, :3], turn.apply(shown[:, :3]), atol=2e-3)
    np.testing.assert_array_equal(made[: 2 * FIRST - 2], [first] * (2 * FIRST - 2))
    assert np.ptp(made[2 * LAST + 2 :], axis=0).max() == 0
    assert np.ptp(made[:, :3], axis=0).max() > 0.01


@pytest.fixture(scope="module")
def grips(tmp_path_factory):
    """Columns of a demonstration whose gripper follows its command after three frames."""
    folder = tmp_path_factory.mktemp("grips") / "demos"
    features = {"action.hand": ("gripper.pos",)}
    command = np.isin(np.arange(FRAMES), range(8, 22)).astype(float)
    with DatasetWriter(folder, FPS, "panda", panda.joint_names, features) as writer:
        writer.start_episode("grip")
        for k, q in enumerate(joints(0)):
            writer.add_frame(
                joint_position=q,
                gripper=command[max(k - 3, 0)],
                **{"action.hand": command[[k]].tolist()},
            )
        writer.save_episode()
    source = open_demos(folder)
    return MultipliedColumns(source, arm_of_dataset(source), panda, {})


@pytest.mark.parametrize(
    ("step", "closes", "opens"), [(1.0, 8, 22), (0.5, 18, 45), (2.0, 3, 11)]
)
def test_the_gripper_keeps_its_own_speed(grips, step, closes, opens):
    """In a slower motion, it closes as long before the frame in which it is to be closed."""
    phase = np.arange(0, FRAMES - 0.9, step)
    q = np.stack([np.interp(phase, np.arange(FRAMES), x) for x in joints(0).T], axis=1)
    made = grips.values(0, phase, q, q, None, {})["action.hand"][:, 0]
    (changed,) = np.diff(made).nonzero()
    assert [*(changed + 1)] == [closes, opens]
    np.testing.assert_array_equal(grips.gripper(0, phase), made)
