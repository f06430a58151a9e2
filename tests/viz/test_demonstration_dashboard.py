from dataclasses import replace

import numpy as np
import pytest
from rrd_reading import Rrd
from sample_runs import LIMITS, NAMES, sample_run

from hrc_learn.viz import DemonstrationsRecording, ShownDemonstration
from hrc_learn.viz.demonstration_dashboard import record_demonstrations


def shown(episode: int, steps: int, **changes) -> ShownDemonstration:
    time = np.arange(steps) / 50
    feature = np.stack([100 + time, 200 - time], axis=-1)
    feature[3:6] = np.nan
    values = {
        "joint_position": np.sin(time[:, None] + np.arange(7) + episode),
        "position": np.stack([time, 0 * time, 0.5 + 0 * time], axis=-1),
        "feature": feature,
        "human_effort": np.ones((steps, 7)),
        "gripper": np.full(steps, 0.04),
    }
    return ShownDemonstration(episode=episode, task="place", time=time, **(values | changes))


@pytest.fixture(scope="module")
def demos() -> DemonstrationsRecording:
    bodies = sample_run().bodies
    steps = len(bodies[0].position)
    return DemonstrationsRecording(
        title="Placing",
        joint_names=NAMES,
        demonstrations=(
            replace(shown(2, steps), bodies=bodies),
            shown(5, 90, human_effort=None, feature=None),
            shown(7, 80),
        ),
        joint_limits=LIMITS,
        notes=("position: guessed to be in m",),
    )


@pytest.fixture(scope="module")
def rrd(demos, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("rrd") / "demos.rrd"
    record_demonstrations(path, demos, most=2)
    return Rrd(path)


def test_joints_and_features_of_all_lie_over_one_another(demos, rrd):
    for demo in demos.demonstrations:
        path = f"together/joint_position_4/{demo.episode}"
        np.testing.assert_array_equal(rrd.scalars(path)[:, 0], demo.joint_position[:, 4])
        np.testing.assert_allclose(rrd.time(path), demo.time, atol=1e-9)
    v = rrd.scalars("together/feature_1/7")[:, 0]
    np.testing.assert_array_equal(v, demos.demonstrations[2].feature[:, 1])
    assert "together/feature_1/5" not in rrd.entities
    np.testing.assert_array_equal(rrd.scalars("together/limits_0")[0], [-2.9, 2.9])


def test_the_first_have_tabs_with_what_was_recorded(demos, rrd):
    first = demos.demonstrations[0]
    np.testing.assert_array_equal(rrd.scalars("episode_2/effort"), first.human_effort)
    np.testing.assert_array_equal(rrd.scalars("episode_2/gripper")[:, 0], first.gripper)
    alone = {entity for entity in rrd.entities if entity.startswith("episode_")}
    both = {f"episode_{k}/{name}" for k in (2, 5) for name in ("joints", "position", "gripper")}
    assert alone == both | {"episode_2/feature", "episode_2/effort"}


def test_paths_are_drawn_and_the_arm_moves(demos, rrd):
    for demo in demos.demonstrations:
        ((strip,),) = rrd.column(
            f"world/paths/{demo.episode}", "LineStrips3D:strips", static=True
        )
        np.testing.assert_allclose(strip, demo.position, atol=1e-6)
        last = rrd.column(f"world/now/{demo.episode}", "Points3D:positions")[-1]
        np.testing.assert_allclose(last[0], demo.position[-1], atol=1e-6)
    moved = np.array(rrd.column("world/bodies/hand", "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(
        moved[-1], demos.demonstrations[0].bodies[0].position[-1], atol=1e-6
    )


def test_the_summary_lists_them(rrd):
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    assert "| 5 | place | 1.78 | 90 | 1.78 |" in text
    assert "- position: guessed to be in m" in text


def test_other_robots_and_little_that_was_recorded_do_too(tmp_path):
    bare = dict.fromkeys(("position", "feature", "human_effort", "gripper"))
    one = DemonstrationsRecording(
        title="", joint_names=NAMES, demonstrations=(shown(0, 20, **bare),)
    )
    record_demonstrations(tmp_path / "bare.rrd", one)
    rrd = Rrd(tmp_path / "bare.rrd")
    assert not {e for e in rrd.entities if e.startswith(("world/", "together/limits"))}
    assert "episode_0/joints" in rrd.entities


def test_what_cannot_be_shown_is_refused():
    torn = shown(3, 20)
    # Set afterwards, since the checks of array shapes in tests would speak first.
    object.__setattr__(torn, "gripper", np.zeros(4))
    with pytest.raises(ValueError, match="episode 3: gripper has 4 samples, but time has 20"):
        torn.__post_init__()
    with pytest.raises(ValueError, match="no demonstration to show"):
        DemonstrationsRecording(title="", joint_names=NAMES, demonstrations=())
