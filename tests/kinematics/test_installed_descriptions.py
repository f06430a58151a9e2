"""Arms by the names of descriptions in installed packages, and of robots in datasets."""

import pytest
from urdf_text import to_urdf

from hrc_learn.kinematics import ArmChoice, arm, panda
from hrc_learn.kinematics.registry import arm_of_robot, installed_descriptions


@pytest.fixture
def menagerie(tmp_path, monkeypatch):
    """A folder as mujoco-menagerie and robot_descriptions leave them, empty but for one arm."""
    for variable, name in (
        ("MENAGERIE_ROOT", "menagerie"),
        ("ROBOT_DESCRIPTIONS_CACHE", "descriptions"),
    ):
        monkeypatch.setenv(variable, str(tmp_path / name))
    folder = tmp_path / "menagerie" / "maker_heron_9x"
    folder.mkdir(parents=True)
    (folder / "heron9x.urdf").write_text(to_urdf(panda))
    (folder / "heron9x_mjx.urdf").write_text("not read")
    (folder / "scene.xml").write_text("<mujoco/>")
    return tmp_path


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_fetched_description_is_found_by_its_name(menagerie):
    found = arm("heron-9x")
    assert found.name == "heron-9x"
    assert found.description == menagerie / "menagerie/maker_heron_9x/heron9x.urdf"
    assert found.joints == 7


def test_two_descriptions_of_a_name_are_listed(menagerie):
    other = menagerie / "menagerie" / "other"
    other.mkdir()
    (other / "heron9x.urdf").write_text(to_urdf(panda))
    with pytest.raises(ValueError, match=r"several .*maker_heron_9x/heron9x.urdf, .*other/"):
        arm("heron9x")


def test_an_unknown_name_lists_what_there_is(menagerie):
    assert installed_descriptions("egret") == []
    with pytest.raises(ValueError, match=r"no arm 'egret': there are panda, fr3, .*URDF"):
        arm("egret")


def test_robot_types_of_lerobot_are_registered_arms():
    for kind in ("panda", "Franka", "franka_robot", "franka-emika-panda"):
        assert arm_of_robot(kind) is panda
    for kind in (None, "", "unknown", "koch_follower", "bi_so101_follower", "heron"):
        assert arm_of_robot(kind) is None
    assert arm_of_robot("mujoco_panda") is panda
    # Our simulated robots carry the hand of the work cell.
    assert arm_of_robot("mujoco_ur5e") is ArmChoice("ur5e").work_arm()
