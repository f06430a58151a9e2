"""Hulls of shapes against SciPy's, their smallest capsules, and pairs that need no watching."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hrc_learn.kinematics import CapsuleArm, LinkCapsule, panda
from hrc_learn.kinematics.capsule_fit import (
    Hull,
    _left_out,
    _smallest_capsule,
    capsule_volume,
    fit_body,
    fit_link,
    hull_of,
    principal_axes,
    shape_points,
)
from hrc_learn.kinematics.description import Shape

SIZES = {
    "box": (0.1, 0.05, 0.02),
    "cylinder": (0.05, 0.2),
    "sphere": (0.07, 0.0),
    "capsule": (0.04, 0.15),
}


def support(kind, size, direction):
    """How far a shape reaches along a unit vector [m]."""
    x, y, z = np.abs(direction)
    if kind == "box":
        return size @ np.abs(direction)
    radius, half = size
    return half * z + radius * (np.hypot(x, y) if kind == "cylinder" else 1.0)


@pytest.mark.parametrize("kind", SIZES)
def test_points_of_a_shape_contain_it_closely(kind):
    size = np.array(SIZES[kind])
    points = shape_points(Shape(pose=np.eye(4), kind=kind, size=tuple(size)))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach = (points @ directions.T).max(axis=0)
    true = np.array([support(kind, size, d) for d in directions])
    assert (reach >= true - 1e-12).all()
    # A prism is 2 % wider at its corners; a ball is in a cube.
    most = {"box": 1 + 1e-12, "cylinder": 1.0197}.get(kind, math.sqrt(3) + 1e-12)
    assert (reach / true).max() <= most
    for axis in np.eye(3)[[0, 2]]:
        along = support(kind, size, axis)
        span = (points @ axis).max() / along, (points @ axis).min() / along
        np.testing.assert_allclose(span, (1, -1), rtol=0.0197)
    assert np.abs(points[:, 2]).max() == pytest.approx(support(kind, size, [0, 0, 1]))


def clouds(count=5, points=20):
    """Hulls of random points, in any pose."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        yield rng.normal(size=(points, 3)) * [0.3, 0.1, 0.05]


def box_hull(half, turn=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    pose[:3, 3] = at
    return hull_of(Shape(pose=pose, kind="box", size=half))


def test_a_hull_has_the_corners_and_edges_of_its_shape():
    turn, at = np.array([0.3, -0.8, 0.5]), np.array([1.0, 2.0, 3.0])
    hull = box_hull((0.1, 0.2, 0.3), turn, at)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = Rotation.from_rotvec(turn).apply(signs * (0.1, 0.2, 0.3)) + at
    assert len(hull.points) == 8
    apart = np.linalg.norm(hull.points[:, None] - corners, axis=-1)
    assert apart.min(axis=0).max() < 1e-12
    # The twelve edges of a box, and a diagonal across each of its six faces.
    lengths = np.linalg.norm(hull.edges[:, 1] - hull.edges[:, 0], axis=1)
    assert len(lengths) == 18
    for length in (0.2, 0.4, 0.6):
        assert np.isclose(lengths, length).sum() == 4
    assert len({tuple(np.sort(e.round(9), axis=0).ravel()) for e in hull.edges}) == 18


@pytest.mark.parametrize("level", [-0.1, 0.0, 0.15])
def test_parts_of_a_hull_between_planes_make_up_the_whole(level):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    for points in clouds():
        shape = ConvexHull(points)
        edges = np.concatenate([shape.simplices[:, [i, i - 1]] for i in range(3)])
        hull = Hull(points[shape.vertices], points[edges])
        low, high = hull.between(axis, -9.0, level), hull.between(axis, level, 9.0)
        assert (low @ axis <= level + 1e-12).all()
        assert (high @ axis >= level - 1e-12).all()
        volumes = [ConvexHull(part).volume for part in (low, high)]
        assert sum(volumes) == pytest.approx(shape.volume, rel=1e-9)
        both = hull.between(axis, level, level + 0.02)
        slab = shape.volume - ConvexHull(hull.between(axis, level + 0.02, 9.0)).volume
        slab -= volumes[0]
        assert ConvexHull(both).volume == pytest.approx(slab, rel=1e-6)


def test_flat_shapes_have_an_edge_between_any_two_points():
    hull = box_hull((0.1, 0.2, 0.0))
    assert len(hull.edges) == 4 * 3 / 2
    cut = hull.between(np.array([1.0, 0, 0]), -0.05, 0.05)
    np.testing.assert_allclose(np.ptp(cut, axis=0), (0.1, 0.4, 0), atol=1e-12)


def outside(points, capsule):
    """How far points stick out of a capsule; negative inside."""
    start, end, radius = capsule
    way = end - start
    along = ((points - start) @ way / max(way @ way, 1e-30)).clip(0, 1)
    return np.linalg.norm(points - start - along[:, None] * way, axis=1) - radius


def test_the_capsule_around_a_capsule_is_that_one():
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = Rotation.from_rotvec([0.5, 1.0, -0.3])
    points = turn.apply(0.05 * directions + np.sign(directions[:, 2:]) * [0, 0, 0.2])
    start, end, radius = _smallest_capsule(points)
    assert outside(points, (start, end, radius)).max() < 1e-9
    assert radius == pytest.approx(0.05, rel=0.03)
    assert np.linalg.norm(end - start) == pytest.approx(0.4, rel=0.03)
    own = turn.inv().apply([start, end])
    np.testing.assert_allclose(np.abs(own[:, 2]), 0.2, atol=5e-3)
    np.testing.assert_allclose(own[:, :2], 0, atol=2e-3)


def test_capsules_hold_all_points_and_disks_become_balls():
    for points in clouds():
        capsule = _smallest_capsule(points)
        assert -2e-6 < outside(points, capsule).max() < 1e-9
        # No more than that of a ball about the middle.
        ball = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
        assert capsule_volume(capsule) < 1.1 * 4 / 3 * np.pi * ball**3
    angle = np.linspace(0, 2 * np.pi, 40)
    disk = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    start, end, radius = _smallest_capsule(disk)
    assert radius == pytest.approx(0.1, rel=0.02)
    assert np.linalg.norm(end - start) < 0.01


def test_the_volume_of_a_capsule_is_that_of_a_cylinder_and_a_ball():
    capsule = np.zeros(3), np.array([0.0, 0.3, 0.4]), 0.1
    assert capsule_volume(capsule) == pytest.approx(np.pi * (0.01 * 0.5 + 4 / 3 * 0.001))


def test_principal_axes_are_those_of_the_singular_value_decomposition():
    for points in clouds():
        axes = principal_axes(points)
        right = np.linalg.svd(points - points.mean(axis=0))[2][::-1]
        np.testing.assert_allclose(np.abs((axes * right).sum(axis=1)), 1, atol=1e-9)


def test_an_angle_is_cut_where_that_saves_a_fifth_of_the_volume():
    block = box_hull((0.1, 0.1, 0.11))
    assert len(fit_link([block])) == 1
    # An L of two slender bars: one capsule would be mostly empty.
    bars = [box_hull((0.3, 0.03, 0.03)), box_hull((0.03, 0.3, 0.03), at=(0.27, 0.3, 0.0))]
    fitted = fit_link(bars)
    assert 2 <= len(fitted) <= 3
    points = np.concatenate([bar.points for bar in bars])
    one = capsule_volume(_smallest_capsule(points))
    assert sum(map(capsule_volume, fitted)) < 0.8 * one
    rng = np.random.default_rng(3)
    for bar in bars:
        inside = rng.dirichlet(np.ones(8), 200) @ bar.points
        out = np.min([outside(inside, capsule) for capsule in fitted], axis=0)
        assert out.max() < 1e-9


def test_a_long_bar_of_two_thicknesses_is_cut_across():
    bars = [box_hull((0.3, 0.02, 0.02)), box_hull((0.1, 0.1, 0.1), at=(0.4, 0.0, 0.0))]
    fitted = fit_link(bars)
    assert len(fitted) > 1
    radii = sorted(radius for _, _, radius in fitted)
    assert radii[0] < 0.06 < radii[-1]


def test_links_without_shapes_have_capsules_from_joint_to_joint():
    arm = fit_body(panda, [])
    steps = [m[:3, 3].numpy() for m in (*panda.mounts, panda.flange, panda.tcp)]
    lengths = [np.linalg.norm(step) for step in steps]
    radius = min(0.045, 0.06 * sum(lengths))
    expected = {
        k: step for k, (step, n) in enumerate(zip(steps, lengths, strict=True)) if n > 0
    }
    found = {c.link: c for c in arm.capsules}
    assert found.keys() <= expected.keys() | set(range(9))
    for link, capsule in found.items():
        assert capsule.radius == pytest.approx(radius)
        np.testing.assert_allclose(capsule.start, 0)
        np.testing.assert_allclose(capsule.end, steps[link], atol=1e-12)
    shape = Shape(pose=np.eye(4), kind="sphere", size=(0.06, 0.0))
    some = {c.link: c for c in fit_body(panda, [(4, shape)]).capsules}
    assert some[4].radius == 0.06
    # Steps shorter than the radius are inside their neighbours.
    assert some.keys() - {4} == {k for k, n in enumerate(lengths) if n > radius and k != 4}


def balls(**radii):
    """Balls at the frames of links, by the number of the link."""
    return [
        LinkCapsule(link=int(link[1:]), start=(0.0,) * 3, end=(0.0,) * 3, radius=radius)
        for link, radius in radii.items()
    ]


@pytest.mark.parametrize(
    "capsules",
    [
        balls(l1=0.05, l3=0.05, l5=0.05, l7=0.05),
        balls(l0=0.05, l2=0.2, l4=0.25, l6=0.2, l9=0.05),
        balls(l1=0.02, l3=0.16, l4=0.16, l6=0.3, l8=0.1, l9=0.1),
        balls(l5=0.03, l6=0.03, l8=0.03, l9=0.03),
    ],
)
def test_pairs_that_always_or_never_touch_need_no_watching(capsules):
    """Judged by other postures than those of the fit."""
    left_out = set(_left_out(panda, capsules))
    body = CapsuleArm(panda, capsules)
    rng, limits = np.random.default_rng(5), panda.limits
    q = torch.from_numpy(rng.uniform(limits.lower.numpy(), limits.upper.numpy(), (3000, 7)))
    distances = body.pair_distances(q).numpy()
    for (a, b), distance in zip(body.pairs, distances.T, strict=True):
        i, k = sorted((body.links[a], body.links[b]))
        overlaps, nearest = (distance < 0).mean(), distance.min()
        one_body = k > 7 and i >= 6
        # Of links with one link between them, most postures are enough.
        most = 0.5 if min(k, 7) - i == 2 else 0.99
        if one_body:
            assert (i, k) in left_out
        elif abs(overlaps - most) > 0.01 and abs(nearest - 0.1) > 0.02:
            assert ((i, k) in left_out) == (overlaps > most or nearest > 0.1), (i, k)
