"""What `pyproject.toml` and `constraints.txt` say about versions, against what is installed."""

import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
TESTED = ("all", "hardware", "ros2", "dev", "docs")
"""What `make test` and `make docs` install between them."""


def pins() -> dict[str, Version]:
    """The pinned version of each distribution, by its normalised name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (re.fullmatch(r"([\w.-]+)==([\w.!+]+)", line) for line in lines)
    return {canonicalize_name(pair[1]): Version(pair[2]) for pair in pairs if pair}


def own_requirements(extra: str) -> list[Requirement]:
    """What an extra asks for, where it names other extras of ours with what those ask for."""
    found = []
    for requirement in map(Requirement, EXTRAS[extra]):
        if requirement.name == PROJECT["name"]:
            for named in sorted(requirement.extras):
                found += own_requirements(named)
        else:
            found.append(requirement)
    return found


def direct_requirements() -> list[Requirement]:
    core = map(Requirement, PROJECT["dependencies"])
    return [*core, *(needed for extra in TESTED for needed in own_requirements(extra))]


def applies(requirement: Requirement, extra: str = "") -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def installed_closure() -> dict[str, list[Requirement]]:
    """Everything that is asked for, directly or by another distribution, by normalised name.

    A distribution that is not installed (those of `docs` often are not) ends its branch.
    """
    closure: dict[str, list[Requirement]] = {}
    seen = set()
    queue = [needed for needed in direct_requirements() if applies(needed)]
    while queue:
        requirement = queue.pop()
        name = canonicalize_name(requirement.name)
        closure.setdefault(name, []).append(requirement)
        for extra in ("", *sorted(requirement.extras)):
            if (name, extra) in seen:
                continue
            seen.add((name, extra))
            try:
                asked = metadata.distribution(name).requires or []
            except metadata.PackageNotFoundError:
                continue
            queue += [needed for needed in map(Requirement, asked) if applies(needed, extra)]
    return closure


def test_constraints_hold_names_and_versions_only():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert len(pins()) == len(lines)


def test_constraints_pin_all_that_is_installed_for_us():
    assert sorted(installed_closure().keys() - pins().keys()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="some are installed on Linux only")
def test_constraints_pin_nothing_else():
    missing = [r.name for r in own_requirements("docs") if not is_installed(r.name)]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: `make docs` installs them")
    assert sorted(pins().keys() - installed_closure().keys()) == []


def is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def test_pinned_versions_are_the_ones_asked_for():
    """Ours as well as every installed distribution's own bounds."""
    versions = pins()
    refused = [
        f"{needed} refuses {versions[name]}"
        for name, requirements in installed_closure().items()
        for needed in requirements
        if name in versions and not needed.specifier.contains(versions[name], prereleases=True)
    ]
    assert refused == []


def test_every_requirement_has_a_lower_bound():
    """`make test-wheel` installs it, so it has to be one."""
    optional = [Requirement(text) for asked in EXTRAS.values() for text in asked]
    unbounded = [
        needed.name
        for needed in [*map(Requirement, PROJECT["dependencies"]), *optional]
        if needed.name != PROJECT["name"]
        and not any(bound.operator in {">=", "=="} for bound in needed.specifier)
    ]
    assert unbounded == []
