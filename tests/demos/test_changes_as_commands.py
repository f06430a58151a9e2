"""Actions that are changes per step, as in robosuite or MetaWorld, are read as no positions.

The arm is MuJoCo's, under a controller that lags; the targets of that controller are known.
"""

import dataclasses

import mujoco
import numpy as np
import pytest
from lerobot_folders import write_folder

from hrc_learn.demos import (
    DatasetError,
    RepairOptions,
    UnitsWarning,
    check_dataset,
    load_demos,
    merge_datasets,
    open_demos,
    repair_dataset,
)
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection, map_columns
from hrc_learn.demos.read.contract import keep_contract
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.profiles import Tracking
from hrc_learn.demos.read.source import _meaning_of_commands
from hrc_learn.demos.read.units import UnitDecision, unit_factor

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

FPS, STATE, ACTION = 20, "observation.state", "action"
JOINTS = [f"joint{i}.pos" for i in range(6)]
HOME = np.array([0.0, 0.4, -0.9, 0.3, 0.5, 0.0])
AWAY = np.array([0.8, 0.4, -0.5, 0.3, 0.4, 0.9])
LARGEST = 0.08
"""Largest change per step [rad]."""


def arm_model():
    """Six hinges about y and z, with links of 20 cm."""
    bodies = "".join(
        f'<body pos="0 0 {0.2 * (i > 0)}"><joint axis="0 {i % 2} {1 - i % 2}" damping="1" '
        f'armature="0.1"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.2"/>'
        for i in range(6)
    )
    world = f"<worldbody>{bodies}{'</body>' * 6}</worldbody>"
    text = f'<mujoco><option timestep="0.005"/>{world}</mujoco>'
    return mujoco.MjModel.from_xml_string(text)


def episode(model, seed, kind, stiffness=150.0):
    """State, action and target of the controller at each frame [rad]."""
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:] = HOME
    phase = np.clip(1.2 * np.linspace(0, 1, 90) - 0.1, 0, 1)[:, None]
    way = HOME + AWAY * rng.uniform(0.8, 1.2, 6) * (0.5 - 0.5 * np.cos(1.5 * np.pi * phase))
    target, inertia, rows = HOME.copy(), np.zeros((6, 6)), []
    for wanted in way:
        q = data.qpos.copy()
        if kind == "position":
            action = target = wanted
        elif kind == "velocity":
            action = (wanted - target) * FPS
            target = target + action / FPS
        else:  # of the measured joints, or of the last target
            action = np.clip(
                wanted - (start := q if kind == "measured" else target), -LARGEST, LARGEST
            )
            target = start + action
        rows.append((q + 2e-4 * rng.standard_normal(6), action, target))
        for _ in range(round(1 / FPS / model.opt.timestep)):
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, inertia)
            pull = stiffness * (target - data.qpos) - 2 * np.sqrt(stiffness) * data.qvel
            data.qfrc_applied[:] = data.qfrc_bias + inertia @ pull
            mujoco.mj_step(model, data)
    return [np.array(values) for values in zip(*rows, strict=True)]


@pytest.fixture(scope="module")
def recorded():
    model, made = arm_model(), {}

    def record(kind, **settings):
        key = (kind, *settings.items())
        if key not in made:
            made[key] = [episode(model, seed, kind, **settings) for seed in range(3)]
        return made[key]

    return record


def write(root, episodes, *, unit=1.0, scale=1.0, state=JOINTS, action=JOINTS, gripper=True):
    """A dataset of them, with a gripper behind; actions are divided by the scale."""
    rows = []
    for q, a, _ in episodes:
        closed = (np.arange(len(q)) > 50.0)[:, None]
        given = np.hstack([unit * a / scale, 2.0 * closed - 1.0])
        width = given.shape[1] - (not gripper)
        rows.append({STATE: np.hstack([unit * q, closed]), ACTION: given[:, :width]})
    names = {k: n and [*n, "gripper.pos"] for k, n in ((STATE, state), (ACTION, action))}
    return write_folder(root, rows, names, fps=FPS)


def close(demos, episodes, atol=2e-6):
    """Commands as read are the targets. Stored as float32, and noise of the measured joints."""
    for demo, (_, _, target) in zip(demos, episodes, strict=True):
        np.testing.assert_allclose(demo.command_position[:, :6], target, atol=atol)


@pytest.mark.parametrize("names", [JOINTS, None], ids=["named", "unnamed"])
@pytest.mark.parametrize(("unit", "word"), [(1.0, "rad"), (180 / np.pi, "deg")])
def test_changes_are_added_to_the_joints_and_a_line_says_so(
    recorded, tmp_path, unit, word, names
):
    episodes = recorded("measured")
    root = write(tmp_path / "set", episodes, unit=unit, state=names, action=names)
    with pytest.warns(UnitsWarning, match=f"changes, not positions: taken for {word}/step"):
        demos = load_demos(root)
    close(demos, episodes, atol=1e-3)  # the noise of the measured joints
    report = check_dataset(root)
    assert report.ok
    (line,) = [str(issue) for issue in report.warnings if "command_position" in str(issue)]
    assert f"taken for {word}/step" in line
    assert not [issue for issue in report.warnings if "from its command" in str(issue)]
    command = next(part for part in report.contract.components if part.role == "command")
    assert (command.unit, command.sign) == (f"{word}/step", 1)


@pytest.mark.parametrize("kind", ["measured", "target"])
@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
def test_the_scale_of_normalised_changes_is_found(recorded, tmp_path, kind, unit):
    """It is the motion per unit, which a lag makes smaller than the step of the target."""
    root = write(tmp_path / "set", recorded(kind), unit=unit, scale=unit * LARGEST)
    with pytest.warns(UnitsWarning, match="changes, not positions"):
        demos = load_demos(root)
    for demo, (_, action, _) in zip(demos, recorded(kind), strict=True):
        added = demo.command_position - demo.joint_position
        (scale,) = np.linalg.lstsq(action.reshape(-1, 1), added.ravel(), rcond=None)[0]
        np.testing.assert_allclose(added, scale * action, atol=1e-3)
        assert 0.15 < scale < 1.1


def test_a_given_scale_gives_the_targets(recorded, tmp_path):
    root = write(tmp_path / "set", recorded("measured"), scale=LARGEST)
    given = {"command_position": f"{LARGEST} rad/step", "joint_position": "rad"}
    close(load_demos(root, units=given), recorded("measured"), atol=1e-3)


@pytest.mark.parametrize("stiffness", [400.0, 150.0, 25.0])
def test_positions_stay_positions_however_late_the_arm_is(recorded, tmp_path, stiffness):
    episodes = recorded("position", stiffness=stiffness)
    for names in (JOINTS, None):
        demos = load_demos(
            write(tmp_path / str(names is None), episodes, state=names, action=names)
        )
        close(demos, episodes)
        assert not any("command_position" in note for note in demos.notes)


def test_velocities_are_no_positions_either(recorded, tmp_path):
    root = write(tmp_path / "set", recorded("velocity"))
    (line,) = [str(i) for i in check_dataset(root).warnings if "command_position" in str(i)]
    assert "velocities in rad/s: map them to command_velocity" in line
    with pytest.warns(UnitsWarning, match=r"taken for 0\.0[45]\d* rad/step"):
        demos = load_demos(root)
    for demo, (_, action, _) in zip(demos, recorded("velocity"), strict=True):
        added = demo.command_position - demo.joint_position
        np.testing.assert_allclose(added, action / FPS, atol=0.1 * LARGEST)


def test_the_caller_decides(recorded, tmp_path):
    root = write(tmp_path / "set", recorded("measured"))
    demos = load_demos(root, units={"command_position": "rad"})
    np.testing.assert_allclose(demos[0].command_position, recorded("measured")[0][1], atol=1e-6)


def test_a_kept_contract_decides_without_the_evidence(recorded, tmp_path):
    root = write(tmp_path / "set", recorded("measured"))
    keep_contract(root, check_dataset(root).contract)
    close(open_demos(root, episodes=[0]), recorded("measured")[:1], atol=1e-3)


@pytest.mark.parametrize("known", [JOINTS, None], ids=["named", "unnamed"])
def test_an_action_that_only_has_the_width_of_the_joints_is_asked_about(
    recorded, tmp_path, known
):
    """Six changes of a pose, and an arm of six joints: `pd_ee_delta_pose` of ManiSkill."""
    rng, episodes = np.random.default_rng(1), []
    mixing = rng.standard_normal((6, 6))
    for q, _, target in recorded("position"):
        pose = np.sin(q @ mixing)
        episodes.append((q, np.diff(pose, axis=0, append=pose[-1:]) / 0.05, target))
    root = write(tmp_path / "set", episodes, state=known, action=None, gripper=known is None)
    with pytest.raises(
        DatasetError, match=r"joints do not follow it.*command_position COLUMNS\|none"
    ):
        open_demos(root, refuse_doubt=True)
    demos = open_demos(root, mapping={"command_position": None}, refuse_doubt=True)
    assert demos[0].command_position is None


def test_a_pose_without_names_is_asked_about(recorded, tmp_path):
    """Three positions and a gripper, moved by scaled changes: MetaWorld."""
    episodes = [(q[:, :3], a[:, :3], t[:, :3]) for q, a, t in recorded("target")]
    root = write(tmp_path / "set", episodes, scale=LARGEST, state=None, action=None)
    with pytest.raises(DatasetError, match=r"may be a pose.*--mapping position KEY\[0:3\]"):
        open_demos(root, refuse_doubt=True)
    given = {"position": f"{STATE}[0:3]", "joint_position": None, "command_position": None}
    demo = open_demos(root, mapping=given, refuse_doubt=True)[0]
    np.testing.assert_allclose(demo.position, episodes[0][0], atol=1e-6)


def test_another_rate_is_refused_and_the_same_rate_keeps_the_changes(recorded, tmp_path):
    root = write(tmp_path / "set", recorded("measured"))
    with pytest.raises(
        DatasetError, match="changes per step, which would be wrong at another frame rate"
    ):
        repair_dataset(root, tmp_path / "out", RepairOptions(fps=50))
    repair_dataset(root, tmp_path / "out", RepairOptions(trim=False))
    found = load_demos(tmp_path / "out", units={"command_position": "rad"})[0]
    np.testing.assert_allclose(found.command_position, recorded("measured")[0][1], atol=1e-6)


def test_two_estimates_of_one_scale_change_nothing_in_a_merge(recorded, tmp_path):
    first, second = recorded("target"), recorded("target", stiffness=100.0)
    roots = [write(tmp_path / f"{k}", e, scale=LARGEST) for k, e in enumerate((first, second))]
    units = {unit for root in roots for unit in units_of_commands(root)}
    assert len(units) == 2
    merge_datasets(roots, tmp_path / "out")
    found = load_demos(tmp_path / "out", units={"command_position": f"{LARGEST} rad/step"})
    for demo, (_, action, _) in zip(found, (*first, *second), strict=True):
        added = demo.command_position - demo.joint_position
        np.testing.assert_allclose(added, action, atol=1e-6)


def units_of_commands(root):
    parts = check_dataset(root).contract.components
    return {part.unit for part in parts if part.role == "command"}


def test_changes_and_positions_are_not_merged(recorded, tmp_path):
    roots = [write(tmp_path / kind, recorded(kind)) for kind in ("position", "measured")]
    with pytest.raises(DatasetError, match=r"rad/step.*one cannot be converted to the other"):
        merge_datasets(roots, tmp_path / "out")


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("rad/step", 1.0),
        ("deg/step", np.pi / 180),
        ("0.05 rad/step", 0.05),
        ("2e-3 rad/step", 0.002),
        ("1.5e+02 rad/step", 150.0),
    ],
)
def test_units_of_changes(unit, factor):
    assert unit_factor("command_position", unit) == pytest.approx(factor)


@pytest.mark.parametrize(
    "unit", ["m/s/step", "x rad/step", "rad/steps", "/step", "0 rad", "1e999 rad"]
)
def test_units_of_changes_that_do_not_exist(unit):
    with pytest.raises(DatasetError, match="does not come in"):
        unit_factor("command_position", unit)
    with pytest.raises(DatasetError, match="does not come in"):
        unit_factor("joint_position", "rad/step")


LIBERO = ["x", "y", "z", "axis_angle1", "axis_angle2", "axis_angle3", "gripper", "gripper"]


def test_names_of_libero():
    """HuggingFaceVLA/libero: angles count from 1, both fingers have one name."""
    state = Feature(key=STATE, dtype="float32", shape=(8,), names=tuple(LIBERO))
    action = dataclasses.replace(state, key=ACTION, shape=(7,), names=tuple(LIBERO[:7]))
    found = map_columns({STATE: state, ACTION: action}).selections
    columns = {role: [index for _, index in one.columns] for role, one in found.items()}
    assert columns == {"position": [0, 1, 2], "rotation_vector": [3, 4, 5], "gripper": [6]}


@pytest.mark.parametrize("name", ["delta_x", "ee.dx", "delta_joint_1", "relative_yaw", "drz"])
def test_names_of_changes_are_no_joints(name):
    names = (*(f"joint_{i}" for i in range(3)), name)
    features = {
        key: Feature(key=key, dtype="float32", shape=(len(own),), names=own)
        for key, own in ((STATE, names[:3]), (ACTION, (name, "delta_z", "gripper")))
    }
    assert "command_position" not in map_columns(features).selections


def followed(slope, *, names=None, unit="rad", fps=50.0, fit=0.95, position=0.1):
    """Decisions on commands whose sum the joints follow with these slopes [1/s]."""
    width = len(slope)
    slope = np.array(slope, float)
    fits = np.where(np.isnan(slope), np.nan, fit)

    def tracking(fit):
        flat = np.full(201, 0.5, np.float32)
        rest = np.full(width, np.nan)
        return Tracking(delay=0, residual=flat, slope=slope, fit=fit, offset=rest)

    columns = ColumnMapping(
        selections={
            role: ColumnSelection(
                role=role,
                columns=tuple((key, k) for k in range(width)),
                labels=tuple(names or (f"joint_{k + 1}" for k in range(width))),
                numbered=names is None,
            )
            for role, key in (("joint_position", STATE), ("command_position", "action"))
        },
        joint_names=(),
        extra=(),
        notes=(),
        unmatched={},
    )
    known = {"rates": tracking(fits), "command_position": tracking(np.full(width, position))}
    decisions = {
        role: UnitDecision(role=role, unit=unit, guessed=True, evidence="small")
        for role in columns.selections
    }
    return _meaning_of_commands(columns, decisions, [known] * 3, fps)


@pytest.mark.parametrize(
    ("scale", "unit"),
    [
        (1.0, "rad/step"),
        (0.11, "rad/step"),
        (0.099, "0.099 rad/step"),
        (1.49, "rad/step"),
        (1.51, "1.5 rad/step"),
        (0.02, "0.02 rad/step"),
        (150.0, "1.5e+02 rad/step"),
    ],
)
def test_changes_have_the_scale_of_the_motion_they_make(scale, unit):
    found = followed([50 * scale] * 6)
    assert [*found] == ["command_position"]
    command = found["command_position"]
    assert (command.unit, command.units, command.guessed) == (unit, (), True)
    text = f"the joints follow the sum of the commands ({scale:.2g} rad per unit, R2 0.95), so"
    assert command.evidence.startswith(text)
    assert command.steps.all()
    assert command.factor == pytest.approx(1.0 if unit == "rad/step" else scale, rel=0.01)


@pytest.mark.parametrize(
    ("rate", "told"), [(0.66, False), (0.67, True), (1.0, True), (1.49, True), (1.51, False)]
)
def test_velocities_among_the_changes_are_told(rate, told):
    command = followed([rate] * 6)["command_position"]
    assert ("(velocities in rad/s: map them to command_velocity)" in command.evidence) == told


def test_a_gripper_that_does_not_follow_keeps_its_unit():
    names = ("a", "b", "c", "d", "e", "gripper")
    found = followed([50.0] * 5 + [np.nan], names=names)["command_position"]
    assert found.units == ("rad/step",) * 5 + ("rad",)
    assert found.unit == "rad/step"
    # Without names of its own it comes last; other joints at rest are no grippers.
    assert followed([50.0] * 5 + [np.nan])["command_position"].units[-1] == "rad"
    other = followed([50.0] * 5 + [np.nan], names=("a", "b", "c", "d", "e", "f"))
    assert other["command_position"].units == ()
    inner = followed([np.nan, *[50.0] * 5], names=("gripper", *names[:5]))["command_position"]
    assert inner.units == ("rad", *["rad/step"] * 5)
    # One that follows moves by changes, too.
    assert followed([50.0] * 6, names=names)["command_position"].units == ()


def test_few_columns_without_names_that_move_by_changes_may_be_a_pose():
    for count, doubted in ((4, True), (5, False)):
        found = followed([50.0] * count)
        assert ("joint_position" in found) == doubted
    joints = followed([50.0] * 4)["joint_position"]
    assert joints.confidence == 0.5
    assert joints.evidence.startswith(
        "small; the commands are changes, so these 4 columns without"
    )
    assert "joint_position" not in followed([50.0] * 4, names=tuple("abcd"))


def test_commands_that_no_joint_follows_are_doubted_without_names():
    found = followed([5.0] * 6, fit=0.3)["command_position"]
    assert (found.confidence, found.leader, found.unit) == (0.3, "", "rad")
    assert found.evidence == "action names no components, and the joints do not follow it"
    assert followed([5.0] * 6, fit=0.3, names=tuple("abcdef")) == {}
    assert followed([1.0] * 6, position=0.9) == {}
