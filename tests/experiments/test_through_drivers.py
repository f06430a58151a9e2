"""The three experiments through the real arm's drivers, their sockets and 1 ms cycles."""

from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np
import pytest
from taught_models import teach
from unchecked import shapes_unchecked

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.collaboration_trial import (
    CollaborationScenario,
    simulate_collaboration,
)
from hrc_learn.experiments.grasping_trial import (
    GraspingScene,
    GraspingSceneConfig,
    simulate_grasp,
)
from hrc_learn.experiments.placing_trial import PlacingScene
from hrc_learn.experiments.simulated_cell import access_by
from hrc_learn.hardware.protocol_server import serve_world
from hrc_learn.kinematics import panda
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

pytestmark = pytest.mark.slow
WORKPLACE = Workplace()


@pytest.fixture(scope="module")
def skills(tmp_path_factory):
    return teach(tmp_path_factory.mktemp("models"))


def untouched(world):
    """Whether the arm met neither cabinet, table nor itself."""
    return not any(
        monitor.touches
        for monitor in (world.cabinet_contacts, world.table_contacts, world.self_contacts)
    )


@shapes_unchecked()
def test_a_whole_job_is_done_with_imperfections(skills):
    scenario = CollaborationScenario(
        camera="synthetic",
        config=PickAndPlaceConfig(interaction=2.5, speed=2.0),
        imperfections=Imperfections.nominal(),
    )
    job = simulate_collaboration(
        *skills,
        ("middle",),
        scenario,
        access=access_by("franky", panda),
        seed=3,
    )
    assert job.failure == ""
    assert untouched(job.world)
    assert job.world.rests_on(job.workplace.scene.objects[0].name, "board_middle")
    # The clock of the robot: no step is missing, few are longer than they should be.
    assert np.percentile(np.diff(job.cell.log["time"]), 95) == pytest.approx(0.01, abs=1e-3)


@shapes_unchecked()
def test_an_object_is_grasped(skills):
    rng = np.random.default_rng(1)
    scene = GraspingScene.draw(WORKPLACE, GraspingSceneConfig(), rng)
    grasp = simulate_grasp(
        skills[0], scene, camera="synthetic", rng=rng, access=access_by("franky", panda)
    )
    assert grasp.failure == ""
    assert grasp.world.holds(grasp.item.name)
    assert untouched(grasp.world)


def place_on_shelf(skill, access):
    scene = PlacingScene(
        skill=skill,
        workplace=WORKPLACE,
        world=World(WORKPLACE.scene),
        demonstration=Demonstration(time=np.arange(2.0)),
        demonstrated_shelf="middle",
    )
    home = WORKPLACE.home_joints()
    run = scene.place("upper", home, space="pose", speed=1.0, access=access)
    assert run.placed
    assert not run.contacts
    np.testing.assert_allclose(run.object_pose[:2, 3], run.goal.position[:2], atol=5e-3)


@shapes_unchecked()
@pytest.mark.parametrize("dynamics", [1.0, 0.3])
def test_an_object_is_placed_also_by_a_gentle_driver(skills, dynamics):
    place_on_shelf(skills[1], access_by("franky", panda, dynamics=dynamics))


@pytest.mark.skipif(not find_spec("pylibfranka"), reason="comes with the extra hardware")
@shapes_unchecked()
def test_an_object_is_placed_by_our_loop_which_answers_each_cycle(skills):
    servers = []

    @contextmanager
    def serve(world):
        with serve_world(world) as server:
            servers.append(server)
            yield server

    place_on_shelf(skills[1], access_by("franka", panda, serve=serve))
    # A state after a pause is none that comes late; a machine that is held up may miss some.
    (server,) = servers
    assert server.missed < 0.01 * server.cycles
