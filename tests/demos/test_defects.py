"""Every kind of broken copy is reported; none opens silently."""

import re
import shutil

import numpy as np
import pytest
from broken_copies import DEFECTS, HARMLESS, STATE, Copy
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import DatasetError, Issue, check_dataset, load_demos

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

NETWORK = re.compile(r"hub|network|internet|offline|download|connection", re.IGNORECASE)


@pytest.fixture(scope="module", params=["v3.0", "v2.1"])
def sound(tmp_path_factory, request):
    motions = [joint_path(60, seed=i) for i in range(3)]
    episodes = [
        {STATE: q, "action": q + 0.01 * np.sin(np.arange(60))[:, None]} for q in motions
    ]
    names = ["motor0.pos", "motor1.pos", "motor2.pos"]
    root = tmp_path_factory.mktemp("sound") / "set"
    write_folder(root, episodes, {STATE: names, "action": names}, version=request.param)
    return root


@pytest.fixture
def copy(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "set")
    return Copy(tmp_path / "set")


def test_the_sound_set_has_no_findings_but_guesses_of_units(sound):
    report = check_dataset(sound)
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


@pytest.mark.parametrize("name", DEFECTS)
def test_every_defect_is_found_and_located(copy, name):
    defect = DEFECTS[name]
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


@pytest.mark.parametrize("name", HARMLESS)
def test_what_lerobot_stumbles_over_is_read_like_any_other(copy, name):
    HARMLESS[name](copy)
    assert check_dataset(copy.root).ok
    assert load_demos(copy.root).joint_names == ("motor0", "motor1", "motor2")
