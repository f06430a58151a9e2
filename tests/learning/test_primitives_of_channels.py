"""Primitives of channels as their kinds fit them, and the errors of what they reproduce."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetWriter, Demonstration, DemonstrationSet, open_demos
from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP, mean_primitive
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import arm_angle, fr3, panda
from hrc_learn.learning.primitive_fitting import (
    EACH,
    Motions,
    fit_primitives,
    fit_streamed,
    load_primitive,
)

LENGTHS = (60, 45)


def demonstration(episode, **more):
    """A hand and two joints, with noise that a smooth fit does not follow."""
    frames = LENGTHS[episode]
    rng = np.random.default_rng(episode)
    s = np.linspace(0, 1, frames)
    way = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    noise = 1e-3 * rng.normal(size=(frames, 3))
    turns = Rotation.from_rotvec(way * (0.1, 0.5 + 0.2 * episode, -0.3))
    given = {
        "time": (1.5 + episode) * s,
        "position": way * (0.3, 0.1 + 0.1 * episode, -0.2) + noise + np.array([0.3, 0.0, 0.4]),
        "orientation": turns.as_quat(scalar_first=True),
        "joint_position": way * (0.8, -0.4) + noise[:, :2],
        "joint_names": ("hip", "knee"),
        "fps": 40,
        "episode": episode,
    }
    return Demonstration(**(given | more))


@pytest.fixture(scope="module")
def demos():
    return DemonstrationSet([demonstration(0), demonstration(1)], source="here")


@pytest.fixture(scope="module")
def fitted(demos):
    return fit_primitives(demos, 12, channels=("joint", "position", "orientation", "pose"))


def by_hand(demos, channel, **options):
    """The kind's own fit of padded columns with their mask."""
    padded = demos.padded()
    time, mask = padded.time, padded.mask
    if channel == "joint":
        names = {"joint_names": ("hip", "knee"), "units": "rad"}
        return JointDMP.fit(time, padded.joint_position, 12, mask=mask, **names, **options)
    if channel == "position":
        names = {"joint_names": ("x", "y", "z"), "units": "m"}
        return JointDMP.fit(time, padded.position, 12, mask=mask, **names, **options)
    if channel == "orientation":
        return OrientationDMP.fit(time, padded.orientation, 12, mask=mask, **options)
    return PoseDMP.fit(time, padded.position, padded.orientation, 12, mask=mask, **options)


@pytest.mark.parametrize("channel", ["joint", "position", "orientation", "pose"])
def test_fits_are_smooth_and_take_up_a_goal_over_six_tenths(fitted, demos, channel):
    own = fitted.each[channel]
    expected = by_hand(demos, channel, method="trajectory", smooth=True, approach=0.6)
    torch.testing.assert_close(own.motion.coordinates(), expected.motion.coordinates())
    assert own.motion.response.approach == 0.6
    assert own.motion.joint_names == expected.motion.joint_names
    assert own.motion.units == expected.motion.units
    common = mean_primitive(expected)
    torch.testing.assert_close(
        fitted.common[channel].motion.coordinates(), common.motion.coordinates()
    )


def test_options_of_a_fit_reach_it(demos):
    rough = fit_primitives(demos, 12, "ridge", channels=("joint",), smooth=False, approach=1.0)
    expected = by_hand(demos, "joint", method="ridge", smooth=False, approach=1.0)
    own = rough.each["joint"]
    torch.testing.assert_close(own.coordinates(), expected.coordinates())
    # A scaled forcing has the approach of its kind.
    scaled = fit_primitives(demos, 12, channels=("joint",), scaling="paper").each["joint"]
    expected = by_hand(demos, "joint", method="trajectory", smooth=True, scaling="paper")
    torch.testing.assert_close(scaled.weights, expected.weights)
    assert scaled.response.approach == expected.response.approach != 0.6
    assert fit_primitives(demos, channels=("joint",)).n_basis == 60


def test_numbers_of_functions_are_twice_the_shortest_demonstration_at_most(demos):
    chosen = fit_primitives(demos, None, channels=("joint",), candidates=(10, 22, 23))
    assert chosen.selection is not None
    assert chosen.selection.candidates == (10, 22)
    assert chosen.n_basis == chosen.selection.count
    with pytest.raises(ValueError, match=r"has 45 samples, too few .* from 23, 30: give"):
        fit_primitives(demos, None, channels=("joint",), candidates=(23, 30))


@pytest.mark.parametrize("channel", ["joint", "position", "orientation", "pose"])
def test_the_mean_is_compared_at_the_ends_and_durations_of_each(fitted, demos, channel):
    motions, common = fitted.motions, fitted.common[channel]
    made = motions.adapted(channel, common)
    for i, demo in enumerate(demos):
        n = len(demo)
        time = torch.from_numpy(demo.time)
        ends = [
            {
                "joint": lambda k, demo=demo: torch.from_numpy(demo.joint_position[k]),
                "position": lambda k, demo=demo: torch.from_numpy(demo.position[k]),
                "orientation": lambda k, demo=demo: torch.from_numpy(demo.orientation[k]),
                "pose": lambda k, demo=demo: Pose(
                    torch.from_numpy(demo.position[k]), torch.from_numpy(demo.orientation[k])
                ),
            }[channel](k)
            for k in (0, -1)
        ]
        with torch.no_grad():
            alone = common.rollout(time, *ends, time[-1])
        for name in ("position", "orientation"):
            if hasattr(alone, name):
                torch.testing.assert_close(
                    getattr(made, name)[i, :n], getattr(alone, name), rtol=0, atol=1e-8
                )
    error = motions.error(channel, made)
    if channel != "orientation":
        assert error.goal_error is not None
        assert error.goal_error.max() < 1e-3
    else:
        assert error.nrmse is None


def test_metrics_are_those_of_each_and_of_the_mean(fitted):
    metrics = fitted.metrics()
    assert (metrics["demonstrations"], metrics["basis_functions"]) == (2.0, 12.0)
    motions = fitted.motions
    own = motions.error("position", fitted.each["position"].rollout())
    mean = motions.error("position", motions.adapted("position", fitted.common["position"]))
    for prefix, error in (("position", own), ("mean_position", mean)):
        for name in ("nrmse", "largest", "goal_error", "jerk"):
            values = getattr(error, name).detach().numpy()
            median = metrics[f"{prefix}_{name}_median"]
            assert median == pytest.approx(np.median(values))
            assert metrics[f"{prefix}_{name}_max"] == pytest.approx(values.max())
    assert own.nrmse.max() < mean.nrmse.max()


def test_single_primitives_are_written_on_request(fitted, tmp_path):
    fitted.save(tmp_path / "mean")
    fitted.save(tmp_path / "all", each=True)
    assert not (tmp_path / "mean" / EACH).exists()
    for folder in ("mean", "all"):
        loaded = load_primitive(tmp_path / folder / "joint", "joint")
        torch.testing.assert_close(loaded.weights, fitted.common["joint"].weights)
    both = load_primitive(tmp_path / "all" / EACH / "joint", "joint")
    torch.testing.assert_close(both.weights, fitted.each["joint"].weights)
    with pytest.raises(ValueError, match="PoseDMP"):
        load_primitive(tmp_path / "mean" / "joint", "pose")


def test_errors_are_of_valid_samples_relative_to_the_largest_range(demos):
    motions = Motions.of(demos)
    mask = motions.demos.mask
    shown, turn = motions.column("position"), motions.column("orientation")
    rng = np.random.default_rng(5)
    off = torch.from_numpy(rng.normal(-0.01, 0.01, shown.shape))  # the largest is negative
    tilt = rng.normal(0, 0.02, turn[..., 1:].shape)
    turned = [
        Rotation.from_rotvec(t) * Rotation.from_quat(q, scalar_first=True)
        for t, q in zip(tilt, turn.numpy(), strict=True)
    ]
    made = SimpleNamespace(
        position=torch.where(mask[..., None], shown + off, 50.0),
        orientation=torch.from_numpy(np.stack([r.as_quat(scalar_first=True) for r in turned])),
    )
    error = motions.error("pose", made)
    for i, n in enumerate(LENGTHS):
        e, angles = off[i, :n].numpy(), np.degrees(np.linalg.norm(tilt[i, :n], axis=1))
        span = np.ptp(shown[i, :n].numpy(), axis=0).max()
        expected = {
            "nrmse": np.sqrt(np.mean(e**2)) / span,
            "largest": np.abs(e).max(),
            "goal_error": np.linalg.norm(e[-1]),
            "turn_rmse": np.sqrt(np.mean(angles**2)),
            "turn_at_goal": angles[-1],
        }
        for name, value in expected.items():
            assert error.columns()[name][i].item() == pytest.approx(value, rel=1e-6), name
    assert error.jerk is not None
    assert (error.jerk > 1).all()


def panda_demos(**more):
    rng = np.random.default_rng(0)
    made = []
    for episode in range(2):
        at = np.linspace(0, 1, 30)[:, None]
        q = panda.ready.numpy() + at * rng.normal(0, 0.3, 7)
        given = {"joint_position": q, "joint_names": panda.joint_names}
        bare = {"position": None, "orientation": None, "time": at[:, 0]}
        made.append(demonstration(episode, **(given | bare | more)))
    return DemonstrationSet(made, source="here")


def test_the_pose_of_a_panda_has_the_arm_angle_as_body():
    motions = Motions.of(panda_demos())
    assert motions.missing("pose") == []
    pose = motions.fit("pose", 12)
    joints = motions.column("joint_position")
    tool = panda.forward(joints)
    torch.testing.assert_close(motions.column("position"), tool.position)
    padded = motions.demos
    expected = PoseDMP.fit(
        padded.time,
        tool.position,
        tool.orientation,
        12,
        body=arm_angle(panda, joints)[..., None],
        mask=padded.mask,
    )
    torch.testing.assert_close(pose.motion.coordinates(), expected.motion.coordinates())


def test_an_fr3_or_another_arm_has_no_pose_of_the_panda():
    for names, body in ((fr3.joint_names, True), (tuple("abcdefg"), False)):
        demos = panda_demos(joint_names=names)
        motions = Motions.of(demos)
        assert motions.missing("pose") == ["position", "orientation"]
        assert (motions._body_shape() is not None) == body
    fractions = Motions.of(DemonstrationSet(list(panda_demos()), joint_unit="1"))
    assert fractions.missing("pose")
    assert fractions._body_shape() is None


def test_arm_angles_are_continuous_and_start_in_one_turn(monkeypatch):
    angles = torch.tensor([[3.0, -3.1, -2.9], [-3.1, 3.1, 3.0], [0.2, 0.3, 0.4]]).double()
    motions = Motions.of(panda_demos())
    monkeypatch.setattr(
        "hrc_learn.learning.primitive_fitting.arm_angle", lambda chain, q: angles
    )
    whole = 2 * np.pi
    expected = [[3.0, whole - 3.1, whole - 2.9], [whole - 3.1, 3.1, 3.0], [0.2, 0.3, 0.4]]
    body = motions._body_shape()
    assert body is not None
    np.testing.assert_allclose(body[..., 0], expected)


def test_a_stream_fits_one_primitive_to_all(tmp_path):
    with DatasetWriter(tmp_path / "set", 40, "any", ["hip", "knee"]) as writer:
        for episode in range(2):
            demo = demonstration(episode)
            writer.start_episode("reach")
            for k in range(len(demo)):
                writer.add_frame(
                    joint_position=demo.joint_position[k], position=demo.position[k]
                )
            writer.save_episode()
    source = open_demos(tmp_path / "set")
    fits, metrics = fit_streamed(source, 10, channels=("joint", "position"))
    assert (metrics["demonstrations"], metrics["frames"]) == (2.0, float(sum(LENGTHS)))
    assert fits["joint"].joint_names == ("hip", "knee")
    assert fits["joint"].units == "rad"
    assert fits["position"].joint_names == ("x", "y", "z")
    assert fits["position"].units == "m"
    for channel, column in (("joint", "joint_position"), ("position", "position")):
        off = []
        for demo in source:
            time, shown = torch.from_numpy(demo.time), torch.from_numpy(getattr(demo, column))
            with torch.no_grad():
                made = fits[channel].rollout(time, shown[0], shown[-1], time[-1]).position
            off.append(made - shown)
        expected = torch.cat(off).square().mean().sqrt().item()
        assert metrics[f"mean_{channel}_rmse"] == pytest.approx(expected, rel=1e-3)
    assert list(fit_streamed(source, 10)[0]) == ["joint"]
