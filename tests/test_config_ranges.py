"""Every configuration of the package refuses NaN, infinity and unknown names."""

import dataclasses
import importlib
import inspect
import math
import pkgutil
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
import torch
from unchecked import shapes_unchecked

import hrc_learn
from hrc_learn import regions

SKIPPED = {
    # LeRobot's own fields, which LeRobot checks.
    "max_parallel_tasks",
    "optimizer_lr",
    "optimizer_weight_decay",
    # Given in whole frames or steps: a float fails where it is used.
    "fit_episodes",
}
EXCEPT = {
    # A part of the robots' configurations, which check it.
    "ValuesConfig",
    # Scenes of the simulation, which no command changes.
    *("CabinetConfig", "ObjectConfig", "SceneConfig", "WorkerConfig", "GraspingSceneConfig"),
    # Checked by what is made of them: the camera, the pool of processes, the policy, the loop.
    *("ImagesConfig", "MovedCameraConfig", "JudgeConfig", "DMPConfig", "SmoothRobotConfig"),
    "_ServeSettings",
}


def configurations():
    """All dataclasses that are named a configuration and have defaults, with an instance."""
    for module in pkgutil.walk_packages(hrc_learn.__path__, "hrc_learn."):
        if module.name.endswith("__main__"):
            continue
        for kind in vars(importlib.import_module(module.name)).values():
            if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
                continue
            if kind.__name__ in EXCEPT:
                continue
            if kind.__module__ == module.name and kind.__name__.endswith(
                ("Config", "Site", "Settings")
            ):
                required = [
                    field
                    for field in dataclasses.fields(kind)
                    if field.default is field.default_factory is dataclasses.MISSING
                ]
                if not required and not inspect.isabstract(kind):
                    yield kind, kind()


def wrong_values(value, hint):
    """Values that a field must refuse."""
    hint = getattr(hint, "__value__", hint)
    if get_origin(hint) is Literal:
        return ["misspelt"]
    if isinstance(value, float) or (value is None and float in get_args(hint)):
        return [math.nan, math.inf, -math.inf]
    if isinstance(value, int) and not isinstance(value, bool):
        return [math.nan]
    if isinstance(value, tuple) and value and all(isinstance(x, float) for x in value):
        return [(math.nan,) * len(value), (math.inf,) * len(value)]
    return []


def test_no_configuration_accepts_a_number_that_is_none_or_an_unknown_name():
    accepted, tried = [], 0
    for kind, one in configurations():
        hints = get_type_hints(kind)
        for field in dataclasses.fields(kind):
            if not field.init or field.name in SKIPPED:
                continue
            unbounded = field.name in getattr(kind, "unbounded", ())
            for value in wrong_values(getattr(one, field.name), hints[field.name]):
                if unbounded and value == math.inf:
                    continue
                tried += 1
                case = f"{kind.__name__}({field.name}={value!r})"
                try:
                    with shapes_unchecked():  # the checker would refuse names of its own accord
                        kind(**{field.name: value})
                except ValueError as error:
                    accepted += [] if field.name in str(error) else [f"{case}: {error}"]
                else:
                    accepted.append(case)
    assert tried > 500
    assert not accepted, "\n".join(accepted)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (regions.PositionRegion, {"formulation": "satturated"}),
        (regions.OrientationRegion, {"formulation": "papier"}),
        (regions.OrientationRegion, {"coordinates": "rotations"}),
        (regions.VisionRegion, {"formulation": "satturated"}),
        (regions.JointRegion, {"formulation": "papier"}),
        (regions.PositionRegion, {"stiffness": (1.0, math.nan, 1.0)}),
        (regions.JointRegion, {"margin": math.inf}),
        (regions.PostureRegion, {"saturation": math.nan}),
    ],
)
def test_a_region_refuses_a_misspelt_formulation_and_numbers_that_are_none(kind, options):
    sizes = {"centre": 3, "half_size": 3, "goal": 4, "target": 3, "half_range": 3}
    tensors = {
        field.name: torch.ones(sizes[field.name])
        for field in dataclasses.fields(kind)
        if not field.metadata.get("static")
    }
    (name,) = options
    with pytest.raises(ValueError, match=f"{name} must be"), shapes_unchecked():
        kind(**tensors, **options)
