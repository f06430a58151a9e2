"""The film of a run: its length, what is told and drawn in it."""

from io import BytesIO

import av
import numpy as np
import pytest
from sample_runs import sample_run

from hrc_learn.experiments import run_recorder as film
from hrc_learn.experiments.run_recorder import caption, frames
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


def test_the_first_and_the_last_moment_are_in_the_film():
    run = sample_run(time=np.linspace(0.0, 0.5, len(sample_run().time)))
    pictures = list(frames(run))
    assert pictures[0].shape == (film.HEIGHT, film.WIDTH, 3)
    assert (pictures[0] != pictures[-1]).any()


def test_the_caption_is_of_the_phase_that_was_entered_last():
    phases = (Event(0.5, "servo"), Event(2.0, "my own phase"))
    run = sample_run(phases=phases)
    assert caption(run, 0.4) == run.title
    assert caption(run, 0.5).startswith("Servoes")
    assert caption(run, 3.0) == "My own phase"


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
