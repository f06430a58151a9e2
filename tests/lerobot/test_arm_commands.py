"""LeRobot's own commands with the Pandas, offline, each in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hrc_learn.lerobot.policy.policy_base import read_episodes

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
COMMANDS = Path(sys.executable).parent
DISCOVER = "--robot.discover_packages_path=hrc_learn.lerobot"
ROBOT = ("--robot.type=mujoco_arm", "--robot.scenario=grasping", "--robot.fps=10")
SEEN = "--robot.pixels=true"


def run(home, command, *arguments):
    environment = os.environ | {
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        "HF_LEROBOT_HOME": str(home),
    }
    done = subprocess.run(
        [*command, *map(str, arguments)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


def lerobot(home, name, *arguments):
    return run(home, [str(COMMANDS / f"lerobot-{name}")], *arguments)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two episodes by the expert. LeRobot ends them by the clock: they may be cut short."""
    home = tmp_path_factory.mktemp("home")
    lerobot(
        home,
        "record",
        DISCOVER,
        *ROBOT,
        SEEN,
        "--robot.episode_time=9",
        "--teleop.type=arm_expert",
        "--dataset.repo_id=local/grasping",
        f"--dataset.root={home / 'set'}",
        "--dataset.single_task=grasp the box",
        "--dataset.fps=10",
        "--dataset.num_episodes=2",
        "--dataset.episode_time_s=9",
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    return home


@pytest.fixture(scope="module")
def shown(recorded):
    """Two whole demonstrations, recorded in simulated time."""
    program = [sys.executable, str(ROOT / "datasets/record_expert.py")]
    run(
        recorded,
        program,
        *("--out", recorded / "shown"),
        *("--scenario", "grasping"),
        *("--episodes", 2),
        *("--config", "robot.fps=10"),
        *("--json", recorded / "shown.json"),
    )
    assert json.loads((recorded / "shown.json").read_text())["episodes"] == 2
    return recorded / "shown"


@pytest.fixture(scope="module")
def policy(recorded, shown):
    """Fitted in closed form, its actions smoothed."""
    program = [sys.executable, str(ROOT / "training/fit_dmp.py"), "--as-lerobot-policy"]
    run(recorded, program, "--dataset", shown, "--out", recorded / "policy")
    program = [sys.executable, str(ROOT / "training/smooth_actions.py")]
    limits = recorded / "limits.json"
    run(
        recorded,
        program,
        *("--checkpoint", recorded / "policy"),
        *("--dataset", shown),
        *("--json", limits),
    )
    assert min(json.loads(limits.read_text()).values()) > 0
    return recorded / "policy"


def test_each_episode_begins_anew(recorded):
    state = "observation.state"
    first, second = read_episodes(recorded / "set", [state, "action"])
    # Both begin above the table, open, each with an object elsewhere.
    assert first[state][0, :7].tolist() == pytest.approx(
        second[state][0, :7].tolist(), abs=1e-3
    )
    assert (first[state][0, -2:] - second[state][0, -2:]).abs().max() > 5
    assert (first["action"][1] - first[state][0, :8]).abs().max() < 0.1


def test_recording_in_simulated_time_makes_the_same_columns(recorded, shown):
    theirs, ours = (
        json.loads((folder / "meta/info.json").read_text())["features"]
        for folder in (recorded / "set", shown)
    )
    assert ours == theirs
    lengths = {len(episode["action"]) for episode in read_episodes(shown, ["action"])}
    assert lengths == {72}


def test_what_was_recorded_can_be_replayed_and_led(recorded):
    lerobot(
        recorded,
        "replay",
        DISCOVER,
        *ROBOT,
        "--dataset.repo_id=local/grasping",
        f"--dataset.root={recorded / 'set'}",
        "--dataset.episode=0",
        "--play_sounds=false",
    )
    lerobot(
        recorded,
        "teleoperate",
        DISCOVER,
        *ROBOT,
        "--teleop.type=arm_expert",
        "--fps=10",
        "--teleop_time_s=1",
    )


def test_a_policy_is_rolled_out_and_evaluated_with_smooth_actions(recorded, policy):
    told = lerobot(
        recorded,
        "rollout",
        DISCOVER,
        *ROBOT,
        SEEN,
        f"--policy.path={policy}",
        "--fps=10",
        "--duration=2",
        "--task=grasp the box",
        "--play_sounds=false",
    )
    assert "smooth actions:" in told
    told = lerobot(
        recorded,
        "eval",
        "--env.discover_packages_path=hrc_learn.lerobot",
        "--env.type=mujoco_arm",
        "--env.task=grasping",
        "--env.pixels=true",
        "--env.fps=10",
        "--env.episode_length=10",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--policy.path={policy}",
        f"--output_dir={recorded / 'evaluation'}",
    )
    assert "smooth actions:" in told
    (file,) = (recorded / "evaluation").glob("eval_info.json")
    assert json.loads(file.read_text())["overall"]["pc_success"] == 0  # it had one second
