"""Every kind of broken dataset gives its finding, with file, episode, frame and key."""

import re
import shutil
import sys
from io import StringIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot_folders import FPS, joint_path, read_info, rewrite, write_folder, write_info

from hrc_learn.demos import DatasetError, DatasetWriter, check_dataset, load_demos
from hrc_learn.demos.issues import ValidationReport, aligned, warning
from hrc_learn.kinematics import panda

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

STATE = "observation.state"
NAMES = ["a.pos", "b.pos", "c.pos"]
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def columns(seed):
    q = joint_path(60, seed=seed)
    return {STATE: q, "action": q + 0.01 * np.sin(np.arange(60))[:, None]}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder, names = tmp_path_factory.mktemp("sound") / "set", {STATE: NAMES, "action": NAMES}
    return write_folder(folder, [columns(i) for i in range(3)], names)


@pytest.fixture
def root(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "set")


def change_values(root, key, change, file=DATA):
    """Replace a column by what `change` makes of its values (frames, width)."""

    def replace(table):
        values = np.array(table.column(key).to_pylist())
        column = change(values.copy())
        array = (
            pa.array(column, table.schema.field(key).type)
            if column.ndim == 1
            else pa.array(list(column), table.schema.field(key).type)
        )
        return table.set_column(table.schema.get_field_index(key), key, array)

    rewrite(root / file, replace)


def change_info(root, **entries):
    write_info(root, {**read_info(root), **entries})


def change_feature(root, key, **entries):
    info = read_info(root)
    info["features"][key] |= entries
    write_info(root, info)


def set_value(values, where, value):
    values[where] = value
    return values


def find(findings, message):
    """The one finding whose text matches."""
    column_mapping = [f for f in findings if re.search(message, f.message)]
    assert len(column_mapping) == 1, f"{message!r} in {[str(f) for f in findings]}"
    return column_mapping[0]


def test_a_sound_dataset_has_no_findings_but_the_guess_of_units(root):
    report = check_dataset(root)
    assert report.ok
    assert (report.episodes, report.frames) == (3, 180)
    assert [f.message for f in report.warnings if "no unit declared" not in f.message] == []


FATAL = {
    "no folder": (shutil.rmtree, "the folder does not exist", "info.json"),
    "no info": (lambda r: (r / "meta/info.json").unlink(), "no LeRobot dataset", "info.json"),
    "broken info": (
        lambda r: (r / "meta/info.json").write_text('{"fps": 50,'),
        "no valid JSON",
        "info.json",
    ),
    "no episodes": (
        lambda r: shutil.rmtree(r / "meta/episodes"),
        "not finalized",
        "meta/episodes",
    ),
    "no tasks": (lambda r: (r / "meta/tasks.parquet").unlink(), "not found", "tasks.parquet"),
    "no data": (lambda r: (r / DATA).unlink(), "not found: the copy is incomplete", DATA),
    "truncated": (
        lambda r: (r / DATA).write_bytes((r / DATA).read_bytes()[:900]),
        "truncated",
        DATA,
    ),
    "version 4": (
        lambda r: change_info(r, codebase_version="v4.0"),
        "must be 2.0, 2.1 or 3.0, got 'v4.0'",
        "info.json",
    ),
    "version 1": (
        lambda r: change_info(r, codebase_version="v1.6"),
        "must be 2.0, 2.1 or 3.0, got 'v1.6'",
        "info.json",
    ),
    "fps 0": (lambda r: change_info(r, fps=0), "fps must be positive", "info.json"),
    "shape wrong": (
        lambda r: change_feature(r, STATE, shape=[4], names=None),
        r"has 3 components, but .* declares the shape \[4\]",
        DATA,
    ),
    "column missing": (
        lambda r: rewrite(r / DATA, lambda table: table.drop_columns(["action"])),
        "declared in meta/info.json, but missing",
        DATA,
    ),
    "rows lost": (
        lambda r: rewrite(r / DATA, lambda table: table.slice(0, 150)),
        "holds 150 frames, but the list of episodes promises 180",
        DATA,
    ),
    "rows repeated": (
        lambda r: rewrite(r / DATA, lambda t: pa.concat_tables([t, t.slice(170)])),
        "holds 190 frames, but the list of episodes promises 180",
        DATA,
    ),
}


@pytest.mark.parametrize("defect", FATAL)
def test_what_cannot_be_read_is_an_error_in_both_ways_of_reading(root, defect):
    damage, message, file = FATAL[defect]
    damage(root)
    finding = find(check_dataset(root).errors, message)
    assert finding.file is not None
    assert finding.file.endswith(file)
    with pytest.raises(DatasetError, match=message) as raised:
        load_demos(root)
    assert raised.value.file is not None
    assert raised.value.file.endswith(file)
    assert "huggingface" not in str(raised.value).lower()


def test_one_file_missing_does_not_hide_the_others(tmp_path):
    episodes = [columns(i) for i in range(3)]
    root = write_folder(tmp_path / "set", episodes, {STATE: NAMES}, version="v2.1")
    (root / "data/chunk-000/episode_000001.parquet").unlink()
    change_values(
        root,
        STATE,
        lambda v: set_value(v, (7, 1), np.nan),
        "data/chunk-000/episode_000002.parquet",
    )
    report = check_dataset(root)
    missing = find(report.errors, "not found")
    assert (missing.file, missing.episode) == ("data/chunk-000/episode_000001.parquet", 1)
    nan = find(report.errors, "b.pos is nan")
    assert (nan.episode, nan.frame, nan.key) == (2, 7, STATE)
    assert report.episodes == 2


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers(root, value):
    change_values(root, STATE, lambda v: set_value(v, (60 + 17, 2), value))
    finding = find(check_dataset(root).errors, f"c.pos is {value}")
    assert (finding.file, finding.episode, finding.frame, finding.key) == (DATA, 1, 17, STATE)
    with pytest.raises(DatasetError, match="joint_position is") as raised:
        load_demos(root)
    assert (raised.value.file, raised.value.episode, raised.value.frame) == (DATA, 1, 17)
    assert STATE in str(raised.value.key)
    assert len(load_demos(root, episodes=[0, 2])) == 2  # as the message advises


def test_values_that_are_missing(root):
    def drop_one(table):
        rows = table.column(STATE).to_pylist()
        rows[60 + 5] = None
        index = table.schema.get_field_index(STATE)
        return table.set_column(index, STATE, pa.array(rows, pa.list_(pa.float32())))

    rewrite(root / DATA, drop_one)
    finding = find(check_dataset(root).errors, "holds no value")
    assert (finding.episode, finding.frame, finding.key) == (1, 5, STATE)
    with pytest.raises(DatasetError, match="holds no value") as raised:
        load_demos(root)
    assert (raised.value.episode, raised.value.frame) == (1, 5)


def test_rows_of_differing_width(root):
    def shorten(table):
        rows = table.column(STATE).to_pylist()
        rows[3] = rows[3][:2]
        index = table.schema.get_field_index(STATE)
        return table.set_column(index, STATE, pa.array(rows, pa.list_(pa.float32())))

    rewrite(root / DATA, shorten)
    finding = find(check_dataset(root).errors, "holds 2 components, the first row 3")
    assert (finding.episode, finding.frame) == (0, 3)


def test_counts_that_contradict_each_other(root):
    change_info(root, total_frames=200, total_episodes=4)
    errors = check_dataset(root).errors
    assert find(errors, "says 200, but the list of episodes counts 180").key == "total_frames"
    assert find(errors, "says 4, but the list of episodes counts 3").key == "total_episodes"


def test_an_episode_missing_from_the_list(root):
    rewrite(root / EPISODES, lambda table: table.take([0, 2]))
    change_info(root, total_episodes=2)
    assert find(check_dataset(root).errors, "missing from the list of episodes").episode == 1


def test_offsets_that_point_into_another_episode(root):
    def shift(table):
        index = table.schema.get_field_index("dataset_from_index")
        return table.set_column(index, "dataset_from_index", [[0, 50, 120]])

    rewrite(root / EPISODES, shift)
    errors = check_dataset(root).errors
    finding = next(f for f in errors if "begins at row 50" in f.message)
    assert (finding.episode, finding.file) == (1, DATA)
    with pytest.raises(DatasetError, match="offsets in the list of episodes are wrong"):
        load_demos(root)


@pytest.mark.parametrize("key", ["frame_index", "index"])
def test_indices_with_a_gap(root, key):
    change_values(root, key, lambda v: v + (np.arange(len(v)) >= 80) * 5)
    errors = [f for f in check_dataset(root).errors if f.key == key]
    assert errors[0].episode == 1
    assert errors[0].frame == 20


def test_a_task_that_is_not_listed(root):
    change_values(root, "task_index", lambda v: set_value(v, 130, 9))
    finding = find(check_dataset(root).errors, "task 9 is not in the list")
    assert (finding.episode, finding.frame) == (2, 10)


def test_stamps_that_do_not_increase(root):
    change_values(root, "timestamp", lambda v: set_value(v, 70, v[69]))
    finding = find(check_dataset(root).errors, "stamps must increase")
    assert (finding.episode, finding.frame, finding.key) == (1, 10, "timestamp")
    with pytest.raises(DatasetError, match="stamps must increase") as raised:
        load_demos(root)
    assert (raised.value.episode, raised.value.frame) == (1, 10)


def test_joint_sets_that_cannot_be_matched(tmp_path):
    q = joint_path()
    names = {STATE: NAMES, "action": ["x1.pos", "x2.pos"]}
    root = write_folder(tmp_path / "set", [{STATE: q, "action": q[:, :2]}], names)
    report = check_dataset(root)
    assert find(report.warnings, "Name them alike").key == "command_position"
    assert load_demos(root)[0].command_position is None


def test_a_transform_is_a_pose(tmp_path):
    moved = np.tile(np.eye(4), (40, 1, 1))
    moved[:, 0, 3] = np.linspace(0.3, 0.6, 40)
    names = [f"O_T_EE_{k}" for k in range(16)]
    episodes = [{"observation.state": moved.transpose(0, 2, 1).reshape(40, 16)}] * 2
    root = write_folder(tmp_path / "set", episodes, {"observation.state": names})
    assert not check_dataset(root).errors


def test_a_dataset_without_joints_or_poses(tmp_path):
    root = write_folder(tmp_path / "set", [{"observation.environment_state": joint_path()}], {})
    find(check_dataset(root).errors, "no joints and no poses found")


def replay(root, **changed):
    """The dataset anew with columns replaced in its second episode."""
    shutil.rmtree(root)
    episodes = [columns(i) for i in range(3)]
    episodes[1] |= {key: change(episodes[1][key]) for key, change in changed.items()}
    return write_folder(root, episodes, {STATE: NAMES, "action": NAMES})


def pause(values, begin, end):
    return np.concatenate([values[:begin], np.repeat(values[begin : begin + 1], end, 0)])[:60]


def late(frame):
    """1 from that frame on for the second joint, 0 else."""
    return (np.arange(60)[:, None] >= frame) * np.array([0.0, 1.0, 0.0])


ODD = {
    "fps wrong": (
        lambda r: change_info(r, fps=40),
        r"20 ms apart \(50 Hz\), but fps says 40",
        None,
    ),
    "gap": (
        lambda r: change_values(
            r, "timestamp", lambda v: np.concatenate([v[:75], v[75:120] + 0.2, v[120:]])
        ),
        "1 gaps, about 10 frames lost",
        (1, 15, "timestamp"),
    ),
    "jitter": (
        lambda r: change_values(
            r, "timestamp", lambda v: v + np.random.default_rng(0).uniform(-2e-3, 2e-3, 180)
        ),
        "steps vary by",
        None,
    ),
    "frozen": (
        lambda r: replay(r, **{STATE: lambda v: np.repeat(v[:1], 60, 0)}),
        "the state never changes",
        (1, 0, STATE),
    ),
    "repeats": (
        lambda r: replay(r, **{STATE: lambda v: np.repeat(v[::2], 2, 0)}),
        "51 % of the frames repeat",
        (1, 1, None),
    ),
    "jump": (
        lambda r: replay(r, **{STATE: lambda v: v + late(30) * 3}),
        "b jumps by 2.98 rad",
        (1, 30, "joint_position (b)"),
    ),
    "wrap": (
        lambda r: replay(r, **{STATE: lambda v: v + late(30) * 2 * np.pi}),
        "the encoder wrapped",
        (1, 30, "joint_position (b)"),
    ),
    "still at first": (
        lambda r: replay(
            r, **{STATE: lambda v: np.concatenate([np.repeat(v[:1], 55, 0), v[:50:10][:5]])}
        ),
        r"begins with 1\.1 s of standing still",
        (1, 0, None),
    ),
    "still at last": (
        lambda r: replay(r, **{STATE: lambda v: pause(v, 5, 60)}),
        r"ends with 1\.1 s of standing still",
        (1, 4, None),
    ),
    "copied action": (
        lambda r: replay(r, action=lambda v: columns(1)[STATE]),
        "copy of the state",
        (1, None, "action"),
    ),
    "same episode twice": (
        lambda r: replay(
            r, **{key: lambda v, key=key: columns(0)[key] + 1e-5 for key in (STATE, "action")}
        ),
        "same motion as episode 0",
        (1, None, None),
    ),
    "statistics gone": (
        lambda r: (r / "meta/stats.json").unlink(),
        "no statistics",
        (None, None, None),
    ),
    "index column gone": (
        lambda r: rewrite(r / DATA, lambda table: table.drop_columns(["frame_index"])),
        "the column is missing: LeRobot cannot open this file",
        (None, None, "frame_index"),
    ),
}


SHOWS_NOTHING = ("frozen",)
"""Read all the same, though an episode without motion is an error: nothing fits to it."""


@pytest.mark.parametrize("defect", ODD)
def test_oddities_are_warnings_and_the_dataset_stays_readable(root, defect):
    damage, message, place = ODD[defect]
    damage(root)
    report = check_dataset(root)
    if place is None:
        found = [f for f in report.warnings if re.search(message, f.message)]
        assert len(found) == 3  # in every episode
    else:
        finding = find(report.warnings, message)
        assert (finding.episode, finding.frame, finding.key) == place
    assert report.ok or defect in SHOWS_NOTHING, str(report)
    assert len(load_demos(root)) == 3


def test_dimensions_that_never_change_or_saturate(tmp_path):
    q = joint_path(200)
    q[:, 1] = 0.5
    q[:, 2] = np.minimum(q[:, 2], np.quantile(q[:, 2], 0.6))
    report = check_dataset(write_folder(tmp_path / "set", [{STATE: q}], {STATE: NAMES}))
    assert find(report.warnings, "never changes").message.endswith("b.pos")
    assert find(report.warnings, "end of its range").message.endswith("c.pos")


@pytest.mark.parametrize(("count", "warnings"), [(6, 6), (7, 1)])
def test_many_constant_features_are_one_warning(tmp_path, count, warnings):
    still = {f"observation.f{k}": np.full((60, 1), k) for k in range(count)}
    root = write_folder(tmp_path / "set", [columns(0) | still], {STATE: NAMES, "action": NAMES})
    found = [w for w in check_dataset(root).warnings if "never change" in w.message]
    assert len(found) == warnings
    assert warnings > 1 or found[0].message.startswith(f"{count} features never change: ")


def test_actions_of_some_joints_only(tmp_path):
    q = joint_path()
    names = {STATE: NAMES, "action": NAMES[:2]}
    root = write_folder(tmp_path / "set", [{STATE: q, "action": q[:, :2]}], names)
    report = check_dataset(root)
    assert report.ok
    assert find(report.warnings, "c.pos.: no joint of the arm, no action has it")


def test_leader_and_follower(tmp_path):
    q = joint_path()
    names = {STATE: NAMES, "action": ["l1.pos", "l2.pos", "l3.pos"]}
    report = check_dataset(write_folder(tmp_path / "set", [{STATE: q, "action": q}], names))
    assert report.ok
    assert find(report.warnings, "Leader and follower").key == "command_position"


def test_false_starts(tmp_path):
    episodes = [{STATE: joint_path(60)}, {STATE: joint_path(8, seed=1)}]
    report = check_dataset(write_folder(tmp_path / "set", episodes, {STATE: NAMES}))
    assert find(report.warnings, "only 8 frames").episode == 1


def test_guessed_units_are_shown(tmp_path):
    q = np.rad2deg(joint_path() + 2)
    root = write_folder(tmp_path / "set", [{STATE: q}], {STATE: NAMES})
    find(check_dataset(root).warnings, "taken for deg")
    declared = check_dataset(root, units={"joint_position": "deg"})
    assert not any("taken for" in finding.message for finding in declared.warnings)


def test_the_callers_own_mistakes_are_no_findings(root):
    with pytest.raises(DatasetError, match="does not come in 'furlong'; known units are rad"):
        check_dataset(root, units={"joint_position": "furlong"})
    with pytest.raises(DatasetError, match="unknown quantity 'joints'"):
        check_dataset(root, mapping={"joints": STATE})


def test_missing_videos(tmp_path):
    root = write_folder(
        tmp_path / "set", [{STATE: joint_path()}], {STATE: NAMES}, videos=["observation.front"]
    )
    assert find(check_dataset(root).warnings, "no file of it").key == "observation.front"


def test_quaternions_that_flip_or_are_none(tmp_path):
    angle = np.linspace(0, 1, 60)
    q = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=1)
    q[20:] *= -1
    names = {STATE: ["x", "y", "z", "qw", "qx", "qy", "qz"]}
    pose = np.hstack([joint_path(), q])
    report = check_dataset(write_folder(tmp_path / "flip", [{STATE: pose}], names))
    assert find(report.warnings, "changes its sign 1 times").frame == 20
    pose[40, 3:] *= 0.2
    report = check_dataset(write_folder(tmp_path / "lost", [{STATE: pose}], names))
    find(report.errors, "quaternion of length 0.2 at frame 40")


@pytest.mark.parametrize(("turn", "errors"), [(0.98 * np.pi, 0), (0.8 * np.pi, 1)])
def test_a_rotation_near_half_a_turn_may_be_turned_over(tmp_path, turn, errors):
    """v and v (1 - 2 pi / |v|) are one rotation; unless |v| is near pi they lie far apart."""
    names = {STATE: ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"]}
    rng, episodes = np.random.default_rng(0), []
    for episode in range(6):
        wave = np.sin(np.linspace(0, 3, 60))[:, None]
        vector = np.array([0.05, turn, 0.1]) + 0.02 * rng.normal(size=3) * wave
        if episode == 2:
            vector[:, 1] *= -1
        place = joint_path(60, 3) + 0.01 * rng.normal(size=3)
        episodes.append({STATE: np.hstack([place, vector])})
    report = check_dataset(write_folder(tmp_path / "set", episodes, names))
    found = [e for e in report.errors if "opposite sign" in e.message]
    assert len(found) == errors
    assert all(e.episode == 2 and "ee.wy" in e.message for e in found)


JOINTS = ["shoulder", "elbow", "wrist", "rotation"]


def four_joints(seed, levels=(0.0, 1.0, 2.0, 3.0)):
    """Joints that each move a little about a level of their own [rad]."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 3, 60)[:, None] + rng.uniform(0, 0.2, 4)
    return {STATE: np.array(levels) + 0.1 * np.sin(phase)}


@pytest.mark.parametrize(
    ("levels", "errors"),
    [
        ((1.0, 0.0, 2.0, 3.0), 1),
        ((1.0, 0.0, 3.0, 2.0), 1),
        # Two are where others usually are, and these are nearly there as well.
        ((1.0, 1.01, 3.0, 3.01), 0),
    ],
)
def test_joints_are_exchanged_where_each_took_the_others_place(tmp_path, levels, errors):
    episodes = [four_joints(i) for i in range(4)] + [four_joints(4, levels)]
    root = write_folder(tmp_path / "set", episodes, {STATE: JOINTS})
    found = [i for i in check_dataset(root).errors if "look exchanged" in i.message]
    assert len(found) == errors
    assert all(i.episode == 4 for i in found)


def test_a_joint_that_rests_is_no_standing_still(tmp_path):
    def episode(seed):
        q = joint_path(120, seed=seed)
        q[60:, 0] = q[60, 0]
        q[:60, 1] = q[60, 1]
        return {STATE: q}

    root = write_folder(tmp_path / "set", [episode(i) for i in range(3)], {STATE: NAMES})
    assert "standing still" not in str(check_dataset(root))


@pytest.mark.parametrize(("delay", "shifted"), [(6, False), (-6, True)])
def test_an_episode_whose_state_leads_where_it_follows_in_the_others(tmp_path, delay, shifted):
    def episode(seed, frames):
        t = np.linspace(0, 6, 160)[:, None] + np.random.default_rng(seed).uniform(0, 0.3, 3)
        q = 0.5 * np.sin(t * [1.0, 1.7, 2.3])
        return {STATE: q[20 - frames : 140 - frames], "action": q[20:140]}

    episodes = [episode(i, 6) for i in range(4)] + [episode(4, delay)]
    root = write_folder(tmp_path / "set", episodes, {STATE: NAMES, "action": NAMES})
    found = [i.episode for i in check_dataset(root).errors if "shifted" in i.message]
    assert found == ([4] if shifted else [])


def test_findings_that_differ_in_joints_and_figures_alone_share_a_line():
    report = ValidationReport(path=Path("set"))
    for episode, names in enumerate([("elbow",), ("kWrist", "base"), ("base",)]):
        text = f"is noisier by {episode + 0.5} than usual: {', '.join(names)}"
        severity = 0.1 * episode
        report.add(warning(message=text, episode=episode, components=names, severity=severity))
    # "spam" is not declared to be a component.
    report.add(warning(message="is noisier by 3 than usual: spam", episode=3))
    first, second, _ = report.lines()
    assert first.endswith("usual: base (and 2 more; episodes 0, 1)")
    assert second.endswith("usual: spam")


def test_names_unknown(root):
    change_feature(root, STATE, names=None)
    find(check_dataset(root).warnings, "names no components")


def test_one_name_for_a_vector_names_no_component(root):
    change_feature(root, STATE, names=["state"])
    find(check_dataset(root).warnings, "names no components")
    assert load_demos(root)[0].joint_position.shape == (60, 3)
    mapped = load_demos(root, mapping={"joint_position": f"{STATE}[0:2]"})
    assert mapped[0].joint_position.shape == (60, 2)


def test_a_long_message_keeps_its_advice():
    text = str(warning(message=f"{'name, ' * 200}: name one of them", key="state"))
    assert len(text) < 1010
    assert text.endswith("name one of them")


def test_a_command_in_a_message_keeps_its_long_path():
    command = f"`hrc repair --dataset /{'folder/' * 60}set`"
    assert command in str(warning(message=f"not found. {command} makes a dataset of it"))


def test_a_damaged_sidecar(root):
    (root / "meta/hrc_learn.json").write_text('{"format": 1')
    assert find(check_dataset(root).errors, "not valid JSON").file == "meta/hrc_learn.json"
    with pytest.raises(DatasetError, match="not valid JSON"):
        load_demos(root)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A dataset written by this package."""
    root = tmp_path_factory.mktemp("recorded") / "set"
    with DatasetWriter(root, FPS, "test", ("a", "b", "c")) as writer:
        for seed in range(3):
            writer.start_episode("reach")
            for q in joint_path(60, seed=seed):
                writer.add_frame(joint_position=q)
            writer.save_episode()
    return root


@pytest.mark.parametrize("place", [0.1, 0.25, 0.6, 0.8])
@pytest.mark.parametrize("file", [DATA, EPISODES, "meta/stats.json"])
def test_a_flipped_bit_is_found_in_what_we_wrote(recorded, tmp_path, file, place):
    root = shutil.copytree(recorded, tmp_path / "set")
    assert check_dataset(root).ok
    content = bytearray((root / file).read_bytes())
    content[int(place * len(content))] ^= 4
    (root / file).write_bytes(content)
    assert find(check_dataset(root).errors, "checksum differs").file == file


def test_a_flipped_bit_in_a_page_of_values_is_not_read(recorded, tmp_path):
    root = shutil.copytree(recorded, tmp_path / "set")
    content = bytearray((root / DATA).read_bytes())
    expected = load_demos(recorded)[0].joint_position
    place = content.find(expected[30].astype(np.float32).tobytes())
    assert place > 0
    content[place] ^= 1
    (root / DATA).write_bytes(content)
    with pytest.raises(DatasetError, match="the file is damaged"):
        load_demos(root)


def test_a_contract_may_be_edited_and_a_damaged_list_of_checksums_is_said(recorded, tmp_path):
    root = shutil.copytree(recorded, tmp_path / "set")
    sidecar = root / "meta/hrc_learn.json"
    sidecar.write_text(sidecar.read_text().replace('"details": {}', '"details": {"by": "me"}'))
    assert check_dataset(root).ok
    (root / ".manifest.json").write_text("{")
    assert find(check_dataset(root).errors, "not valid JSON").file == ".manifest.json"


def test_the_report_reads_as_text(root):
    change_info(root, fps=40)
    assert "(and 2 more; episodes 1, 2)" in str(check_dataset(root))
    (root / DATA).unlink()
    text = str(check_dataset(root))
    assert text.startswith(f"error: {DATA}, episode 0: not found")
    assert text.endswith("0 episodes, 0 frames, 1 error, 0 warnings")


def test_the_fixture_is_at_the_rate_the_findings_assume(root):
    assert read_info(root)["fps"] == FPS
    assert pq.read_metadata(root / DATA).num_row_groups == 3


@pytest.mark.parametrize(("size", "noise", "found"), [(2.0, 0.004, True), (0.2, 0.004, False)])
def test_standing_still_is_meant_relative_to_the_motion(tmp_path, size, noise, found):
    """Half a per cent of the way is the noise of an arm at rest."""
    rng = np.random.default_rng(0)
    episodes = []
    for seed in range(3):
        moves = joint_path(60, seed=seed)
        moves = moves / np.ptp(moves, axis=0).max() * size
        rests = moves[:1] + noise * rng.uniform(-1, 1, (2 * int(FPS), moves.shape[1]))
        episodes.append({STATE: np.concatenate([moves[:1], rests, moves])})
    root = write_folder(tmp_path / "set", episodes, {STATE: NAMES})
    said = [finding.message for finding in check_dataset(root).warnings]
    assert any("of standing still" in message for message in said) == found


@pytest.mark.parametrize(
    ("columns", "lines"),
    [
        ("14", ["column  unit  why", "joints  rad   declared", "x       m     by its name"]),
        ("13", ["column\n  unit  why", "joints\n  rad   declared", "x\n  m     by its name"]),
    ],
)
def test_the_first_cell_has_its_own_line_in_a_narrow_terminal(monkeypatch, columns, lines):
    monkeypatch.setenv("COLUMNS", columns)
    rows = [("column", "unit", "why"), ("joints", "rad", "declared"), ("x", "m", "by its name")]
    assert [*aligned(rows)] == lines


def test_a_table_in_a_file_has_one_line_per_row(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(sys, "__stdout__", StringIO())
    assert [*aligned([("word " * 50, "why"), ("b", "c")])][1] == f"{'b':250}  c"


@pytest.mark.parametrize("posed", [False, True])
def test_zeros_of_joints_are_only_compared_with_recorded_positions(tmp_path, posed):
    """A Panda whose joint 4 is 3 degrees off, recorded with and without its tool."""
    q = panda.ready.numpy() + 0.25 * joint_path(120, joints=7)
    tool = panda.forward(torch.from_numpy(q)).position.numpy()
    read = q + np.deg2rad([0, 0, 0, 3.0, 0, 0, 0])
    with DatasetWriter(tmp_path / "set", FPS, "panda", panda.joint_names) as writer:
        writer.start_episode("reach")
        for k in range(len(q)):
            more = {"position": tool[k]} if posed else {}
            writer.add_frame(joint_position=read[k], **more)
        writer.save_episode()
    report = check_dataset(tmp_path / "set")
    assert report.errors == []
    found = [str(issue) for issue in report.warnings if "zeros of joints" in str(issue)]
    assert len(found) == posed
    assert not posed or "panda_joint4 -" in found[0]
