"""Methods that override one of a base class take its arguments with its defaults.

A caller that knows the base class only, as LeRobot or PyTorch does, gets what it expects.
"""

import importlib
import inspect
import pkgutil

import pytest

import hrc_learn

PACKAGES = sorted(
    {module.name for module in pkgutil.iter_modules(hrc_learn.__path__) if module.ispkg}
    - {"cli"}
)


def modules_of(package):
    """The modules of a package that can be imported without a robot or a ROS 2 network."""
    package = importlib.import_module(f"hrc_learn.{package}")
    yield package
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        try:
            yield importlib.import_module(found.name)
        except ImportError:
            continue


def overridden(kind):
    """Functions of a class with the one of the nearest base class that each replaces."""
    for name, function in vars(kind).items():
        if name.startswith("__") or not inspect.isfunction(function):
            continue
        for base in kind.__mro__[1:]:
            if inspect.isfunction(replaced := vars(base).get(name)):
                yield name, function, replaced
                break


@pytest.mark.parametrize("package", PACKAGES)
def test_overriding_methods_have_the_defaults_of_their_base_class(package):
    classes = {
        kind
        for module in modules_of(package)
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if kind.__module__ == module.__name__
    }
    for kind in classes:
        for name, function, replaced in overridden(kind):
            expected = inspect.signature(replaced).parameters
            for key, parameter in inspect.signature(function).parameters.items():
                given = (inspect.Parameter.empty, ...)  # no default, or one left open
                if key in expected and expected[key].default not in given:
                    place = f"{kind.__module__}.{kind.__qualname__}.{name}({key})"
                    assert parameter.default == expected[key].default, place
