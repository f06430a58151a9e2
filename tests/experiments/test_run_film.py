"""The film of a run: its length, what is told and drawn in it."""

from io import BytesIO

import av
import numpy as np
import pytest
from sample_runs import sample_run

from hrc_learn.experiments import run_recorder as film
from hrc_learn.experiments.run_recorder import caption, frames
from hrc_learn.geometry import Body, Capsule
from hrc_learn.log import Event
from hrc_learn.sim import RenderingUnavailableError


@pytest.fixture(autouse=True)
def no_opengl(monkeypatch):
    """Pictures are drawn, as on machines that cannot render."""

    def unavailable(*_):
        raise RenderingUnavailableError("no OpenGL")

    monkeypatch.setattr(film, "OffscreenRenderer", unavailable)


def labels(run, step):
    return [name for name, _ in film._drawn_in(run, step)[1]]


def pushed(steps):
    """A run whose elbow is pushed along y in these steps."""
    push = np.full((len(sample_run().time), 2, 3), np.nan)
    push[steps] = [[0.1, 0.0, 0.5], [0.1, 0.45, 0.5]]
    return sample_run(push=push, worker_nearest=None)


@pytest.mark.parametrize(("duration", "shown"), [(1.0, 1.0), (400.0, 2.0)])
def test_a_film_is_as_long_as_the_run_up_to_a_bound(duration, shown, monkeypatch):
    monkeypatch.setattr(film, "LONGEST", 2.0)
    time = np.linspace(0.0, duration, len(sample_run().time))
    with av.open(BytesIO(film.film(sample_run(time=time)).mp4)) as file:
        (stream,) = file.streams.video
        assert sum(1 for _ in file.decode(stream)) == round(shown * film.RATE)


def test_a_film_shows_every_moment_of_what_moves_above_the_table():
    steps = len(sample_run().time)
    way = np.linspace([0.0, 0.0, 0.3], [0.3, 0.4, 0.3], steps)  # from the base to an object
    ball = Capsule(start=(0, 0, 0), end=(0, 0, 0.02), radius=0.05, colour=(1, 0, 1, 1))
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (steps, 1))
    body = Body(name="ball", position=way, orientation=upright, capsules=(ball,))
    run = sample_run(time=np.linspace(0.0, 0.5, steps), bodies=(body,), boxes=(), push=None)
    places = []
    for picture in frames(run):
        assert picture.shape == (film.HEIGHT, film.WIDTH, 3)
        v, u = np.nonzero((picture == [255, 0, 255]).all(-1))
        places.append([u.mean() / film.WIDTH, v.mean() / film.HEIGHT])
    assert (np.diff(places, axis=0) > 0).all()
    np.testing.assert_allclose(np.mean(places, axis=0), 0.5, atol=0.1)  # in the middle


def test_the_caption_is_of_the_phase_that_was_entered_last():
    phases = (Event(0.5, "servo"), Event(2.0, "my own phase"))
    run = sample_run(phases=phases)
    assert caption(run, 0.4) == run.title
    assert caption(run, 0.5).startswith("Servoes")
    assert caption(run, 3.0) == "My own phase"


def test_an_arm_that_has_grasped_nothing_carries_nothing_home():
    phases = (Event(0.5, "home"), Event(2.0, "grasp"), Event(4.0, "home"))
    run = sample_run(phases=phases)
    assert caption(run, 1.0) == "Moves home"
    assert caption(run, 5.0) == "Carries the object home"


def test_a_pull_is_an_arrow_above_the_forearm_while_it_lasts():
    run, pulled, free = pushed(slice(80, 120)), 100, 20
    lines, _ = film._drawn_in(run, pulled)
    (arrow,) = (line for line in lines if line.head)
    (forearm,) = (line for line in lines if line.width == film._HAND)
    np.testing.assert_allclose(np.subtract(arrow.end, arrow.start), [0, 0.45, 0], atol=1e-9)
    np.testing.assert_allclose(forearm.start, [0.1, 0.0, 0.5])
    assert arrow.start[2] > forearm.start[2]
    assert "a person pulls the elbow" in labels(run, pulled)
    assert "a person pulls the elbow" not in labels(run, free)


def test_the_plan_is_shown_while_the_arm_carries_and_the_region_before():
    run = sample_run(phases=(Event(0.0, "servo"), Event(2.0, "transfer")))
    assert any("region" in name for name in labels(run, 10))
    assert any("planned" in name for name in labels(run, 150))


def test_the_distance_of_a_worker_is_told_while_he_is_near():
    run = sample_run()
    points = np.zeros((len(run.time), 2, 3))
    points[:, 1, 0] = np.where(run.time < 2.0, 0.25, 3.0)
    run = sample_run(worker_nearest=points)
    assert "distance to the worker: 0.25 m" in labels(run, 10)
    assert not any("worker" in name for name in labels(run, 150))
