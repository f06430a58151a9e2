"""Every version and naming convention reads into the same demonstrations."""

import json
import os

import numpy as np
import pyarrow as pa
import pytest
from lerobot_folders import FPS, joint_path, read_info, rewrite, write_folder, write_info
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.demos import (
    DatasetError,
    UnitsWarning,
    check_dataset,
    load_demos,
    open_demos,
)

panda = [f"panda_joint{i}" for i in range(1, 4)]
STATE = "observation.state"


def two_episodes(**columns):
    """Two episodes of these columns; each column is a function of the joint motion."""
    motions = [joint_path(60, seed=0), joint_path(45, seed=1)]
    return motions, [{key: make(q) for key, make in columns.items()} for q in motions]


def damaged(number: np.ndarray, last: float) -> np.ndarray:
    """Nine frames of the same numbers; the last one of frame 3 is another."""
    values = np.tile(number.ravel(), (9, 1))
    values[3, -1] = last
    return values


@pytest.mark.parametrize("version", ["v3.0", "v2.1", "v2.0"])
@pytest.mark.parametrize("ragged_lists", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_versions_and_column_types_read_alike(tmp_path, version, ragged_lists, dtype):
    motions, episodes = two_episodes(**{STATE: lambda q: q})
    root = write_folder(
        tmp_path / "set",
        episodes,
        {STATE: [f"{j}.pos" for j in panda]},
        version=version,
        ragged_lists=ragged_lists,
        dtype=dtype,
        tasks=("reach", "place"),
    )
    demos = load_demos(root)
    assert [demo.task for demo in demos] == ["reach", "place"]
    assert demos.joint_names == tuple(panda)
    for demo, q in zip(demos, motions, strict=True):
        np.testing.assert_allclose(demo.joint_position, q, atol=1e-6)
        np.testing.assert_array_equal(demo.time, np.arange(len(q)) / FPS)


@pytest.mark.parametrize(
    "names",
    [
        panda,
        {"axes": panda},
        {"motors": panda},
        {"joints": panda},
        [panda],
        [f"{j}.pos" for j in panda],
        [f"{j}.obs_pos" for j in panda],
    ],
)
def test_names_in_every_nesting(tmp_path, names):
    motions, episodes = two_episodes(**{STATE: lambda q: q})
    demos = load_demos(write_folder(tmp_path / "set", episodes, {STATE: names}))
    assert demos.joint_names == tuple(panda)
    np.testing.assert_allclose(demos[1].joint_position, motions[1], atol=1e-6)


def test_columns_without_names_are_numbered_joints_and_said_so(tmp_path):
    _, episodes = two_episodes(state=lambda q: q, actions=lambda q: q + 0.1)
    demos = load_demos(write_folder(tmp_path / "set", episodes, {}))
    assert demos.joint_names == ("joint_1", "joint_2", "joint_3")
    assert demos[0].command_position is not None
    assert any("names no components" in note for note in demos.notes)


def test_lerobot_record_convention(tmp_path):
    names = [
        *(f"joint_{i}.pos" for i in range(3)),
        *(f"joint_{i}.vel" for i in range(3)),
        *(f"joint_{i}.torque" for i in range(3)),
        "gripper.pos",
        *("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"),
    ]
    motions, episodes = two_episodes(
        **{
            STATE: lambda q: np.hstack([q, 2 * q, 3 * q, q[:, :1], q / 2, q / 3]),
            "action": lambda q: np.hstack([q + 1, q[:, :1]]),
        }
    )
    command = [*(f"joint_{i}.pos" for i in range(3)), "gripper.pos"]
    demo = load_demos(
        write_folder(tmp_path / "set", episodes, {STATE: names, "action": command})
    )[0]
    q = motions[0]
    np.testing.assert_allclose(demo.joint_velocity, 2 * q, atol=1e-6)
    np.testing.assert_allclose(demo.joint_effort, 3 * q, atol=1e-6)
    np.testing.assert_allclose(demo.gripper, q[:, 0], atol=1e-6)
    np.testing.assert_allclose(demo.position, q / 2, atol=1e-6)
    np.testing.assert_allclose(demo.command_position, q + 1, atol=1e-6)
    assert_same_rotation(demo.orientation, Rotation.from_rotvec(q / 3))


def test_franka_plug_in_convention_with_libfranka_columns(tmp_path):
    names = [f"joint_{i}.pos" for i in range(3)] + [f"ee_pose.{i:02d}" for i in range(16)]
    motions, episodes = two_episodes(**{STATE: lambda q: np.hstack([q, transforms(q, "F")])})
    demo = load_demos(write_folder(tmp_path / "set", episodes, {STATE: names}))[0]
    np.testing.assert_allclose(demo.position, motions[0] / 2, atol=1e-6)
    assert_same_rotation(demo.orientation, Rotation.from_rotvec(motions[0]))


def test_aloha_convention(tmp_path):
    motions, episodes = two_episodes(
        **{
            STATE: lambda q: q,
            "observation.velocity": lambda q: 2 * q,
            "observation.effort": lambda q: 3 * q,
            "action": lambda q: q + 0.1,
        }
    )
    names = {STATE: ["waist", "shoulder", "elbow"], "action": ["waist", "shoulder", "elbow"]}
    demo = load_demos(write_folder(tmp_path / "set", episodes, names))[0]
    assert demo.joint_names == ("waist", "shoulder", "elbow")
    np.testing.assert_allclose(demo.joint_velocity, 2 * motions[0], atol=1e-6)
    np.testing.assert_allclose(demo.joint_effort, 3 * motions[0], atol=1e-6)
    np.testing.assert_allclose(demo.command_position, motions[0] + 0.1, atol=1e-6)


def test_droid_convention(tmp_path):
    motions, episodes = two_episodes(
        **{
            STATE: lambda q: np.hstack([q, q[:, :1]]),
            f"{STATE}.joint_position": lambda q: q,
            f"{STATE}.cartesian_position": lambda q: np.hstack([q / 2, q]),
            f"{STATE}.gripper_position": lambda q: q[:, :1],
            "action.joint_velocity": lambda q: 3 * q,
            "action.cartesian_position": lambda q: np.hstack([q, q]),
            "camera_extrinsics.wrist": lambda q: np.hstack([q, q]),
        }
    )
    joints = ["joint_0", "joint_1", "joint_2"]
    names = {
        STATE: {"axes": [*joints, "gripper"]},
        f"{STATE}.joint_position": {"axes": joints},
        f"{STATE}.cartesian_position": {"axes": ["x", "y", "z", "roll", "pitch", "yaw"]},
        f"{STATE}.gripper_position": {"axes": ["gripper"]},
        "action.joint_velocity": {"axes": joints},
    }
    demo = load_demos(write_folder(tmp_path / "set", episodes, names))[0]
    q = motions[0]
    np.testing.assert_allclose(demo.joint_position, q, atol=1e-6)
    np.testing.assert_allclose(demo.gripper, q[:, 0], atol=1e-6)
    np.testing.assert_allclose(demo.position, q / 2, atol=1e-6)
    np.testing.assert_allclose(demo.command_velocity, 3 * q, atol=1e-6)
    assert_same_rotation(demo.orientation, Rotation.from_euler("xyz", q))
    assert "camera_extrinsics.wrist" in demo.extra


@pytest.mark.parametrize(
    ("names", "encode"),
    [
        (["ee.qx", "ee.qy", "ee.qz", "ee.qw"], lambda r: r.as_quat()),
        (["qw", "qx", "qy", "qz"], lambda r: r.as_quat(scalar_first=True)),
        (["ee.wx", "ee.wy", "ee.wz"], lambda r: r.as_rotvec()),
        (["roll", "pitch", "yaw"], lambda r: r.as_euler("xyz")),
        (["eef_euler_x", "eef_euler_y", "eef_euler_z"], lambda r: r.as_euler("xyz")),
        (["eef_quat_x", "eef_quat_y", "eef_quat_z", "eef_quat_w"], lambda r: r.as_quat()),
        ([f"ee.rot6d_{i}" for i in range(6)], lambda r: two_columns(r)),
    ],
)
def test_orientations_turn_continuous_in_every_encoding(tmp_path, names, encode):
    # A turn by 400 degrees: every encoding wraps or changes sign on the way.
    turn = Rotation.from_rotvec(np.linspace(0.1, 7, 80)[:, None] * np.array([0.6, 0.0, 0.8]))
    columns = np.hstack([np.zeros((80, 3)), encode(turn)])
    root = write_folder(
        tmp_path / "set", [{STATE: columns}], {STATE: ["x", "y", "z", *names]}, dtype="float64"
    )
    orientation = load_demos(root)[0].orientation
    assert_same_rotation(orientation, turn)
    assert np.abs(np.diff(orientation, axis=0)).max() < 0.1


@pytest.mark.parametrize(
    ("role", "encode"),
    [
        ("quaternion_wxyz", lambda r: r.as_quat(scalar_first=True)),
        ("quaternion_xyzw", lambda r: r.as_quat()),
        ("rotation_vector", lambda r: r.as_rotvec()),
        ("euler_xyz", lambda r: r.as_euler("xyz")),
        ("euler_intrinsic_xyz", lambda r: r.as_euler("XYZ")),
        ("rotation_6d", lambda r: 3 * two_columns(r)),
        ("rotation_matrix", lambda r: r.as_matrix().reshape(-1, 9)),
    ],
)
def test_orientations_are_mapped_in_every_encoding(tmp_path, role, encode):
    turn = Rotation.from_rotvec(joint_path(50, seed=4))
    episode = {STATE: joint_path(50), "observation.tool": encode(turn)}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    demo = load_demos(root, mapping={role: "observation.tool"})[0]
    assert_same_rotation(demo.orientation, turn)


@pytest.mark.parametrize(
    ("role", "columns", "fault"),
    [
        ("rotation_6d", np.ones((9, 6)), "frame 0 span no plane"),
        ("rotation_matrix", damaged(np.eye(3), 1.01), "frame 3 are no rotation matrix"),
        ("rotation_matrix", damaged(np.eye(3), -1.0), "frame 3 are no rotation matrix"),
        (
            "pose_matrix",
            np.tile(np.diag([1, 1, -1, 1]).ravel(), (9, 1)),
            "frame 0 are no rotation",
        ),
        ("pose_matrix", damaged(np.eye(4), 1.001), "16 numbers are no 4x4 transform"),
        ("quaternion_xyzw", damaged(np.eye(4)[-1], 1.2), "frame 3"),
    ],
)
def test_columns_that_are_no_rotation_are_told(tmp_path, role, columns, fault):
    episode = {STATE: joint_path(9), "observation.tool": columns}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    # The check of a sequence's type would read its first item.
    with shapes_unchecked(), pytest.raises(DatasetError, match=fault) as raised:
        load_demos(root, mapping={role: "observation.tool"})
    assert raised.value.key == role


@pytest.mark.parametrize(
    ("role", "number", "last"),
    [("rotation_matrix", np.eye(3), 1.004), ("pose_matrix", np.eye(4), 1 + 5e-5)],
)
def test_rounded_digits_are_no_damage(tmp_path, role, number, last):
    episode = {STATE: joint_path(9), "observation.tool": damaged(number, last)}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    (demo,) = load_demos(root, mapping={role: "observation.tool"})
    assert demo.orientation is not None
    np.testing.assert_allclose(demo.orientation[3], [1, 0, 0, 0], atol=1e-2)


def test_a_feature_that_was_not_seen_need_not_be_a_number(tmp_path):
    pixels = 100 * np.ones((9, 3))
    pixels[:, 2] = 1
    pixels[4] = [np.nan, np.nan, 0]
    episode = {STATE: joint_path(9), "observation.marker": pixels}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    mapping = {
        "feature": "observation.marker[0:2]",
        "feature_visible": "observation.marker[2:3]",
    }
    (demo,) = load_demos(root, mapping=mapping)
    assert demo.feature_visible is not None
    assert np.flatnonzero(~demo.feature_visible).tolist() == [4]
    np.testing.assert_array_equal(np.delete(demo.feature, 4, axis=0), 100)
    assert demo.feature[4].tolist() == [0, 0]
    pixels[5, 1] = np.nan
    episode["observation.marker"] = pixels
    root = write_folder(tmp_path / "bad", [episode], {STATE: panda}, dtype="float64")
    with pytest.raises(DatasetError, match="feature is nan there") as raised:
        load_demos(root, mapping=mapping)
    assert (raised.value.frame, raised.value.key) == (5, "observation.marker (joint_2)")


def test_columns_of_tensors_are_read_like_lists(tmp_path):
    """Hugging Face's datasets keep arrays as an extension type of Arrow."""
    q = joint_path(60)
    root = write_folder(tmp_path / "set", [{STATE: q}], {STATE: panda})
    tensors = pa.FixedShapeTensorArray.from_numpy_ndarray(q[:, None, :])

    def as_tensors(table):
        return table.set_column(table.schema.get_field_index(STATE), STATE, tensors)

    rewrite(root / "data/chunk-000/file-000.parquet", as_tensors)
    np.testing.assert_array_equal(load_demos(root)[0].joint_position, q)


def test_the_hubs_cache_links_out_of_the_dataset(tmp_path):
    """Files are links to blobs next to the snapshots, which are no foreign place."""
    q = joint_path(60)
    root = write_folder(tmp_path / "hub" / "snapshots" / "1f", [{STATE: q}], {STATE: panda})
    data = root / "data/chunk-000/file-000.parquet"
    for name in ("blobs", "elsewhere"):
        blob = tmp_path / "hub" / name / "a0"
        blob.parent.mkdir()
        data.rename(blob)
        data.symlink_to(blob)
        if name == "blobs":
            np.testing.assert_allclose(load_demos(root)[0].joint_position, q, atol=1e-6)
            data = blob
    with pytest.raises(DatasetError, match="leads out of the dataset"):
        load_demos(root)


def test_a_task_is_found_by_its_number_where_episodes_name_none(tmp_path):
    root = write_folder(
        tmp_path / "set",
        [{STATE: joint_path()}] * 2,
        {STATE: panda},
        tasks=("a", "b"),
        version="v2.1",
    )
    listed = [{"episode_index": k, "length": 60} for k in range(2)]
    text = "".join(json.dumps(line) + "\n" for line in listed)
    (root / "meta/episodes.jsonl").write_text(text)
    source = open_demos(root)
    assert [demo.task for demo in source] == ["a", "b"]
    assert repr(source).endswith(
        "2 demonstrations, 120 frames, joints: panda_joint1, panda_joint2, panda_joint3)"
    )


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda root: rewrite_info(root, without="fps"), "lacks fps"),
        (lambda root: os.truncate(root / "meta/info.json", 2**30), "too large to be metadata"),
        (lambda root: (root / "meta/episodes.jsonl").write_text(""), "holds no episodes"),
    ],
)
def test_metadata_that_cannot_be_used_are_named(tmp_path, damage, fault):
    episode = {STATE: joint_path()}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, version="v2.1")
    damage(root)
    with pytest.raises(DatasetError, match=fault):
        load_demos(root)
    assert any(fault in str(error) for error in check_dataset(root).errors)


def rewrite_info(root, without):
    info = read_info(root)
    del info[without]
    write_info(root, info)


@pytest.mark.parametrize(
    ("units", "fault"),
    [
        ({"joints": "rad"}, "unknown quantity 'joints'; known are time, joint_position"),
        ({"joint_position": "parsec"}, "joint_position.*parsec"),
    ],
)
def test_units_that_do_not_exist_are_named(tmp_path, units, fault):
    root = write_folder(tmp_path / "set", [{STATE: joint_path()}], {STATE: panda})
    with pytest.raises(DatasetError, match=fault):
        load_demos(root, units=units)
    (root / "meta/hrc_learn.json").write_text(json.dumps({"format": 1, "units": units}))
    with pytest.raises(DatasetError, match=fault) as raised:
        load_demos(root)
    assert str(raised.value.file).endswith("meta/hrc_learn.json")
    assert raised.value.key == f"units.{next(iter(units))}"


def test_an_episode_in_degrees_among_radians_is_refused(tmp_path):
    motions = [joint_path(seed=k) for k in range(4)]
    episodes = [{STATE: q} for q in [*motions[:3], np.rad2deg(motions[3])]]
    root = write_folder(tmp_path / "set", episodes, {STATE: panda})
    with pytest.raises(DatasetError, match=r"times as large.*deg among rad") as raised:
        load_demos(root)
    assert raised.value.episode == 3
    assert len(load_demos(root, episodes=[0, 1, 2])) == 3


def test_the_persons_effort_is_found_by_name_and_by_key(tmp_path):
    q = joint_path()
    names = [*(f"{j}.pos" for j in panda), *(f"{j}.human_torque" for j in panda)]
    by_name = write_folder(tmp_path / "a", [{STATE: np.hstack([q, 2 * q])}], {STATE: names})
    np.testing.assert_allclose(load_demos(by_name)[0].human_effort, 2 * q, atol=1e-6)
    episode = {STATE: q, "observation.human_effort": 3 * q}
    by_key = write_folder(tmp_path / "b", [episode], {STATE: panda})
    np.testing.assert_allclose(load_demos(by_key)[0].human_effort, 3 * q, atol=1e-6)


def test_true_stamps_are_preferred_and_begin_at_zero(tmp_path):
    stamps = 1.7e9 + np.cumsum(np.random.default_rng(0).uniform(0.018, 0.022, 60))
    episode = {STATE: joint_path(60), "observation.time": stamps[:, None]}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    demo = load_demos(root)[0]
    np.testing.assert_allclose(demo.time, stamps - stamps[0], atol=1e-6)
    assert demo.start_time == pytest.approx(stamps[0])


@pytest.mark.parametrize(("unit", "size"), [("s", 1), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
def test_units_of_stamps_are_guessed_from_the_frame_rate(tmp_path, recwarn, unit, size):
    stamps = 5 + np.arange(60) / FPS * 1.2  # a recorder that fell behind
    episode = {STATE: joint_path(60), "time_stamp": stamps[:, None] / size}
    root = write_folder(tmp_path / "set", [episode], {STATE: panda}, dtype="float64")
    demos = load_demos(root)
    np.testing.assert_allclose(demos[0].time, stamps - 5, atol=1e-9)
    assert any(note.startswith("time: ") for note in demos.notes) == (unit != "s")
    assert bool(recwarn.list) == (unit != "s")


@pytest.mark.parametrize("without", ["timestamp", "frame_index", "index", "task_index"])
def test_index_columns_may_be_missing(tmp_path, without):
    root = write_folder(
        tmp_path / "set", [{STATE: joint_path()}], {STATE: panda}, without=[without]
    )
    demo = load_demos(root)[0]
    assert demo.task == "reach"
    np.testing.assert_allclose(np.diff(demo.time), 1 / FPS)


def test_missing_videos_are_no_matter(tmp_path):
    root = write_folder(
        tmp_path / "set",
        [{STATE: joint_path()}],
        {STATE: panda},
        videos=["observation.images.a"],
    )
    assert len(load_demos(root)) == 1


def test_episodes_are_chosen_in_order_and_from_their_row_groups(tmp_path):
    motions = [joint_path(20 + i, seed=i) for i in range(5)]
    root = write_folder(tmp_path / "set", [{STATE: q} for q in motions], {STATE: panda})
    demos = load_demos(root, episodes=[3, 1])
    assert [demo.episode for demo in demos] == [3, 1]
    np.testing.assert_allclose(demos[0].joint_position, motions[3], atol=1e-6)
    np.testing.assert_allclose(demos[1].joint_position, motions[1], atol=1e-6)
    with pytest.raises(DatasetError, match=r"episode 7.*0 to 4"):
        load_demos(root, episodes=[7])
    with pytest.raises(DatasetError, match="no episode was asked for"):
        load_demos(root, episodes=[])


@pytest.mark.parametrize(
    ("scale", "unit"), [(180 / np.pi, "deg"), (4096 / (2 * np.pi), "tick"), (1, "rad")]
)
def test_units_of_joints_are_guessed_shown_and_overruled(tmp_path, recwarn, scale, unit):
    q = joint_path() + 2
    root = write_folder(
        tmp_path / "set", [{STATE: scale * q, "action": scale * q}], {STATE: panda}
    )
    demos = load_demos(root)
    np.testing.assert_allclose(demos[0].joint_position, q, atol=1e-5)
    np.testing.assert_allclose(demos[0].command_position, q, atol=1e-5)
    assert any(f"taken for {unit}" in note for note in demos.notes)
    assert bool(recwarn.list) == (unit != "rad")
    assert all(issubclass(warning.category, UnitsWarning) for warning in recwarn.list)
    given = load_demos(root, units={"joint_position": "rad"})
    np.testing.assert_allclose(given[0].joint_position, scale * q, rtol=1e-6)
    assert not given.notes or "joint_position" not in " ".join(given.notes)


def test_positions_in_centimetres_are_noticed(tmp_path):
    position = 100 * joint_path()
    root = write_folder(tmp_path / "set", [{STATE: position}], {STATE: ["x", "y", "z"]})
    with pytest.warns(UnitsWarning, match="taken for cm"):
        demo = load_demos(root)[0]
    np.testing.assert_allclose(demo.position, position / 100, rtol=1e-6)


def test_units_stand_in_the_sidecar(tmp_path):
    q = joint_path()
    root = write_folder(
        tmp_path / "set", [{STATE: np.rad2deg(q)}], {STATE: [f"{j}.pos" for j in panda]}
    )
    sidecar = {
        "format": 1,
        "units": {"joint_position": "deg"},
        "columns": {},
        "joint_names": panda,
        "frames": {},
        "details": {},
    }
    (root / "meta/hrc_learn.json").write_text(json.dumps(sidecar))
    demos = load_demos(root)
    np.testing.assert_allclose(demos[0].joint_position, q, atol=1e-6)
    assert demos.notes == ()


def test_mapping_overrules_what_names_say(tmp_path):
    q = joint_path()
    episode = {STATE: np.hstack([q, q / 2]), "observation.qpos_raw": 2 * q}
    root = write_folder(tmp_path / "set", [episode], {STATE: [*panda, "px", "py", "pz"]})
    by_slice = load_demos(root, mapping={"joint_position": "observation.state[0:2]"})
    assert by_slice.joint_names == tuple(panda[:2])
    by_feature = load_demos(root, mapping={"joint_position": "observation.qpos_raw"})
    np.testing.assert_allclose(by_feature[0].joint_position, 2 * q, atol=1e-6)
    by_names = load_demos(root, mapping={"joint_position": [panda[2], f"{STATE}/{panda[0]}"]})
    np.testing.assert_allclose(by_names[0].joint_position, q[:, [2, 0]], atol=1e-6)
    assert load_demos(root, mapping={"position": None})[0].position is None


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"joints": STATE}, "unknown quantity 'joints'"),
        ({"joint_position": "observation.qpos"}, "no column 'observation.qpos'"),
        ({"joint_position": ["elbow"]}, "no column 'elbow'.*panda_joint1"),
        ({"position": f"{STATE}[0:2]"}, "position 2 columns, but it needs 3"),
        ({"joint_position": []}, "joint_position no columns"),
        *(
            (
                {"joint_position": f"{STATE}[{bounds}]"},
                rf"{STATE}: .*\[{bounds}\]' for joint_position is no "
                rf"range of the 3 components",
            )
            for bounds in ("0:6", "3:6", "3:", "4", "2:1", "2:2", "", "0:3:2", "x")
        ),
    ],
)
def test_a_wrong_mapping_says_what_exists(tmp_path, mapping, message):
    root = write_folder(tmp_path / "set", [{STATE: joint_path()}], {STATE: panda})
    with pytest.raises(DatasetError, match=message):
        load_demos(root, mapping=mapping)


def test_a_component_of_two_features_needs_the_name_of_one(tmp_path):
    q = joint_path()
    episode, names = {STATE: q, "action": 2 * q}, {STATE: panda, "action": panda}
    root = write_folder(tmp_path / "set", [episode], names)
    with pytest.raises(DatasetError, match=rf"write one of {STATE}/{panda[0]}, action/"):
        load_demos(root, mapping={"joint_position": [panda[0]]})
    read = load_demos(root, mapping={"joint_position": [f"action/{panda[0]}"]})
    np.testing.assert_allclose(read[0].joint_position, 2 * q[:, :1], atol=1e-6)


def test_joints_are_selected_by_name(tmp_path):
    q = joint_path()
    root = write_folder(
        tmp_path / "set",
        [{STATE: q, "action": q[:, ::-1]}],
        {STATE: panda, "action": panda[::-1]},
    )
    demo = load_demos(root, joint_names=[panda[2], panda[0]])[0]
    assert demo.joint_names == (panda[2], panda[0])
    np.testing.assert_allclose(demo.joint_position, q[:, [2, 0]], atol=1e-6)
    np.testing.assert_allclose(demo.command_position, q[:, [2, 0]], atol=1e-6)
    with pytest.raises(DatasetError, match=r"no joint named elbow.*panda_joint1"):
        load_demos(root, joint_names=["elbow"])


def test_actions_of_other_joints_are_kept_apart(tmp_path):
    q = joint_path()
    names = {STATE: ["f1.pos", "f2.pos", "f3.pos"], "action": ["l1.pos", "l2.pos", "l3.pos"]}
    demos = load_demos(write_folder(tmp_path / "set", [{STATE: q, "action": q}], names))
    assert demos[0].command_position is None
    assert demos[0].extra["action"].shape == q.shape
    assert any("left among the extra columns" in note for note in demos.notes)


def test_an_object_is_not_taken_for_the_end_effector(tmp_path):
    episode = {STATE: joint_path(), "observation.object_position": joint_path(seed=5)}
    names = {STATE: panda, "observation.object_position": ["x", "y", "z"]}
    demo = load_demos(write_folder(tmp_path / "set", [episode], names))[0]
    assert demo.position is None
    assert "observation.object_position" in demo.extra


def test_shards_are_read_from_their_own_first_row(tmp_path):
    motions = [joint_path(30, seed=i) for i in range(3)]
    root = write_folder(tmp_path / "set", [{STATE: q} for q in motions], {STATE: panda})
    first = root / "data/chunk-000/file-000.parquet"
    second = root / "data/chunk-000/file-001.parquet"
    second.write_bytes(first.read_bytes())
    rewrite(first, lambda table: table.slice(0, 30))
    rewrite(second, lambda table: table.slice(30))
    rewrite(
        root / "meta/episodes/chunk-000/file-000.parquet",
        lambda table: table.set_column(
            table.schema.get_field_index("data/file_index"), "data/file_index", [[0, 1, 1]]
        ),
    )
    for demo, q in zip(load_demos(root), motions, strict=True):
        np.testing.assert_allclose(demo.joint_position, q, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"episode_index": 0, "length": 60}\n\n{"episode_index"', "line 3 is no valid JSON"),
        ('{"episode_index": 0, "length": 60}\n{"length": 60}\n', "line 2 lacks episode_index"),
    ],
)
def test_a_line_of_json_that_cannot_be_read_is_named_by_its_number(tmp_path, text, fault):
    motions = [joint_path(60, seed=seed) for seed in (0, 1)]
    root = write_folder(
        tmp_path / "set",
        [{STATE: q} for q in motions],
        {STATE: ["a.pos", "b.pos", "c.pos"]},
        version="v2.1",
    )
    (root / "meta/episodes.jsonl").write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError, match=fault) as raised:
        load_demos(root)
    assert str(raised.value.file).endswith("meta/episodes.jsonl")


def test_a_quantity_is_put_together_from_two_features(tmp_path):
    q, other = joint_path(60, seed=0), joint_path(60, seed=1)
    names = {STATE: ["a.pos", "b.pos", "c.pos"], "observation.other": ["d", "e", "f"]}
    root = write_folder(tmp_path / "set", [{STATE: q, "observation.other": other}], names)
    columns = ["a.pos", "observation.other/e"]
    (demo,) = load_demos(root, mapping={"joint_position": columns})
    assert demo.joint_position is not None
    expected = np.stack([q[:, 0], other[:, 1]], axis=1)
    np.testing.assert_allclose(demo.joint_position, expected, atol=1e-6)


def transforms(q: np.ndarray, order) -> np.ndarray:
    """Flattened 4x4 transforms that turn by q and move by q / 2."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(q).as_matrix()
    T[:, :3, 3] = q / 2
    return np.array([matrix.flatten(order) for matrix in T])


def two_columns(rotation: Rotation) -> np.ndarray:
    """The first two columns of the matrices, one after the other."""
    return rotation.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)


def assert_same_rotation(orientation: np.ndarray, expected: Rotation) -> None:
    difference = Rotation.from_quat(orientation, scalar_first=True) * expected.inv()
    assert difference.magnitude().max() < 1e-5
