"""A plug-in of pytest that puts what is ours into LeRobot's own tests.

- Everything is registered, so whatever goes through all that is registered meets ours.
- Tests of all available policies are run for ours too.
- Tests of calibration, teleoperation, recording and replay are run again with our simulated
  robot and its scripted expert, and with that robot led by a smooth one.
- Environments that LeRobot's tests make by name are joined by ours.

`tools/run_lerobot_tests.py` uses it.
"""

import pytest

POLICIES = ("dmp", "motion_chunk")
FPS = 30.0
"""Of LeRobot's tests, whose policies are made without a dataset that would tell."""
PAIRS = ("mock", "mujoco_arm", "smooth")


def pytest_configure(config):
    import hrc_learn.lerobot  # noqa: F401  registers ours


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(collector, name, obj):
    """Lengthen the lists that tests are made from, before the first is made."""
    if not isinstance(collector, pytest.Module):
        return
    module = collector.obj
    policies = getattr(module, "AVAILABLE_POLICIES", None)
    if policies is not None and POLICIES[0] not in policies:
        policies.extend(POLICIES)
        module.make_policy_config = _knowing_the_rate(module.make_policy_config)
    environments = getattr(module, "AVAILABLE_ENVS", None)
    if environments is not None and "mujoco_arm" not in environments:
        environments.append("mujoco_arm")
        from tests import utils

        # LeRobot looks for a package gym_NAME, and skips the test where there is none.
        available = utils.is_package_available

        def found(pkg_name, *more, **options):
            return pkg_name == "gym_mujoco_arm" or available(pkg_name, *more, **options)

        utils.is_package_available = found


def _knowing_the_rate(make):
    def made(name, **settings):
        if name in POLICIES:
            settings["fps"] = FPS
        return make(name, **settings)

    return made


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__.endswith("test_control_robot"):
        metafunc.fixturenames.append("put_in_pair")
        metafunc.parametrize("put_in_pair", PAIRS, indirect=True)


@pytest.fixture
def put_in_pair(request, monkeypatch, tmp_path):
    """A robot and a teleoperator in the place of LeRobot's mocks."""
    if request.param == "mock":
        return
    from hrc_learn.lerobot.arm_teleoperators import ArmExpertConfig
    from hrc_learn.lerobot.mujoco_arm import MujocoArmRobotConfig
    from hrc_learn.lerobot.smoothing import ActionLimits, SmoothRobotConfig

    def panda():
        return MujocoArmRobotConfig(scenario="grasping", fps=FPS, calibration_dir=tmp_path)

    def smooth():
        from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot

        names = list(MujocoArmRobot(panda()).action_features)
        ones, unlimited = [1.0] * len(names), [None] * len(names)
        limits = ActionLimits(
            names=names,
            fps=FPS,
            velocity=ones,
            acceleration=[5.0] * len(names),
            jerk=[100.0] * len(names),
            lower=unlimited,
            upper=unlimited,
            state_columns=[-1] * len(names),
        )
        limits.save(tmp_path / "limits.json")
        return SmoothRobotConfig(
            of="mujoco_arm",
            options={"scenario": "grasping", "fps": 2 * FPS},
            limits=tmp_path / "limits.json",
            rate=2 * FPS,
            clock="actions",
            calibration_dir=tmp_path,
        )

    robot = panda if request.param == "mujoco_arm" else smooth
    monkeypatch.setattr(request.module, "MockRobotConfig", robot)
    monkeypatch.setattr(
        request.module, "MockTeleopConfig", lambda: ArmExpertConfig(calibration_dir=tmp_path)
    )
