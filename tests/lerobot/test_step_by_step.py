"""The lines of the guide's first section run one after the other, as they stand there."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SHORTER = {
    "--episodes 20": "--episodes 4",
    "--eval.n_episodes=50": "--eval.n_episodes=1",
    "--steps=1000": "--steps=5",
}
"""What takes long, and what is run instead."""
NOT_RUN = ("pip ", "export ")
"""Set-up, which the tests have behind them."""


def lines():
    guide = (ROOT / "docs" / "howto" / "lerobot.md").read_text(encoding="utf-8")
    section = guide.split("## Step by step")[1].split("\n## ")[0]
    (block,) = re.findall(r"```console\n(.*?)```", section, re.DOTALL)
    return [line.removeprefix("$ ") for line in block.splitlines()]


@pytest.mark.slow
def test_the_guide_runs_from_nothing_to_an_evaluated_policy(tmp_path):
    text = "\n".join(lines())
    assert all(long in text for long in SHORTER)
    ran = 0
    for line in lines():
        if line.startswith(NOT_RUN):
            continue
        for long, short in SHORTER.items():
            line = line.replace(long, short)
        program, *arguments = shlex.split(line)
        # Beside the interpreter of these tests, whatever is on the path.
        command = [str(Path(sys.executable).parent / program), *arguments]
        if program == "hrc":
            command = [sys.executable, "-m", "hrc_learn.cli", *arguments]
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        ran += 1
    assert ran == 7
    for folder in ("policy", "run/checkpoints/last/pretrained_model"):
        assert (tmp_path / folder / "model.safetensors").is_file()
    for folder in ("evaluation", "evaluation_of_chunks"):
        assert (tmp_path / folder / "eval_info.json").is_file()
