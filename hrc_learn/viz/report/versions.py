"""Of which software a result is."""

import platform
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = (
    "hrc-learn",
    "torch",
    "mujoco",
    "lerobot",
    "opencv-python-headless",
    "rerun-sdk",
    "viser",
)


def software_versions() -> dict[str, str]:
    """Versions of Python and of what results depend on, by name."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
