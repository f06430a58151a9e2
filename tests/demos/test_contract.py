"""The contract of a dataset describes its columns, and readers obey it."""

import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest
from clean_sets import SETS, write_set
from commands import done, hrc
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import (
    DatasetError,
    RepairOptions,
    check_dataset,
    load_demos,
    repair_dataset,
)
from hrc_learn.demos.read.contract import ComponentContract, Contract, keep_contract
from hrc_learn.demos.read.metadata import SIDECAR_PATH, Feature
from hrc_learn.demos.read.source import open_dataset

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

STATE = "observation.state"
NAMES = ["shoulder.pos", "elbow.pos", "gripper.pos"]
FPS, BEHIND = 20, 4
"""Frames a second, and by how many the state follows its command."""


def motion(seed, frames=240):
    """Commands of two joints [deg] and a gripper, and what follows them."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames + BEHIND) / FPS
    rates, phases = rng.uniform(0.5, 1.2, 2), rng.uniform(0, 6, 2)
    arm = [60.0, 40.0] * np.sin(rates * time[:, None] + phases)
    gripper = np.where(np.sin(1.1 * time + seed) > 0, 1.0, 0.0)[:, None]
    ahead = np.concatenate([arm, gripper], axis=1)
    return {STATE: ahead[:-BEHIND], "action": ahead[BEHIND:]}


@pytest.fixture
def root(tmp_path):
    names = {STATE: NAMES, "action": NAMES}
    return write_folder(tmp_path / "set", [motion(i) for i in range(4)], names, fps=FPS)


def kept(root):
    contract = check_dataset(root).contract
    assert contract is not None
    return contract


def keep_inferred_contract(root):
    """Output of the command that stores the inferred contract."""
    return hrc("check", "--dataset", root, "--keep-contract").output


def named(contract, key, name):
    (part,) = (p for p in contract.components if (p.key, p.name) == (key, name))
    return part


def test_it_says_role_unit_range_sign_and_delay(root):
    contract = kept(root)
    for name, size in (("shoulder.pos", 60), ("elbow.pos", 40)):
        state, command = (named(contract, key, name) for key in (STATE, "action"))
        assert (state.role, state.unit) == ("arm", "deg")
        assert (command.role, command.unit, command.sign) == ("command", "deg", 1)
        assert command.delay == pytest.approx(BEHIND / FPS, abs=0.5 / FPS)  # seconds
        assert state.high == pytest.approx(size, rel=0.05)
        assert state.low == pytest.approx(-size, rel=0.05)


def test_who_reads_obeys_what_was_edited(root):
    contract = kept(root)
    guessed = load_demos(root)[0].joint_position
    edited = [
        replace(part, unit="rad") if part.role in ("arm", "command") else part
        for part in contract.components
    ]
    keep_contract(root, replace(contract, components=tuple(edited)))
    read = load_demos(root)[0].joint_position
    np.testing.assert_allclose(np.deg2rad(read[:, :2]), guessed[:, :2], rtol=1e-5)


def test_data_that_changed_since_are_told(root, tmp_path):
    keep_contract(root, kept(root))
    assert not any("changed since" in issue.message for issue in check_dataset(root).warnings)
    names = {STATE: NAMES, "action": NAMES}
    other = write_folder(tmp_path / "other", [motion(i) for i in range(9, 13)], names, fps=FPS)
    keep_contract(other, kept(root))
    assert any("changed since" in issue.message for issue in check_dataset(other).warnings)


def test_a_contract_is_renewed_and_says_what_was_edited_or_is_told_now(root, tmp_path):
    contract = kept(root)
    edited = [
        replace(part, name="first.pos", unit="rad") if part.name == "shoulder.pos" else part
        for part in contract.components
    ]
    names = {STATE: NAMES, "action": NAMES}
    other = write_folder(tmp_path / "other", [motion(i) for i in range(9, 13)], names, fps=FPS)
    keep_contract(other, replace(contract, components=tuple(edited)))
    done("check", other, "--keep-contract")
    assert not any("changed since" in issue.message for issue in check_dataset(other).warnings)
    first = named(kept(other), STATE, "first.pos")
    assert (first.role, first.unit) == ("arm", "rad")
    assert load_demos(other)[0].joint_names[0] == "first"
    units = ("--units", "joint_position", "deg", "command_position", "deg")
    shown = done("check", other, *units, "--keep-contract").output
    assert "first.pos .. elbow.pos" in shown
    parts = [named(kept(other), key, "first.pos") for key in (STATE, "action")]
    assert [(part.role, part.unit) for part in parts] == [("arm", "deg"), ("command", "deg")]


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("index", "0", r"contract.components\[0\].index: expected int, got str"),
        ("index", -1, r"contract.components\[0\].index: expected int >= 0"),
        ("index", 1, r"contract: component 1 of action is listed 2 times"),
        ("name", None, r"contract.components\[0\].name: expected str, got null"),
        ("low", None, r"contract.components\[0\].low: expected float, got null"),
        ("sign", 2, r"contract.components\[0\].sign: unknown value 2"),
        ("sign", True, r"contract.components\[0\].sign: expected int, got bool"),
        ("role", "tentacle", r"contract.components\[0\]: .*unknown role 'tentacle'; known are"),
        ("key", "nowhere", "contract: nowhere/.* is no component of the dataset"),
    ],
)
def test_an_entry_that_was_edited_wrongly_is_named(root, place, value, message):
    content = asdict(kept(root))
    parts = sorted(content["components"], key=lambda entry: (entry["key"], entry["index"]))
    content["components"] = [parts[0] | {place: value}, *parts[1:]]
    edit_sidecar(root, contract=content)
    with pytest.raises(DatasetError, match=f"{SIDECAR_PATH}[:,] {message}"):
        load_demos(root)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"format": 2}, "format: "),
        ({"units": {"position": 5}}, r"units\[...\]: expected str, got int"),
        ({"columns": {"joint_position": {"key": STATE}}}, "columns.*lacks the field names"),
        ({"contract": [1]}, "contract: expected object, got array"),
        (
            {"contract": {"components": [{"key": STATE}]}},
            r"contract.components\[0\]: lacks the field index",
        ),
    ],
)
def test_a_sidecar_that_was_edited_wrongly_is_refused(root, said, message):
    edit_sidecar(root, **said)
    with pytest.raises(DatasetError, match=f"{SIDECAR_PATH}: {message}"):
        load_demos(root)


def edit_sidecar(root, **said):
    keep_contract(root, kept(root))
    file = root / SIDECAR_PATH
    file.write_text(json.dumps(json.loads(file.read_text()) | said))


@pytest.fixture
def hand(tmp_path):
    """Three joints within some degrees and two fingers [1], with a contract that says so."""
    values = np.concatenate([5 * joint_path(60, 3), 0.5 + 0.4 * joint_path(60, 2)], axis=1)
    names = ["j1", "j2", "j3", "finger_1", "finger_2"]
    root = write_folder(tmp_path / "hand", [{STATE: values, "action": values}], {STATE: names})
    units = dict(zip(names, ["deg"] * 3 + ["1"] * 2, strict=True))
    contract = kept(root)
    parts = [
        replace(part, role="finger" if unit == "1" else "arm", unit=unit)
        for part in contract.components
        if part.key == STATE
        for unit in (units[part.name],)
    ]
    keep_contract(root, replace(contract, components=tuple(parts)))
    return root


@pytest.mark.parametrize(
    "mapping",
    [
        ["finger_1", "j1", "j2", "j3", "finger_2"],
        ["j3", "finger_2"],
        f"{STATE}[0:3]",
        f"{STATE}[3:5]",
    ],
)
def test_units_stay_with_the_columns_that_a_mapping_puts_in_order(hand, mapping):
    every = load_demos(hand)
    mapped = load_demos(hand, mapping={"joint_position": mapping})
    expected = every[0].select_joints(mapped.joint_names)
    np.testing.assert_array_equal(mapped[0].joint_position, expected.joint_position)
    # Check and repair read them alike.
    mapping = {"joint_position": mapping}
    said = [str(issue) for issue in check_dataset(hand, mapping=mapping).errors]
    assert said == [str(issue) for issue in check_dataset(hand).errors]
    options = RepairOptions(trim=False, dry_run=True)
    assert repair_dataset(hand, hand / "new", options, mapping=mapping).changed == 0


def test_columns_keep_their_unit_as_another_quantity(hand):
    joints = load_demos(hand)[0].select_joints(["j1", "j2", "j3"]).joint_position
    mapping = {"command_position": f"{STATE}[0:3]", "joint_position": None}
    np.testing.assert_array_equal(load_demos(hand, mapping=mapping)[0].command_position, joints)


CONVENTIONS = {
    "no names": {STATE: None, "action": None},
    "leader and follower": {
        STATE: ["left.pos", "right.pos", "gripper.pos"],
        "action": ["l.pos", "r.pos", "g.pos"],
    },
    "ALOHA": {
        key: ["waist", "elbow", "gripper"]
        for key in (STATE, "observation.velocity", "observation.effort", "action")
    },
    "a pose": {
        STATE: ["x", "y", "z", "qx", "qy", "qz", "qw"],
        "action": ["a.vel", "b.vel", "c.vel"],
    },
    "what no name explains": {STATE: NAMES, "observation.other": ["spam", "egg"]},
}


def of_convention(folder, names):
    def values(key, seed):
        width = len(names[key] or NAMES)
        x = joint_path(60, width, seed)
        if width == 7:
            x[:, 3:] /= np.linalg.norm(x[:, 3:], axis=1, keepdims=True)
        return x

    episodes = [{key: values(key, seed) for key in names} for seed in range(3)]
    return write_folder(folder, episodes, names)


def same(first, second):
    assert first.joint_names == second.joint_names
    for one, other in zip(first, second, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_equal(vars(other)[name], values, err_msg=name)


@pytest.mark.parametrize("names", CONVENTIONS.values(), ids=CONVENTIONS)
def test_a_first_contract_changes_nothing_that_is_read(tmp_path, names):
    root = of_convention(tmp_path / "set", names)
    before = load_demos(root)
    assert "edit it there" in keep_inferred_contract(root)
    same(before, load_demos(root))


@pytest.mark.parametrize("options", SETS.values(), ids=SETS)
def test_a_first_contract_of_sound_sets_says_their_units(tmp_path, options):
    root = write_set(tmp_path / "set", **options)
    before = load_demos(root)
    keep_inferred_contract(root)
    same(before, load_demos(root))
    assert not any("no unit declared" in i.message for i in check_dataset(root).warnings)


def test_fit_evaluate_and_repair_report_that_data_changed(root, tmp_path):
    keep_inferred_contract(root)
    names = {STATE: NAMES, "action": NAMES}
    other = write_folder(tmp_path / "other", [motion(i) for i in range(5)], names, fps=FPS)
    shutil.copyfile(root / SIDECAR_PATH, other / SIDECAR_PATH)
    model, before = tmp_path / "model", (other / SIDECAR_PATH).read_bytes()
    for command in (
        ("fit", "--dataset", other, "--out", model, "--n-basis", 10),
        ("evaluate", "--model", model, "--dataset", other),
    ):
        assert "changed since" in " ".join(done(*command).output.split())
    assert open_dataset(root).contract_note is None
    report = repair_dataset(other, tmp_path / "new", RepairOptions(dry_run=True))
    assert "changed since" in " ".join(report.notes)
    assert (other / SIDECAR_PATH).read_bytes() == before


def test_what_only_names_tell_is_not_called_declared(tmp_path):
    names = ["ee.x", "ee.y", "ee.z", "ee.qw", "ee.qx", "ee.qy", "ee.qz"]
    pose = np.concatenate([joint_path(240, 3), np.tile([1.0, 0.0, 0.0, 0.0], (240, 1))], axis=1)
    contract = kept(write_folder(tmp_path / "set", [{STATE: pose}], {STATE: names}, fps=FPS))
    part = named(contract, STATE, "ee.qw")
    assert (part.role, part.evidence) == ("quaternion_wxyz", "by its name")
    assert part.confidence < 1


def part(name="a", index=0, key=STATE, role="arm", unit="rad", **more):
    return ComponentContract(
        **{"key": key, "index": index, "name": name, "role": role, "unit": unit}
        | {"low": -1.0, "high": 2.0, **more}
    )


JOINT = "arm"


def test_similar_neighbours_are_one_row():
    contract = Contract(
        components=(
            part("a", 0, confidence=0.9, evidence="strong"),
            part("b", 1, low=-3.0, high=1.0, confidence=0.6, evidence="weak"),
            part("c", 2, unit="deg", low=4.0, high=5.25),
            part("d", 0, key="action", sign=-1, delay=0.04),
            part("e", 1, key="action", role="other", unit="", sign=1),
        )
    )
    assert contract.rows() == [
        ("column", "role", "unit", "range", "sign", "delay", "sure", "evidence"),
        (f"{STATE}/a .. b", JOINT, "rad", "-3 .. 2", "", "", "60 %", "weak"),
        (f"{STATE}/c", JOINT, "deg", "4 .. 5.25", "", "", "100 %", ""),
        ("action/d", JOINT, "rad", "-1 .. 2", "-", "40 ms", "100 %", ""),
        ("action/e", "other", "-", "-1 .. 2", "+", "", "100 %", ""),
    ]
    lines = [*contract.lines()]
    assert len(lines) == 5
    assert " ".join(lines[3].split()) == "action/d arm rad -1 .. 2 - 40 ms 100 %"


def test_components_are_listed_once_and_have_known_roles():
    with pytest.raises(ValueError, match=f"component 1 of {STATE} is listed 2 times"):
        Contract(components=(part(index=0), part(index=1), part("b", 1)))
    with pytest.raises(ValueError, match="a has the unknown role 'hat'; known are"):
        part(role="hat")


FEATURES = {
    STATE: Feature(key=STATE, dtype="float32", shape=(3,), names=("a.pos", "b.pos", "c")),
    "bare": Feature(key="bare", dtype="float32", shape=(3,), names=None),
}


def test_quantities_are_read_in_the_order_of_the_contract():
    contract = Contract(
        components=(
            part("b.pos", 1, unit="deg"),
            part("a.pos", 0),
            part("c", 2, role="other", unit=""),
            *(part(f"joint_{k}", k, key="bare", role="position", unit="m") for k in (2, 0, 1)),
        )
    )
    found = contract.selections(FEATURES)
    assert found["joint_position"].columns == ((STATE, 1), (STATE, 0))
    assert found["joint_position"].labels == ("b", "a")
    assert not found["joint_position"].numbered
    assert found["position"].columns == (("bare", 2), ("bare", 0), ("bare", 1))
    assert found["position"].numbered
    assert contract.units(found) == {"joint_position": ("deg", "rad"), "position": ("m",) * 3}
    # A column of unknown unit leaves its quantity out, as one that is not listed does.
    doubtful = replace(
        contract, components=(part("b.pos", 1, unit=""), *contract.components[1:])
    )
    assert doubtful.units(found) == {"position": ("m",) * 3}
    assert Contract(components=contract.components[1:]).units(found) == {"position": ("m",) * 3}


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ([part("x", 3)], f"{STATE}/x is no component of the dataset; edit it"),
        ([part("x", 0, key="none")], "none/x is no component of the dataset"),
        (
            [part(str(k), k, key="bare", role="position", unit="m") for k in range(2)],
            "position has 2 components, but needs 3",
        ),
    ],
)
def test_components_that_do_not_fit_the_dataset(parts, text):
    with pytest.raises(DatasetError, match=text):
        Contract(components=tuple(parts)).selections(FEATURES)


def test_a_new_contract_keeps_names_roles_and_units_that_were_edited():
    old = Contract(
        components=(
            part("A", 0, role=JOINT, unit="deg"),
            part("B", 1, role="other", unit="N"),
            part("C", 2, role="flag", unit=""),
        )
    )
    new = Contract(
        components=(
            part("a", 0, unit="rad"),
            part("b", 1, role="other", unit=""),
            part("c", 2, role=JOINT, unit="rad"),
            part("d", 3, role="other", unit="m"),
        )
    )
    kept = new.keeping(old)
    assert [(p.name, p.role, p.unit) for p in kept.components] == [
        ("A", JOINT, "rad"),
        ("B", "other", "N"),
        ("C", JOINT, "rad"),
        ("d", "other", "m"),
    ]


@pytest.mark.parametrize(("confidence", "doubtful"), [(0.74, True), (0.75, False)])
def test_doubtful_units_are_left_out(confidence, doubtful):
    sure = part("a", 0)
    unsure, none = part("b", 1, confidence=confidence), part("c", 2, unit="", confidence=0.1)
    contract, named = Contract(components=(sure, unsure, none)).without_doubt()
    assert [p.unit for p in contract.components] == ["rad", "" if doubtful else "rad", ""]
    assert named == [f"{STATE}/b"] * doubtful
