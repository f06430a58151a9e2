"""Every kind of broken copy is reported; none opens silently."""

import re
import shutil

import numpy as np
import pytest
from broken_copies import DEFECTS, HARMLESS, STATE, Copy
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import DatasetError, check_dataset, load_demos
from hrc_learn.demos.issues import Issue

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

NETWORK = re.compile(r"hub|network|internet|offline|download|connection", re.IGNORECASE)


VERSIONS = ("v3.0", "v2.1")


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """A sound set of each version."""
    return {version: write(tmp_path_factory, version) for version in VERSIONS}


def write(tmp_path_factory, version):
    motions = [joint_path(60, seed=i) for i in range(3)]
    episodes = [
        {STATE: q, "action": q + 0.01 * np.sin(np.arange(60))[:, None]} for q in motions
    ]
    names = ["motor0.pos", "motor1.pos", "motor2.pos"]
    root = tmp_path_factory.mktemp("sound") / "set"
    return write_folder(root, episodes, {STATE: names, "action": names}, version=version)


def copied(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "set")
    return Copy(tmp_path / "set")


@pytest.mark.parametrize("version", VERSIONS)
def test_the_sound_set_has_no_findings_but_guesses_of_units(sets, version):
    report = check_dataset(sets[version])
    assert report.ok
    assert not [w for w in report.warnings if "no unit" not in w.message]


def assert_place(found: Issue, defect, copy: Copy) -> None:
    versions_own = {
        "data": copy.data,
        "episodes": "meta/episodes" if copy.v3 else copy.episodes_file,
        "tasks": "meta/tasks.parquet" if copy.v3 else "meta/tasks.jsonl",
    }
    if defect.file is not None:
        assert found.file is not None
        assert found.file.endswith(versions_own.get(defect.file, defect.file))
    if defect.episode:
        assert found.episode == copy.episode
    if defect.frame is not None:
        assert found.frame == defect.frame
    if defect.key is not None:
        assert found.key is not None
        assert defect.key in found.key


# test_checker_score.py has the other version of many.
@pytest.mark.parametrize(
    ("name", "version"),
    [
        (name, version)
        for k, name in enumerate(DEFECTS)
        for version in (VERSIONS if DEFECTS[name].file else VERSIONS[k % 2 :][:1])
    ],
)
def test_every_defect_is_found_and_located(sets, tmp_path, name, version):
    copy, defect = copied(sets[version], tmp_path), DEFECTS[name]
    defect.damage(copy)
    report = check_dataset(copy.root)
    assert not NETWORK.search(str(report))
    findings = report.errors if defect.error else report.warnings
    found = [f for f in findings if re.search(defect.finding, f.message)]
    assert found, str(report)
    named = [f for f in found if f.episode == copy.episode] if defect.episode else found
    assert_place(named[0], defect, copy)
    # An arm that never moves shows nothing, which is an additional error.
    assert report.ok != (defect.error or name == "frozen state")
    if not defect.error:
        assert len(load_demos(copy.root)) == 3
        return
    with pytest.raises(DatasetError) as raised:
        load_demos(copy.root)
    assert not NETWORK.search(str(raised.value))
    if name != "one episode missing":  # its counts disagree, which is reported before the gap
        assert_place(raised.value.issue, defect, copy)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", HARMLESS)
def test_what_lerobot_stumbles_over_is_read_like_any_other(sets, tmp_path, name, version):
    copy = copied(sets[version], tmp_path)
    HARMLESS[name](copy)
    assert check_dataset(copy.root).ok
    assert load_demos(copy.root).joint_names == ("motor0", "motor1", "motor2")
