"""Quantities that the arrays of a recording hold: units, poses, commands and grippers."""

from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import joint_path
from recording_samples import TIME, TURN, Q, plan, read, write_hdf5
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_names import ImportOptions


def test_transforms_are_poses_and_those_of_a_camera_are_not(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURN.as_matrix(), Q
    np.savez(tmp_path / "a.npz", poses=poses, camera_extrinsics=poses, t=TIME)
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)
    expected = TURN.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demo.orientation * expected).sum(1)), 1)
    assert "camera_extrinsics" in plan(tmp_path / "a.npz").meaning.left_out


@pytest.mark.parametrize(("name", "shape"), [("H", (40, 4, 4)), ("hand_pose", (40, 16))])
def test_transforms_are_known_by_their_shape_or_by_sixteen_numbers_of_a_pose(
    tmp_path, name, shape
):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = Q
    np.savez(tmp_path / "a.npz", **{name: poses.reshape(shape), "t": TIME})
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)


def test_slower_sensors_hold_their_last_value_and_know_no_future(tmp_path):
    time, slow = np.arange(100) / 100, np.arange(12) / 10 - 0.05
    write_hdf5(
        tmp_path / "run.h5",
        {
            "robot/time": time + 5,
            "robot/q": joint_path(100),
            "tool/time": slow + 5,
            "tool/gripper": 0.001 * np.arange(12),
            "camera/stamps": slow[::2] + 5,
            "camera/image": np.zeros((6, 32, 32, 3), np.uint8),
        },
    )
    (one,) = plan(tmp_path / "run.h5").episodes()
    expected = np.floor((time + 0.05) * 10 + 1e-9)
    np.testing.assert_allclose(one.demonstration.gripper, 0.001 * expected)
    np.testing.assert_array_equal(one.images["image"][1], np.floor((time + 0.05) * 5 + 1e-9))


def test_frames_before_a_sensor_speaks_are_cut_and_a_silent_one_is_named(tmp_path):
    time = np.arange(200) / 100
    arrays = {"robot/time": time, "robot/q": joint_path(200), "tool/time": time[50::5]}
    arrays["tool/gripper"] = np.full(30, 0.01)
    write_hdf5(tmp_path / "late.h5", arrays)
    (one,) = plan(tmp_path / "late.h5").episodes()
    assert len(one.demonstration) == 150
    assert "50 frames without tool/gripper are cut" in one.notes[0]
    arrays["tool/time"] = np.concatenate([time[:50:5], time[100::5]])
    write_hdf5(tmp_path / "gap.h5", arrays)
    with pytest.raises(DatasetError, match=r"gap.h5, tool/gripper|silent for too long at"):
        list(plan(tmp_path / "gap.h5").episodes())


def test_a_unit_that_the_file_declares_counts(tmp_path):
    write_hdf5(tmp_path / "run.h5", {"q": Q, "t": TIME}, {"q": {"units": "degrees"}})
    (demo,) = read(tmp_path / "run.h5")
    np.testing.assert_allclose(demo.joint_position, np.deg2rad(Q))


def test_large_values_are_no_radians(tmp_path):
    np.savez(tmp_path / "a.npz", q=np.rad2deg(Q), t=TIME)
    made = plan(tmp_path / "a.npz")
    np.testing.assert_allclose(next(made.episodes()).demonstration.joint_position, Q)
    assert "taken for deg" in made.meaning.warnings[0]
    said = plan(tmp_path / "a.npz", units={"joint_position": "rad"})
    assert "degrees?" in said.meaning.warnings[0]


def test_six_numbers_of_a_pose_do_not_tell_their_angles(tmp_path):
    np.savez(tmp_path / "a.npz", tcp_pose=0.1 * joint_path(40, 6), t=TIME)
    made = plan(tmp_path / "a.npz")
    assert next(made.episodes()).demonstration.orientation is None
    assert "euler_xyz" in made.meaning.left_out["tcp_pose[3:6]"]


def test_an_array_without_names_that_holds_quaternions_is_asked_about(tmp_path):
    np.save(tmp_path / "a.npy", np.hstack([Q, TURN.as_quat()]))
    with pytest.raises(DatasetError, match="unit length, as a quaternion has"):
        plan(tmp_path / "a.npy", fps=10)


def test_lengths_in_cm_or_mm_are_asked_about(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = 40 * (0.3 + 0.1 * Q)
    np.savez(tmp_path / "a.npz", eef_pos=poses[:, :3, 3], t=TIME)
    np.savez(tmp_path / "b.npz", tcp_pose=poses, t=TIME)
    for path, role in ((tmp_path / "a.npz", "position"), (tmp_path / "b.npz", "pose_matrix")):
        with pytest.raises(DatasetError, match=f"doubtful.*--units {role} mm"):
            plan(path)
        (demo,) = read(path, units={role: "mm"})
        np.testing.assert_allclose(demo.position, 1e-3 * poses[:, :3, 3])


@pytest.mark.parametrize("scale", [0.04, 1.0])
def test_a_gripper_at_the_end_of_the_joints_is_asked_about(tmp_path, scale):
    opening = scale * (np.arange(40) > 20)
    two = np.column_stack([joint_path(40, 7), *[0.02 + 0.02 * Q[:, 0] ** 2] * 2])
    one = np.column_stack([joint_path(40, 6), opening])
    for name, values, columns in (("two", two, "[7:9]"), ("one", one, "[6:7]")):
        np.savez(tmp_path / f"{name}.npz", qpos=values, t=TIME)
        try:
            (said,) = plan(tmp_path / f"{name}.npz").meaning.warnings
        except DatasetError as error:  # a column of some centimetres is no joint in rad
            said = str(error)
        assert f"--gripper qpos{columns}" in said
    np.savez(tmp_path / "arm.npz", qpos=joint_path(40, 7), t=TIME)
    assert not plan(tmp_path / "arm.npz").meaning.warnings


def test_the_order_of_a_quaternion_without_names_is_asked_about(tmp_path):
    pose = np.hstack([Q, TURN.as_quat()])
    np.savez(tmp_path / "a.npz", tcp_pose=pose, t=TIME)
    made = plan(tmp_path / "a.npz")
    assert next(made.episodes()).demonstration.orientation is None
    assert "quaternion_wxyz or" in made.meaning.left_out["tcp_pose[3:7]"]
    columns = {"position": "tcp_pose[0:3]", "quaternion_xyzw": "tcp_pose[3:7]"}
    (demo,) = read(tmp_path / "a.npz", columns=columns)
    expected = TURN.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demo.orientation * expected).sum(1)), 1)


def test_a_table_of_lerobot_has_joints_commands_and_grippers(tmp_path):
    names = ("shoulder", "elbow", "gripper")
    head = [f"{kind}.{n}.pos" for kind in ("observation.state", "action") for n in names]
    rows = np.column_stack([TIME, joint_path(40, 2), TIME, joint_path(40, 2) + 0.01, 2 * TIME])
    np.savetxt(
        tmp_path / "a.csv", rows, delimiter=",", header="t," + ",".join(head), comments=""
    )
    made = plan(tmp_path / "a.csv")
    (one,) = made.episodes()
    assert one.demonstration.joint_names == names[:2]
    np.testing.assert_allclose(one.demonstration.gripper, TIME)
    np.testing.assert_allclose(one.demonstration.command_position, joint_path(40, 2) + 0.01)
    assert made.meaning.kept["action"][1] == ("gripper.pos",)
    assert "no commands were recorded" not in "\n".join(made.lines())
    # The same table without its commands.
    text = "t," + ",".join(head[:3])
    np.savetxt(tmp_path / "b.csv", rows[:, :4], delimiter=",", header=text, comments="")
    bare = plan(tmp_path / "b.csv")
    for actions, made_of in ((True, "next states are the actions"), (False, "has no actions")):
        assert made_of in "\n".join(bare.lines(actions))


def test_rx_ry_rz_may_be_angles(tmp_path):
    rows = np.column_stack([TIME, Q, 0.1 * Q])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y,z,rx,ry,rz", comments="")
    assert "euler_xyz" in " ".join(plan(tmp_path / "a.csv").meaning.notes)


def test_cameras_are_named_by_the_end_of_their_path_or_left_out(tmp_path):
    frames = np.zeros((40, 32, 48, 3), np.uint8)
    write_hdf5(tmp_path / "a.h5", {"q": Q, "t": TIME, "obs/top": frames, "obs/side": frames})
    made = plan(tmp_path / "a.h5", images={"front": "top"})
    assert made.meaning.cameras == {"front": "obs/top"}
    assert "obs/side" in made.meaning.left_out
    with pytest.raises(
        DatasetError, match="no column 'back' for front; there are features obs"
    ):
        plan(tmp_path / "a.h5", images={"front": "back"})
    with pytest.raises(DatasetError, match="q holds no images"):
        plan(tmp_path / "a.h5", images={"front": "q"})


def test_a_topic_of_ros_as_a_table(tmp_path):
    head = "%time," + ",".join(
        f"field.{n}{k}" for n in ("position", "velocity") for k in range(3)
    )
    rows = [[int(1.7e18 + 1e7 * k), *q, *q] for k, q in enumerate(Q.tolist())]
    lines = [head, *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "joint_states.csv").write_text("\n".join(lines))
    (demo,) = read(tmp_path / "joint_states.csv")
    np.testing.assert_allclose(demo.joint_position, Q)
    np.testing.assert_allclose(demo.joint_velocity, Q)
    np.testing.assert_allclose(np.diff(demo.time), 0.01, atol=1e-6)


def test_the_last_observation_may_have_no_action(tmp_path):
    """Of n + 1 states and n actions, the last action counts for two."""
    np.savez(tmp_path / "a.npz", qpos=Q, actions=Q[1:])
    (one,) = plan(tmp_path / "a.npz", fps=10).episodes()
    expected = np.concatenate([Q[1:], Q[-1:]])
    np.testing.assert_array_equal(one.demonstration.command_position, expected)


def test_transforms_of_three_rows_are_poses(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURN.as_matrix(), Q
    np.savez(tmp_path / "a.npz", ee_pose=poses[:, :3], t=TIME)
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)
    turned = Rotation.from_quat(demo.orientation, scalar_first=True)
    assert (turned * TURN.inv()).magnitude().max() < 1e-9


def test_commands_that_joints_do_not_follow_are_kept_as_recorded(tmp_path):
    away = np.random.default_rng(1).uniform(-1, 1, Q.shape)
    columns = {f"joint_{k}": Q[:, k] for k in range(3)}
    columns |= {f"target_joint_{k}": away[:, k] for k in range(3)}
    header = ",".join(["time", *columns])
    rows = np.column_stack([TIME, *columns.values()])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="")
    made = plan(tmp_path / "a.csv")
    (one,) = made.episodes()
    assert one.demonstration.command_position is None
    np.testing.assert_allclose(one.demonstration.extra["action"], away)
    assert any("do not follow the recorded action" in note for note in made.meaning.notes)


@pytest.mark.parametrize("clock", ["stamps", "fps", "duration", "file"])
def test_joints_follow_their_commands_at_any_rate(tmp_path, clock):
    """A delay of 0.1 s is that of an arm, at 20 Hz and at 400 Hz."""
    for rate in (20, 400):
        time = np.arange(4 * rate) / rate
        path = lambda t: np.sin(2.5 * t[:, None] + np.arange(3)) + 0.3 * np.sin(9 * t)[:, None]  # noqa: E731
        arrays = {"qpos": path(time), "action": path(time + 0.1)}
        options = {"fps": rate} if clock == "fps" else {}
        options |= {"duration": time[-1]} if clock == "duration" else {}
        arrays |= {"t": time} if clock == "stamps" else {}
        arrays |= {"fps": rate} if clock == "file" else {}
        np.savez(tmp_path / "a.npz", **arrays)
        (one,) = plan(tmp_path / "a.npz", **options).episodes()
        np.testing.assert_array_equal(one.demonstration.command_position, arrays["action"])
        arrays["action"] = path(time - 0.4)  # what came first was no command
        np.savez(tmp_path / "a.npz", **arrays)
        (one,) = plan(tmp_path / "a.npz", **options).episodes()
        assert one.demonstration.command_position is None


@pytest.mark.parametrize(
    "other",
    [
        {"q": Q, "t": TIME},  # another name
        {"qpos": Q},  # no stamps
        {"qpos": Q, "action": np.c_[Q, TIME], "t": TIME},  # another width
        {"qpos": Q, "action": Q[:, :2], "t": TIME},
    ],
)
def test_recordings_whose_fields_differ_do_not_mix(tmp_path, other):
    first = {"qpos": Q, "t": TIME} | ({"action": Q} if "action" in other else {})
    np.savez(tmp_path / "run_0.npz", **first)
    np.savez(tmp_path / "run_1.npz", **other)
    with pytest.raises(
        ValueError, match=r"run_1.* and .*run_0.npz do not fit into one dataset: fields "
    ):
        plan(tmp_path)


def test_commands_of_another_time_than_the_joints_are_named():
    fields = {}
    for topic, start in (("states", 0.0), ("command", 100.0)):
        name, stamp = f"{topic}/joint_positions", f"{topic}/stamp"
        fields[name] = array_field(name, Q, names=("a", "b", "c"), clock=stamp)
        fields[stamp] = array_field(stamp, start + TIME, unit="s")
    one = Recording(file=Path("run.bag"), fields=fields, streams=True)
    text = "the clocks of command/joint_positions and of states/joint_positions do not overlap"
    with pytest.raises(DatasetError, match=text):
        understand([one], ImportOptions())


def test_joint_velocities_of_other_joints_are_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", qpos=Q, qvel=Q[:, :2], t=TIME)
    columns = {"joint_position": "qpos", "joint_velocity": "qvel"}
    made = plan(tmp_path / "a.npz", columns=columns)
    (one,) = made.episodes()
    assert one.demonstration.joint_velocity is None
    assert made.meaning.left_out["qvel"] == "2 columns for 3 joints"
