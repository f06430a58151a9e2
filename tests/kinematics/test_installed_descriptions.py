"""Arms by the names of descriptions in installed packages, and of robots in datasets."""

import pytest
from urdf_text import to_urdf

from hrc_learn.kinematics import ArmChoice, MissingModelError, arm, fr3, panda, registry
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
    for kind in ("panda", "Franka", "franka_robot", "franka-emika-panda", "franka_panda"):
        assert arm_of_robot(kind) is panda
    for kind in (None, "", "unknown", "koch_follower", "bi_so101_follower", "heron"):
        assert arm_of_robot(kind) is None
    assert arm_of_robot("mujoco_panda") is panda
    # Our simulated robots carry the hand of the work cell.
    assert arm_of_robot("mujoco_ur5e") is ArmChoice("ur5e").work_arm()
    assert arm_of_robot("franka_research_3") is fr3


@pytest.mark.parametrize("kind", ["viperx_follower", "mujoco_viperx"])
def test_a_robot_whose_description_is_not_installed_is_unknown(kind, monkeypatch):
    def locate(name, package, file):
        raise MissingModelError("not installed", name=package)

    monkeypatch.setattr(registry, "_locate", locate)
    for name in ("_registered", "_equipped"):  # without what is cached
        monkeypatch.setattr(registry, name, getattr(registry, name).__wrapped__)
    assert arm_of_robot(kind) is None


@pytest.mark.skipif(arm_of_robot("xarm7") is None, reason="extra meshes")
def test_people_type_names_as_they_know_them():
    names = {"xarm": "xarm7", "ufactory_xarm7": "xarm7", "Universal-Robots UR5": "ur5"}
    names |= {"unitree_z1": "z1", "SO-101": "so101", "so100": "so100", "xarm_robot": "xarm7"}
    for typed, name in names.items():
        assert arm(typed).name == name
        typed_arm, named = ArmChoice(typed).work_arm(), ArmChoice(name).work_arm()
        assert typed_arm.hand_size == named.hand_size
        assert typed_arm.flange.equal(named.flange)
    assert arm_of_robot("so100_follower") is arm("so101")
    assert arm_of_robot("xarm6") is None
