"""The whole job near a person over topics of ROS 2, against the same job without ROS."""

import os

import numpy as np
import pytest

os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
pytest.importorskip("rclpy")

from bench_ros2_jobs import Args, main, rows_in
from taught_models import teach
from unchecked import shapes_unchecked

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
NOISE = {
    "place error": 1.0,
    "place tilt": 0.3,
    "grasp offset": 2.0,
    "end effector deviation": 1.5,
    "end effector rotation": 0.3,
}
"""Largest mean by which results over topics may be worse [mm, deg]."""


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    teach(folder)
    return folder


@shapes_unchecked()
def test_a_whole_job_over_topics_is_as_good_as_without_ros(models, tmp_path):
    results = []
    for access in ("direct", "ros2"):
        file = tmp_path / f"{access}.jsonl"
        main(Args(models=models, access=access, waits=0.05, first_seed=5, jobs=2, json=file))
        results.append(rows_in(file))
    failures = [[row["failure"] for row in rows] for rows in results]
    assert failures == [["", ""], ["", ""]]
    for name, worse in NOISE.items():
        without, over = (np.mean([row[name] for row in rows]) for rows in results)
        assert over < without + worse, name
    for row in results[1]:
        assert row["objects that stand on their shelf"] == 1
        assert row["contacts"] == row["joint limit violations"] == row["robot_violations"] == 0
        assert row["elbow moved"] > 100.0
