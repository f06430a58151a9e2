"""The contract of a dataset: what it says of its columns, and that readers obey it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from lerobot_folders import write_folder

from hrc_learn.demos import DatasetError, check_dataset, load_demos
from hrc_learn.demos.read.contract import contract_content, keep_contract

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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"role": "tentacle"}, "unknown role 'tentacle'; known are"),
        ({"key": "nowhere"}, "nowhere/shoulder.pos is no component"),
    ],
)
def test_a_contract_that_makes_no_sense_is_refused(root, change, message):
    contract = kept(root)
    first, *others = contract.components
    broken = replace(contract, components=(replace(first, **change), *others))
    keep_contract(root, broken)
    with pytest.raises(DatasetError, match=message):
        load_demos(root)


def test_what_is_kept_is_plain_json(root):
    content = contract_content(kept(root))
    assert json.loads(json.dumps(content)) == content
