"""Other programs that look for faults in LeRobot datasets, to be measured by the same defects.

    pip install --no-deps --target FOLDER lerobot-doctor==0.2.0 lerobot-lint==0.1.1 \\
        lerobot-quality-gates==0.1.7

Each is called as its command line calls it, without the formatting. What it reports counts as
a finding, also that it cannot load the dataset; an exception that it does not catch is a crash.
"""

from collections.abc import Sequence

from checker_score import Line

DOCTOR_LEVELS = {"FAIL": "error", "WARN": "warning"}
LINT_LEVELS = {"error": "error", "warning": "warning", "info": "warning"}
GATES_LEVELS = {"critical": "error", "high": "error", "medium": "warning", "low": "warning"}


def doctor(root: str) -> list[Line]:
    """lerobot-doctor, all of its checks."""
    from lerobot_doctor.dataset_loader import load_dataset
    from lerobot_doctor.runner import run_checks

    try:
        dataset = load_dataset(root)
    except Exception as error:  # as its command line does
        return [("error", f"Error loading dataset: {error}")]
    if dataset.info is None:
        return [("error", f"Error loading dataset: {dataset.info_error}")]
    return [
        (DOCTOR_LEVELS[message.severity.value], message.message)
        for result in run_checks(dataset).results
        for message in result.messages
        if message.severity.value in DOCTOR_LEVELS
    ]


def lint(root: str) -> list[Line]:
    """lerobot-lint, with the profile that it finds by the names of the joints."""
    from lerobot_lint.config import detect_profile_name, load_profile
    from lerobot_lint.engine import check_dataset
    from lerobot_lint.loader import DatasetLoadError, get_joint_names

    profile = load_profile(detect_profile_name(get_joint_names(root)) or "default")
    try:
        findings = check_dataset(root, profile)
    except DatasetLoadError as error:
        return [("error", f"Could not load dataset: {error}")]
    return [
        (
            LINT_LEVELS[found.severity],
            f"{found.check}: {found.message}"
            + ("" if found.episode is None else f" (episode {found.episode})"),
        )
        for found in findings
    ]


def gates(root: str) -> list[Line]:
    """lerobot-quality-gates."""
    from lerobot_quality_gates import run_quality_gates

    return [
        (GATES_LEVELS[found.severity], f"{found.path}: {found.message}")
        for found in run_quality_gates(root).findings
    ]


PEERS = {
    "lerobot-doctor": (doctor, ("lerobot_doctor.runner", "av")),
    "lerobot-lint": (lint, ("lerobot_lint.engine", "lerobot.datasets.lerobot_dataset")),
    "lerobot-quality-gates": (gates, ("lerobot_quality_gates",)),
}
"""Checker -> its call and its imports."""


def cannot_open(lines: Sequence[Line]) -> bool:
    """True if a checker reports that it cannot read the dataset."""
    return any("Error loading" in text or "Could not load" in text for _, text in lines)
