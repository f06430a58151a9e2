"""What the arm takes people's distances for, between two observations of them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sampling
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import ConstraintConfig, SafetyConfig, SeparationConfig
from hrc_learn.controller.contact_limits import ContactSpeeds
from hrc_learn.geometry import Box
from hrc_learn.kinematics import CapsuleArm, GraspedBox, panda, separation
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import (
    Imperfections,
    Worker,
    WorkerConfig,
    WorkerSensor,
    World,
    random_visit,
    whole_arm,
)
from hrc_learn.sim.recorded_world import WorkerDistance
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import as_load
from hrc_learn.skills.person_watch import (
    PersonWatch,
    PersonWatchConfig,
    watched_people,
)

WORKPLACE = Workplace()
VISIT = random_visit(
    Worker(WorkerConfig()),
    np.random.default_rng(5),
    bench=WORKPLACE.scene.table,
    under=WORKPLACE.table_centre,
)
SCENE = replace(WORKPLACE.scene, worker=VISIT.worker.config)
ARM = whole_arm(SCENE.arm)
HAND = PARTS.index("hand_right")
SEPARATION = SeparationConfig(reaction_time=0.03, clearance=0.05)
ALL = 10_000
NOWHERE_NEAR = 1.0


def observed(time=1.0, at=VISIT.released - 0.4, velocity=True):
    """On the way down to the bench, his hand and all of him in motion."""
    capsules = VISIT.capsules_at(at)
    moving = capsules.velocity if velocity else np.zeros_like(capsules.velocity)
    return PersonObservation(
        time=time, ends=capsules.ends, radius=capsules.radius, velocity=moving
    )


def watch(observation, *, acceleration=0.0, pairs=ALL):
    tracker = SimpleNamespace(read=lambda: observation)
    config = PersonWatchConfig(acceleration=acceleration, pairs=pairs, contact=-NOWHERE_NEAR)
    return PersonWatch(tracker, ARM, SEPARATION, config)


def distances_of(ends, radius, q, load=None):
    found = separation(ARM, q, torch.from_numpy(ends), torch.from_numpy(radius), load)
    return found.distance.flatten()


def test_nothing_seen_is_nothing_known():
    found = watch(None, pairs=8).look(0.0, WORKPLACE.hover_joints())
    assert not found.distances.known()
    assert found.distances.distance.shape == (8,)
    assert found.distances.person.all()
    assert np.isnan([found.nearest, found.age]).all()


def test_an_observation_of_no_person_leaves_the_arm_free():
    nobody = np.zeros((0, 2, 3))
    seen = PersonObservation(time=1.0, ends=nobody, radius=np.zeros(0), velocity=nobody)
    found = watch(seen, acceleration=5.0, pairs=8).look(1.1, WORKPLACE.hover_joints())
    assert found.distances.known()
    assert found.distances.closing_speed(ConstraintConfig(), SEPARATION).min() > 5.0
    assert found.speed_scale == 1.0
    assert found.nearest > 10.0
    assert found.age == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("ahead", "lost", "value", "known"),
    [
        (0.04, None, 0.0, True),
        (0.06, None, 0.0, False),
        (0.0, "ends", np.nan, False),
        (0.0, "velocity", np.nan, False),
        (0.0, "radius", np.nan, False),
        (0.0, "radius", np.inf, False),
        (0.0, "radius", -0.1, False),
        (0.0, "joints", np.nan, False),
    ],
)
def test_what_cannot_be_is_nothing_known(ahead, lost, value, known):
    """A tracker whose clock is ahead of the arm's, or that lost one of many body parts; or an
    encoder without a reading."""
    seen, joints = observed(), WORKPLACE.hover_joints()
    if lost == "joints":
        joints[3] = value
    elif lost is not None:
        broken = getattr(seen, lost).copy()
        broken[3] = value
        seen = replace(seen, **{lost: broken})
    pfl = replace(SEPARATION, mode="ssm+pfl")
    for person in (seen, replace(seen, regions=("hand",) * len(seen.ends))):
        tracker = SimpleNamespace(read=lambda person=person: person)
        found = PersonWatch(tracker, ARM, pfl).look(1.0 - ahead, joints)
        assert bool(found.distances.known()) == known
        assert math.isfinite(found.nearest) == known


def test_people_who_keep_their_speed_are_nowhere_nearer_than_thought():
    """Of an observation that is 0.2 s old, against where he really is by then."""
    q, age, reaction = WORKPLACE.hover_joints(), 0.2, 0.03
    seen = observed()
    found = watch(seen).look(seen.time + age, q)
    assert found.age == pytest.approx(age)
    assert found.nearest == pytest.approx(float(distances_of(seen.ends, seen.radius, q).min()))
    h = 1e-6
    before, after = (
        distances_of(seen.ends + s * seen.velocity, seen.radius, q) for s in (-h, h)
    )
    coming = ((before - after) / (2 * h)).clamp(min=0)
    now = distances_of(seen.ends, seen.radius, q)
    told = found.distances
    order = told.distance.argsort()
    expected, by = (now - age * coming).sort()
    torch.testing.assert_close(told.distance[order], expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(told.approach_speed[order], coming[by], rtol=0, atol=1e-5)
    # Also of who gets faster at once, as fast as it is said to be possible.
    hasty = watch(seen, acceleration=3.0).look(seen.time + age, q).distances
    gained = 3.0 * (age + reaction)
    assert hasty.approach_speed.max() == pytest.approx(float(coming.max()) + gained, abs=1e-5)
    assert (hasty.distance.sort().values <= expected + 1e-9).all()


def test_gradients_are_those_of_the_distances():
    q, seen = WORKPLACE.hover_joints(), observed(velocity=False)
    told = watch(seen).look(seen.time, q).distances
    h, rng = 1e-6, torch.Generator().manual_seed(0)
    way = torch.randn(7, generator=rng, dtype=torch.float64)
    plus, minus = (
        distances_of(seen.ends, seen.radius, q + s * way).sort().values for s in (h, -h)
    )
    order = told.distance.argsort()
    torch.testing.assert_close(
        told.gradient[order] @ way, (plus - minus) / (2 * h), rtol=0, atol=1e-5
    )


def test_a_held_box_is_kept_apart_too():
    """To the millimetres by which it is gripped: the simulator's own distance of the box."""
    world = World(SCENE)
    world.hold("box", WORKPLACE.home_joints().numpy())
    ends = VISIT.capsules_at(VISIT.released).ends
    below = world.object_pose("box")[:3, 3] - [0.01, 0.02, 0.2]
    hand = ends[HAND] - ends[HAND].mean(axis=0) + below
    ends = ends + 5.0
    ends[HAND] = hand
    world.move_worker(ends)
    true = WorkerDistance(world).now(world.held())
    assert true.arm_geom == "box"
    seen = PersonObservation(
        time=0.0, ends=ends, radius=VISIT.worker.radius, velocity=np.zeros_like(ends)
    )
    joints = torch.from_numpy(world.arm.read().joint_position)
    load = as_load(SCENE.objects[0])
    # Gripped along its x, which is the line of closing, the tool's y.
    a, b, c = SCENE.objects[0].half_size
    assert load == GraspedBox(half_size=(b, a, c))
    found = watch(seen).look(0.0, joints, load)
    assert found.nearest == pytest.approx(true.distance, abs=2e-3)
    assert watch(seen).look(0.0, joints).nearest > found.nearest + 5e-3


def somebody(seed: int) -> PersonObservation:
    """Capsules anywhere around the arm, at the speeds of people."""
    rng = sampling.generator(seed)
    low, high = torch.tensor([[-0.8, -0.8, 0.0], [0.8, 0.8, 1.2]], dtype=torch.float64)
    start = sampling.within(low, high, 12, rng=rng)
    end = start + 0.4 * sampling.directions(12, rng=rng)
    velocity = torch.randn(12, 2, 3, generator=rng, dtype=torch.float64)
    radius = 0.03 + 0.1 * torch.rand(12, generator=rng, dtype=torch.float64)
    return PersonObservation(
        time=2.0,
        ends=torch.stack([start, end], dim=1).numpy(),
        radius=radius.numpy(),
        velocity=velocity.numpy(),
    )


@pytest.mark.parametrize("load", [None, GraspedBox(half_size=(0.02, 0.03, 0.03))])
@pytest.mark.parametrize("seed", range(5))
def test_the_most_urgent_pairs_are_told_of_with_their_exact_distances(seed, load):
    person = somebody(seed)
    q = sampling.within(
        panda.limits.lower, panda.limits.upper, rng=sampling.generator(seed), margin=0.1
    )
    config = PersonWatchConfig(contact=-NOWHERE_NEAR)
    watch = PersonWatch(SimpleNamespace(read=lambda: person), panda.whole, config=config)
    told = watch.look(2.13, q, load)

    ends, radius, v = (
        torch.from_numpy(x) for x in (person.ends, person.radius, person.velocity)
    )
    every = separation(panda.whole, q, ends, radius, load)
    age = 2.13 - 2.0
    gain = PersonWatchConfig().acceleration * (age + SeparationConfig().reaction_time)
    pairs = []
    for c, h in torch.cartesian_prod(*(torch.arange(n) for n in every.distance.shape)).tolist():
        t = every.fraction[c, h]
        along = every.direction[c, h] @ ((1 - t) * v[h, 0] + t * v[h, 1])
        towards = (gain - along).clamp(min=0)
        distance = every.distance[c, h] - age * towards
        allowed = SeparationConfig().highest_speed(distance, towards)
        urgency = float(allowed + 1e-3 * distance)
        pairs.append((urgency, float(distance), float(towards), every.gradient[c, h]))
    pairs.sort(key=lambda pair: pair[0])
    _, distance, towards, gradient = zip(*pairs[: PersonWatchConfig().pairs], strict=True)

    order = told.distances.distance.argsort()
    expected = torch.tensor(distance, dtype=torch.float64).argsort()
    for ours, theirs in (
        (told.distances.distance, torch.tensor(distance, dtype=torch.float64)),
        (told.distances.approach_speed, torch.tensor(towards, dtype=torch.float64)),
        (told.distances.gradient, torch.stack(gradient)),
    ):
        torch.testing.assert_close(ours[order], theirs[expected], atol=1e-12, rtol=0)
    assert told.nearest == pytest.approx(float(every.distance.min()), abs=1e-12)
    assert told.age == pytest.approx(age)


def test_whoever_may_touch_the_arm_stops_it():
    """A hand that comes nearer to the gripper, a centimetre at a time."""
    q = WORKPLACE.hover_joints()
    tip = panda.forward(q).position.numpy()
    known = []
    for gap in np.arange(-0.02, 0.10, 0.01):
        ends = np.full((1, 2, 3), tip - np.array([0.0, 0.0, 0.06 + gap]))
        seen = PersonObservation(
            time=0.0, ends=ends, radius=np.array([0.05]), velocity=np.zeros_like(ends)
        )
        watch = PersonWatch(SimpleNamespace(read=lambda seen=seen: seen), ARM, SEPARATION)
        found = watch.look(0.0, q)
        known.append(found.distances.known().item())
        assert known[-1] == (found.nearest >= PersonWatchConfig().contact)
    assert {True, False} == set(known)
    assert known == sorted(known)


@pytest.mark.parametrize("speed", [-0.6, 0.0, 0.4, 1.5])
@pytest.mark.parametrize("distance", [0.0, 0.1, 0.2, 0.35, 0.6])
def test_the_arm_rests_by_the_time_that_somebody_may_arrive(distance, speed):
    """A ball below the gripper, against its way in small steps."""
    config = PersonWatchConfig()
    tip, age, radius = panda.forward(WORKPLACE.hover_joints()).position.numpy(), 0.1, 0.05
    ends = np.full((1, 2, 3), tip - np.array([0.0, 0.0, distance + radius]))
    velocity = np.broadcast_to([0.0, 0.0, speed], (1, 2, 3)).copy()
    seen = PersonObservation(time=1.0, ends=ends, radius=np.array([radius]), velocity=velocity)
    watch = PersonWatch(SimpleNamespace(read=lambda: seen), panda.whole, SEPARATION, config)
    found = watch.look(1.0 + age, WORKPLACE.hover_joints())

    # Who goes away may turn round at once.
    arrival, gap, coming, dt = 0.0, found.nearest - config.contact, max(speed, 0.0), 1e-4
    while gap > 0:
        gap -= dt * (coming + dt * config.acceleration / 2)
        coming += dt * config.acceleration
        arrival += dt
    # Late by the age and the reaction, and with 0.15 s to come to rest.
    expected = np.clip((arrival - age - SEPARATION.reaction_time) / 0.15, 0.0, 1.0)
    assert found.speed_scale == pytest.approx(expected, abs=2e-3)


class Hand:
    """A ball below the gripper that rests, and then reaches through it: minimum jerk [m, s]."""

    radius, begin = 0.05, 0.3
    worker = SimpleNamespace(radius=np.array([radius]))

    def __init__(self, gap):
        self._tip, self._gap = panda.forward(WORKPLACE.hover_joints()).position.numpy(), gap
        # The peak of the acceleration is 5.77 times the way by the square of the time.
        self._way = gap + 0.08
        self._duration = math.sqrt(5.77 * self._way / 9.0)

    def gap(self, time):
        s = min(max((time - self.begin) / self._duration, 0.0), 1.0)
        return self._gap - self._way * (10 * s**3 - 15 * s**4 + 6 * s**5)

    def ends_at(self, time):
        down = self.gap(time) + self.radius
        return np.broadcast_to(self._tip - [0.0, 0.0, down], (1, 2, 3)).copy()


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.1, 0.2])
def test_a_hand_that_sets_off_meets_an_arm_at_rest(gap):
    """Seen as late as nominal, with 9 m/s^2: commands take effect before it is there."""
    sizes = replace(Imperfections.nominal(), person_noise=0.0, person_loss=0.0)
    separation = sizes.plant(SafetyConfig()).separation
    hand, now, rests = Hand(gap), 0.0, None
    sensor = WorkerSensor(
        hand.ends_at, hand.worker.radius, lambda: now, sizes, np.random.default_rng(0)
    )
    watch = PersonWatch(sensor, panda.whole, separation)
    while hand.gap(now) > 0:
        found = watch.look(now, WORKPLACE.hover_joints())
        if now < hand.begin or found.speed_scale > 0:
            rests = None
        elif rests is None:
            rests = now
        now += 0.002
    assert rests is not None
    assert rests < now - (sizes.command_delay + sizes.servo_lag)


def test_nobody_who_stays_away_slows_the_arm_down():
    found = watch(observed(), acceleration=3.0).look(1.0, WORKPLACE.home_joints())
    assert found.nearest > 0.4
    assert found.speed_scale == 1.0


def ball(down, region, speed=0.0, *, age=0.0, mode="ssm+pfl", furniture=()):
    """What is thought of a ball below the gripper that comes up, a part of some region."""
    tip = panda.forward(WORKPLACE.hover_joints()).position.numpy()
    ends = np.full((1, 2, 3), tip - np.array([0.0, 0.0, down + 0.04]))
    seen = PersonObservation(
        time=1.0,
        ends=ends,
        radius=np.array([0.04]),
        velocity=np.broadcast_to([0.0, 0.0, speed], (1, 2, 3)).copy(),
        regions=region,
    )
    separation = replace(SEPARATION, mode=mode)
    config = PersonWatchConfig(acceleration=2.0)
    tracker = SimpleNamespace(read=lambda: seen)
    watch = PersonWatch(tracker, ARM, separation, config, furniture)
    found = watch.look(1.0 + age, WORKPLACE.hover_joints())
    return found, found.distances.closing_speed(ConstraintConfig(), separation)


def test_the_arm_goes_on_before_a_hand_but_not_before_a_face():
    hand, near_hand = ball(0.052, ("hand",))
    face, near_face = ball(0.052, ("head",))
    unknown, near_unknown = ball(0.052, ())
    apart, near_apart = ball(0.052, ("hand",), mode="ssm")
    assert hand.speed_scale == 1.0
    assert 0.5 < hand.speed_cap < math.inf
    assert face.speed_cap == apart.speed_cap == math.inf
    assert face.speed_scale == unknown.speed_scale == apart.speed_scale < 0.7
    assert near_hand.min() > 0.5
    assert near_apart.min() < 0.2
    torch.testing.assert_close(near_face, near_apart)
    torch.testing.assert_close(near_unknown, near_apart)
    assert unknown.distances.contact_speed is None
    # Towards a hand that comes too fast for any contact the arm is at rest.
    fast, near_fast = ball(0.1, ("hand",), speed=2.0)
    assert near_fast.min() == 0.0
    assert fast.speed_cap == 0.0


def test_an_arm_that_touches_a_hand_goes_on_but_not_towards_it():
    hand, near_hand = ball(0.02, ("hand",))
    assert hand.nearest < PersonWatchConfig().contact
    assert hand.distances.known()
    assert near_hand.min() < 0.01
    assert hand.speed_scale == 1.0
    assert hand.speed_cap > 0.5
    assert 0 < hand.distances.contact_speed.min() < 0.1
    assert not ball(0.02, ("head",))[0].distances.known()
    assert not ball(0.02, ("hand",), mode="ssm")[0].distances.known()


@pytest.mark.parametrize("first", [0.0, 0.4, 2.5])
@pytest.mark.parametrize("speed", [-0.5, 0.0, 0.8])
@shapes_unchecked()  # a stand-in for the distances
def test_near_people_the_arm_is_slow_enough_for_a_contact_or_at_rest(first, speed):
    """One pair, of a person who comes with a speed [m/s] and is seen late."""
    config = PersonWatchConfig(acceleration=2.0, fastest=0.6)
    age, reaction = 0.04, SEPARATION.reaction_time
    contact = ContactSpeeds(*(torch.tensor([[x]]).double() for x in (first, first / 4)))
    for distance in (0.0, 0.0299, 0.0301, 0.06, 0.1, 0.2, 0.4, 2.0):
        pair = SimpleNamespace(
            distance=torch.tensor([[distance]], dtype=torch.float64),
            person_rate=lambda velocity: torch.tensor([[-speed]], dtype=torch.float64),
            gradient_of=lambda urgent: torch.zeros(1, 7, dtype=torch.float64),
        )
        seen_for = torch.tensor(age, dtype=torch.float64)
        velocity = torch.zeros(1, 2, 3, dtype=torch.float64)
        found = watched_people(pair, velocity, seen_for, SEPARATION, config, contact)
        # A person who goes away may turn round at once; all accelerate until they arrive.
        gap, coming = max(distance - 0.03, 0.0), max(speed, 0.0)
        arrival = max(np.roots([config.acceleration / 2, coming, -gap]).real)
        scale = np.clip((arrival - age - reaction) / 0.15, 0.0, 1.0)
        gained = config.acceleration * (age + reaction)
        if first == 0.0:
            assert found.speed_scale == pytest.approx(scale, abs=1e-9)
            assert found.speed_cap == math.inf
        else:
            assert found.speed_scale == 1.0
            slow = max(first - coming - gained, 0.6 * scale) if scale < 1 else math.inf
            assert found.speed_cap == pytest.approx(slow)
        # A contact that has begun may last.
        touching = distance < 0.03
        assert found.distances.contact_speed == pytest.approx(first / 4 if touching else first)
        assert bool(found.distances.known()) == (first > 0 or not touching)
        assert found.nearest == distance


def test_a_hand_on_the_table_is_met_as_slowly_as_one_that_cannot_yield():
    tip = panda.forward(WORKPLACE.hover_joints()).position.tolist()
    under = Box(centre=(tip[0], tip[1], tip[2] - 0.115 - 0.02), half_size=(0.3, 0.3, 0.02))
    free, clamped = (
        ball(0.05, ("hand",), mode="pfl", furniture=boxes)[0].distances.contact_speed.min()
        for boxes in ([], [under])
    )
    assert clamped < 0.1 * free
    assert clamped > 0.01


def test_contact_limits_need_an_arm_with_masses():
    chain = CapsuleArm(panda.with_tool(torch.eye(4, dtype=torch.float64)), panda.whole.capsules)
    separation = SeparationConfig(mode="pfl")
    with pytest.raises(ValueError, match=r"mode='pfl'.*needs the masses of the arm"):
        PersonWatch(SimpleNamespace(read=lambda: None), chain, separation)
    PersonWatch(SimpleNamespace(read=lambda: None), chain, SeparationConfig())


@pytest.mark.parametrize("wrong", [{"acceleration": -1.0}, {"pairs": 0}, {"fastest": 0.0}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PersonWatchConfig(**wrong)


def test_a_contact_distance_of_nan_would_never_stop_the_arm_and_is_refused():
    with pytest.raises(ValueError, match=r"contact is NaN: give a distance \[m\]"):
        PersonWatchConfig(contact=float("nan"))
