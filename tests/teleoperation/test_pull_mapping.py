"""How a pull acts where nothing else is asked for: code, command line and docs say the same."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.teleoperation import (
    InteractionForceConfig,
    ScriptedForce,
    force_to_nullspace_input,
)
from hrc_learn.teleoperation.hand_guiding import DEFAULT_MAPPING
from hrc_learn.teleoperation.page import PageConfig

DOCS = Path(__file__).parents[2] / "docs" / "concepts"


def test_every_part_has_the_same_default():
    for forces in (InteractionForceConfig(), PageConfig().forces):
        assert forces.mapping == DEFAULT_MAPPING
    q, pull = panda.ready.numpy(), np.array([1.0, -2.0, 0.5])
    J = panda.joint_jacobian(panda.ready, 4)[:3].numpy()
    np.testing.assert_allclose(force_to_nullspace_input(panda, q, 4, pull), J.T @ pull)


def test_the_docs_tell_that_default():
    (row,) = re.findall(
        r"\| `force_to_nullspace_input`: (.+) \| `mapping=\"(\w+)\"` \|",
        (DOCS / "notation.md").read_text(encoding="utf-8"),
    )
    assert (
        row[0] == {"transpose": "d = J_joint^T f", "pinv": "d = J_joint^+ v"}[DEFAULT_MAPPING]
    )
    assert {row[1], DEFAULT_MAPPING} == {"transpose", "pinv"}
    page = (DOCS / "teleoperation.md").read_text(encoding="utf-8")
    assert f'`mapping="{DEFAULT_MAPPING}"` is the default' in page


@pytest.mark.parametrize("mapping", ["transpose", "pinv"])
def test_a_pull_acts_by_the_mapping_asked_for(mapping):
    config = InteractionForceConfig(mapping=mapping)
    pull = ScriptedForce(start=0.0, duration=4.0, towards=(0.4, 0.3, 0.9), max_force=10.0)
    q = panda.ready.numpy()
    elbow = panda.link_poses(panda.ready).position[3].numpy()
    force = pull.force(2.0, elbow)
    d = force_to_nullspace_input(panda, q, 4, force, config)
    assert np.linalg.norm(force) == pytest.approx(10.0)
    J = panda.joint_jacobian(torch.from_numpy(q), 4)[:3].numpy()
    if mapping == "transpose":
        np.testing.assert_allclose(d, J.T @ force, atol=1e-12)
    else:
        # The gizmo displaced as far as the spring's force has it asks for 2 1/s of that.
        velocity = 2.0 * force / 150.0
        expected, *_ = np.linalg.lstsq(J, velocity, rcond=1e-6)
        np.testing.assert_allclose(d, 3.0 * expected, atol=1e-9)
