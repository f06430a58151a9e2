"""Recordings of demonstrations, fits and rounds of learning, read again."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rrd_reading import Rrd
from sample_runs import LIMITS, NAMES

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.demos.dataset_views import DatasetArm
from hrc_learn.demos.read.units import UnitDecision
from hrc_learn.demos.videos import CameraImages
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    EvidenceResult,
    EvidenceRound,
    ImageJacobianFitConfig,
    RBFCenters,
    RBFImageJacobian,
    cross_validate,
)
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.drawing import arm_bodies
from hrc_learn.learning import fit_dashboards, fit_primitives
from hrc_learn.learning.demonstration_dashboard import (
    ShownDataset,
    _episode_tab,
    demonstration_layout,
    record_demonstrations,
)
from hrc_learn.learning.fit_dashboards import (
    ShownFit,
    fit_report,
    record_fit,
    record_learning,
    shown_fit,
)
from hrc_learn.learning.visual_servo_fitting import feature_trajectories
from hrc_learn.skills.visual_skill import VisualServoSkill


def demonstration(episode: int, steps: int, **changes) -> Demonstration:
    time = np.arange(steps) / 50
    motion = 0.1 * np.sin(time[:, None] + np.arange(7) + episode)
    values = {
        "joint_names": panda.joint_names,
        "joint_position": panda.ready.numpy() + motion,
        "feature": np.stack([100 + time, 200 - time], axis=-1),
        "feature_visible": (time < 0.06) | (time > 0.11),
        "human_effort": np.ones((steps, 7)),
        "gripper": np.full(steps, 0.04),
    }
    values |= changes
    return Demonstration(episode=episode, task="place", fps=50, time=time, **values)


@pytest.fixture(scope="module")
def demos() -> DemonstrationSet:
    way = np.stack([np.linspace(0, 1, 90), np.zeros(90), np.ones(90)], axis=-1)
    second = demonstration(5, 90, human_effort=None, feature=None, position=way)
    return DemonstrationSet([demonstration(2, 100), second, demonstration(7, 80)])


def panda_of(columns=range(7), unit="rad") -> DatasetArm:
    decision = UnitDecision(role="joint_position", unit=unit)
    return DatasetArm(arm=panda, columns=tuple(columns), joints=decision)


@pytest.fixture(scope="module")
def rrd(demos, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("rrd") / "demos.rrd"
    record_demonstrations(path, ShownDataset(title="Placing", demos=demos, arm=panda_of()))
    return Rrd(path)


def tool_path(demo: Demonstration) -> np.ndarray:
    return panda.forward(torch.from_numpy(demo.joint_position)).position.numpy()


def test_each_episode_has_a_timeline_with_all_that_was_recorded(demos, rrd):
    for demo in demos:
        timeline = f"episode {demo.episode}"
        joints = rrd.scalars("episode/joint_4", timeline)
        np.testing.assert_array_equal(joints[:, 0], demo.joint_position[:, 4])
        np.testing.assert_array_equal(rrd.scalars("episode/gripper", timeline)[:, 0], 0.04)
        bounds = rrd.scalars("episode/joint_0/limits", timeline)
        assert bounds[0].tolist() == [
            float(panda.limits.lower[0]),
            float(panda.limits.upper[0]),
        ]
        assert rrd.column("task", "TextDocument:text", timeline=timeline) == [
            [f"Episode {demo.episode}: place"]
        ]
    assert len(rrd.scalars("episode/effort", "episode 5")) == 0
    np.testing.assert_array_equal(
        rrd.scalars("episode/effort", "episode 2"), demos[0].human_effort
    )
    v, seen = rrd.scalars("episode/feature", "episode 7")[:, 1], demos[2].feature_visible
    assert 0 < (~seen).sum() < len(seen)
    np.testing.assert_array_equal(v, np.where(seen, demos[2].feature[:, 1], np.nan))


def test_recorded_or_computed_paths_are_drawn_and_the_arm_moves(demos, rrd):
    for demo in demos:
        path = tool_path(demo) if demo.position is None else demo.position
        entity = f"world/paths/{demo.episode}"
        ((strip,),) = rrd.column(entity, "LineStrips3D:strips", static=True)
        np.testing.assert_allclose(strip, path, atol=1e-6)
        last = rrd.column(f"world/now/{demo.episode}", "Points3D:positions")[-1]
        np.testing.assert_allclose(last[0], path[-1], atol=1e-6)
        for body in arm_bodies(panda, demo.joint_position):
            moved = np.array(
                rrd.column(
                    f"world/bodies/{body.name}",
                    "Transform3D:translation",
                    timeline=f"episode {demo.episode}",
                )
            )
            np.testing.assert_allclose(moved[-1, 0], body.position[-1], atol=1e-6)


def test_the_summary_lists_demonstrations_and_notes(rrd):
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    assert "# Placing" in text
    assert "| 5 | place | 1.78 | 90 | 1.00 |" in text


def test_images_are_those_of_the_episode_of_the_timeline(demos, tmp_path):
    def images(demo):
        blobs = (b"one", f"of {demo.episode}".encode())
        return {"front": CameraImages("jpeg", np.array([0.0, 0.5]), blobs)}

    shown = ShownDataset(title="Placing", demos=demos, images=images, cameras=["front"])
    record_demonstrations(tmp_path / "demos.rrd", shown)
    rrd = Rrd(tmp_path / "demos.rrd")
    for demo in demos:
        timeline = f"episode {demo.episode}"
        blobs = rrd.column("cameras/front", "EncodedImage:blob", timeline=timeline)
        assert bytes(blobs[1][0]) == f"of {demo.episode}".encode()
        np.testing.assert_allclose(rrd.time("cameras/front", timeline), [0.0, 0.5], atol=1e-9)


def test_joints_are_plotted_in_the_units_of_the_dataset(demos, tmp_path):
    """Degrees as degrees, with the limits; shares of a range as percents, without."""
    share = replace(demos[0], joint_position=np.full((len(demos[0]), 7), 0.5))
    for unit, demo, seen in (
        ("deg", demos[0], np.rad2deg(demos[0].joint_position[:, 3])),
        ("%", share, np.full(len(share), 50.0)),
    ):
        decision = UnitDecision(role="joint_position", unit=unit)
        shown = ShownDataset(
            title="",
            demos=DemonstrationSet([demo]),
            arm=panda_of(unit=unit),
            units={"joint_position": decision},
        )
        record_demonstrations(tmp_path / f"{unit}.rrd", shown)
        rrd = Rrd(tmp_path / f"{unit}.rrd")
        np.testing.assert_allclose(rrd.scalars("episode/joint_3", "time")[:, 0], seen)
        lower = rrd.scalars("episode/joint_3/limits", "time")[0, 0]
        if unit == "deg":
            assert lower == pytest.approx(np.rad2deg(-3.0718))
        else:
            assert np.isnan(lower)
        place = arm_bodies(panda, shown.arm.positions(demo.joint_position))[3].position[0]
        moved = rrd.column("world/bodies/link3", "Transform3D:translation")[0]
        np.testing.assert_allclose(moved[0], place, atol=1e-6)


@pytest.mark.parametrize("cameras", [0, 1, 4])
@pytest.mark.parametrize("arm", [panda_of(), None])
def test_the_arm_and_its_cameras_stand_left_of_curves_and_task(demos, cameras, arm):
    names = [f"camera {k}" for k in range(cameras)]
    shown = ShownDataset(title="", demos=demos, arm=arm, cameras=names)
    root = demonstration_layout(shown).root_container
    *left, right = root.contents
    views = list(left[0].contents) if left else []
    assert len(views) == (arm is not None) + bool(cameras)
    if left:
        assert tuple(root.column_shares) == (1, 1)
        assert tuple(left[0].row_shares) == (3, 2)[: len(views)]
    if arm is not None:
        scene, *views = views
        assert panda.name in scene.name
        # The arm is in view from its base to its tool.
        q = torch.from_numpy(demos[0].joint_position)
        joints = panda.joint_origins(q).reshape(-1, 3).numpy()
        everything = np.concatenate([np.zeros((1, 3)), joints, tool_path(demos[0])])
        (seen,) = scene.properties["EyeControls3D"].look_target.as_arrow_array().to_pylist()
        middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
        np.testing.assert_allclose(seen, middle, atol=1e-6)
    for grid in views:
        assert [view.name for view in grid.contents] == names
        assert [view.origin for view in grid.contents] == [
            f"/cameras/camera_{k}" for k in range(cameras)
        ]
        assert grid.grid_columns == min(cameras, 3)
    tabs, task = right.contents
    assert tuple(right.row_shares) == (9, 1)
    assert (task.origin, tabs.active_tab) == ("/task", 0)
    assert [tab.name.split(":")[0] for tab in tabs.contents] == ["Episode", "Episodes"]


def test_without_an_arm_there_is_no_scene(tmp_path):
    bare = dict.fromkeys(("feature", "human_effort", "gripper"))
    one = demonstration(0, 20, joint_names=tuple(f"arm_{i}" for i in range(7)), **bare)
    shown = ShownDataset(title="", demos=DemonstrationSet([one]))
    record_demonstrations(tmp_path / "bare.rrd", shown)
    rrd = Rrd(tmp_path / "bare.rrd")
    assert {e for e in rrd.entities if e.startswith("world")} == {"world"}
    assert "episode/joint_0" in rrd.entities
    assert "episode/joint_0/limits" not in rrd.entities


@pytest.mark.parametrize(("joints", "columns"), [(3, 1), (4, 2)])
def test_more_than_three_plots_stand_in_two_columns(joints, columns):
    bare = dict.fromkeys(("feature", "feature_visible", "human_effort", "gripper"))
    names = tuple(f"arm_{i}" for i in range(joints))
    values = {"joint_names": names, "joint_position": np.ones((20, joints))}
    one = demonstration(0, 20, **(values | bare))
    tab = _episode_tab(ShownDataset(title="", demos=DemonstrationSet([one])), one)
    assert (len(tab.plots), tab.columns) == (joints, columns)
    assert not any(plot.legend for plot in tab.plots)


def sample_fit(**changes) -> ShownFit:
    """Three demonstrations of different lengths."""
    times = tuple(np.linspace(0.0, 2.0 + i, 80 + 10 * i) for i in range(3))
    demos = tuple(np.sin(t[:, None] + np.arange(7)) for t in times)
    paths = tuple(demo[:, :3] for demo in demos)
    fit = ShownFit(
        title="Placing",
        names=NAMES,
        unit="rad",
        time=times,
        demos=demos,
        reproductions=tuple(demo + 1e-3 for demo in demos),
        paths=paths,
        reproduced_paths=tuple(path + 1e-3 for path in paths),
        limits=LIMITS,
        residual={10: 1e-2, 30: 1e-3, 50: 1e-4},
        n_basis=50,
    )
    return replace(fit, **changes)


@pytest.mark.parametrize("joints", [True, False])
def test_a_fit_is_shown_with_each_motion_at_its_own_length(demos, joints):
    names = panda.joint_names if joints else ("a1", "a2", "a3", "a4", "a5", "a6", "a7")
    named = [replace(demo, joint_names=names, position=None) for demo in demos]
    fit = shown_fit(fit_primitives(DemonstrationSet(named), 30, channels=["joint"]), "Fit")
    assert [len(demo) for demo in fit.demos] == [100, 90, 80]
    for demo, shown, made in zip(named, fit.demos, fit.reproductions, strict=True):
        np.testing.assert_array_equal(shown, demo.joint_position)
        np.testing.assert_allclose(made, shown, atol=0.01)
    assert (fit.limits is not None) == joints
    assert len(fit.paths) == 3 * joints
    if joints:
        np.testing.assert_allclose(fit.paths[1], tool_path(named[1]), atol=1e-9)


def test_the_report_shows_demonstrations_and_reproductions():
    report = fit_report(sample_fit(), [], {"n_basis": 50}, "hrc fit")
    (joints,) = report.pictures
    assert joints.name == "joints"
    drawn = [axes for axes in joints.drawing.axes if axes.axison]
    assert len(drawn) == 7
    labels = [line.get_label() for line in drawn[0].get_lines()]
    assert labels.count("demonstration") == labels.count("reproduction") == 3


def test_demonstrations_and_reproductions_are_recorded(tmp_path):
    fit = sample_fit()
    record_fit(tmp_path / "fit.rrd", fit)
    rrd = Rrd(tmp_path / "fit.rrd")
    assert rrd.blueprints == 1
    for i, time in enumerate(fit.time):
        for j, name in enumerate(NAMES):
            root = f"demonstration_{i + 1}/{name}"
            demo, done = rrd.scalars(f"{root}/demonstration"), rrd.scalars(f"{root}/position")
            np.testing.assert_array_equal(demo[:, 0], fit.demos[i][:, j])
            np.testing.assert_array_equal(done[:, 0], fit.reproductions[i][:, j])
            np.testing.assert_allclose(rrd.time(f"{root}/position"), time, atol=1e-9)
        error = rrd.scalars(f"demonstration_{i + 1}/error")
        np.testing.assert_allclose(error, 1.0, atol=1e-9)  # 1 mrad everywhere
    (strips,) = rrd.column("world/demonstrations", "LineStrips3D:strips", static=True)
    assert [len(strip) for strip in strips] == [len(path) for path in fit.paths]


def test_the_summary_lists_every_residual(tmp_path):
    record_fit(tmp_path / "fit.rrd", sample_fit())
    ((text,),) = Rrd(tmp_path / "fit.rrd").column("summary", "TextDocument:text", static=True)
    for line in ("# Placing", "| 50 (used) | 0.0001 |", "| 10 | 0.01 |", "| 2 | 3.00 | 1 |"):
        assert line in text.splitlines()


def test_only_the_first_demonstrations_get_a_tab(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_dashboards, "_MOST_TABS", 2)
    record_fit(tmp_path / "fit.rrd", sample_fit())
    entities = Rrd(tmp_path / "fit.rrd").entities
    shown = {e.split("/")[0] for e in entities if e.startswith("demonstration_")}
    assert shown == {"demonstration_1", "demonstration_2"}


def test_a_fit_of_an_unknown_robot_has_no_paths(tmp_path):
    fit = sample_fit(paths=(), reproduced_paths=(), limits=None, residual={})
    record_fit(tmp_path / "fit.rrd", fit)
    entities = Rrd(tmp_path / "fit.rrd").entities
    assert not {e for e in entities if e.startswith("world/")}
    assert not {e for e in entities if e.endswith("/limits")}


@pytest.fixture(scope="module")
def watched() -> DemonstrationSet:
    """Poses and pixels of a camera with a nearly constant image Jacobian."""
    rng, time = np.random.default_rng(0), np.arange(30) / 30
    demos = []
    for episode in range(4):
        way = 0.1 * np.sin(time[:, None] * rng.uniform(0.5, 2, 3) + rng.uniform(0, 6, 3))
        turn = 0.1 * np.sin(time[:, None] * rng.uniform(0.5, 2, 3))
        pixels = 500 * (way[:, :2] + 0.3 * way[:, :2] * way[:, 2:]) + 200
        demos.append(
            Demonstration(
                episode=episode,
                fps=30,
                time=time,
                position=way + np.array([0.5, 0.0, 0.3]),
                orientation=quaternion.exp(torch.from_numpy(turn)).numpy(),
                feature=pixels,
                feature_visible=np.full(30, True),
            )
        )
    return DemonstrationSet(demos)


@pytest.fixture(scope="module")
def skill(watched):
    """Fit of the watched demonstrations, with three made-up rounds of learning."""
    rng = torch.Generator().manual_seed(0)
    rounds = tuple(
        EvidenceRound(
            evidence=1.0 - k,
            held_out_error=error,
            neurons=RBFCenters(
                centers=torch.randn(4, 3, generator=rng).double(),
                width=0.1 + 0.01 * k,
                input_indices=(0, 1, 2),
            ),
            config=ImageJacobianFitConfig(pixel_noise=0.5 - 0.1 * k),
        )
        for k, error in enumerate((0.5, 0.2, 0.4))
    )
    camera, config = feature_trajectories(watched), ImageJacobianFitConfig()
    network = RBFImageJacobian.fit(camera, RBFCenters.around(camera), config)
    return VisualServoSkill(
        jacobian=network,
        target=None,
        learned=EvidenceResult(rounds=rounds, best=1),
        cells=cross_validate(camera, network, config).by_cell(),
    )


@pytest.fixture(scope="module")
def learning(skill, watched, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("learning") / "fit.rrd"
    record_learning(path, skill, watched, "Image Jacobian")
    return Rrd(path)


def test_every_round_is_one_step_and_the_one_kept_is_marked(skill, learning):
    learned, error = skill.learned, "learning/Error_on_held_out_demonstrations_px"
    errors = [state.held_out_error for state in learned.rounds]
    np.testing.assert_array_equal(learning.scalars(error)[:, 0], errors)
    np.testing.assert_array_equal(learning.scalars(f"{error}/kept"), [[errors[learned.best]]])
    assert learning.column(error, "round") == list(range(len(errors)))
    assert learning.column(f"{error}/kept", "round") == [learned.best]
    widths = [float(state.neurons.width) for state in learned.rounds]
    name = "learning/Width_of_the_neurons_m_rad"
    np.testing.assert_allclose(learning.scalars(name)[:, 0], widths)


def test_cells_show_their_error_in_percent(skill, learning):
    (labels,) = learning.column("world/errors", "Boxes3D:labels", static=True)
    relative = skill.cells.relative[skill.cells.relative.isfinite()]
    assert labels == [f"{100 * value:.1f} %" for value in relative.tolist()]
    (centres,) = learning.column("world/errors", "Boxes3D:centers", static=True)
    (halves,) = learning.column("world/errors", "Boxes3D:half_sizes", static=True)
    edges = skill.cells.edges.numpy()
    low, high = np.subtract(centres, halves)[:, :2], np.add(centres, halves)[:, :2]
    np.testing.assert_allclose(low.min(axis=0), edges[0], atol=1e-6)
    np.testing.assert_allclose(high.max(axis=0), edges[-1], atol=1e-6)


def test_the_summary_says_what_was_kept_and_measured(skill, learning):
    ((text,),) = learning.column("summary", "TextDocument:text", static=True)
    rounds = skill.learned.rounds
    assert f"Round {skill.learned.best} of {len(rounds) - 1} was kept" in text
    assert f"| pairs | {skill.metrics()['pairs']:.4g} |" in text.splitlines()


def test_a_fit_without_rounds_shows_where_it_errs(skill, watched, tmp_path):
    record_learning(tmp_path / "fit.rrd", replace(skill, learned=None), watched, "Bare")
    rrd = Rrd(tmp_path / "fit.rrd")
    assert "world/errors" in rrd.entities
    assert not {e for e in rrd.entities if e.startswith("learning")}
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    assert "Round" not in text
