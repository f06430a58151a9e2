"""LeRobot's own commands with our policies, offline, each in a process of its own."""

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import torch
from lerobot_samples import FPS, GOAL, STATE, reaching, windows, write_dataset

from hrc_learn.lerobot.policy.dmp_policy import DMPPolicy
from hrc_learn.lerobot.policy.policy_base import read_episodes

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
COMMANDS = Path(sys.executable).parent
OFFLINE = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
DISCOVER = "--policy.discover_packages_path=hrc_learn.lerobot"
ALSO_OF_A_PATH = "--discover_packages_path=hrc_learn.lerobot"
"""With `--policy.path` LeRobot reads all that begins with `--policy.` a second time."""
SMALL = ("--policy.hidden_dim=16", "--policy.n_basis=12", "--policy.chunk_size=8")
SMALL = (*SMALL, "--policy.n_action_steps=4", "--policy.optimizer_lr=0.003")


@pytest.fixture(scope="module")
def numbers(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("numbers") / "set", reaching(4))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("pictures") / "set", reaching(4), images=True)


def train(*arguments: object, ranks: int = 1) -> str:
    command = [str(COMMANDS / "lerobot-train")]
    if ranks > 1:
        command = [str(COMMANDS / "torchrun"), f"--nproc-per-node={ranks}", *command]
    done = subprocess.run(
        [*command, *map(str, arguments)],
        env=OFFLINE,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


def common(dataset: Path, out: Path) -> tuple[str, ...]:
    return (
        *("--policy.device=cpu", "--policy.push_to_hub=false", "--wandb.enable=false"),
        *("--dataset.repo_id=local/set", f"--dataset.root={dataset}"),
        *("--dataset.video_backend=pyav", "--num_workers=0", "--env_eval_freq=0"),
        *("--log_freq=1", f"--output_dir={out}"),
    )


def checkpoint(out: Path, step: str = "last") -> Path:
    return out / "checkpoints" / step / "pretrained_model"


FRESH = """
import sys
import torch
from lerobot.policies import get_policy_class, make_pre_post_processors
import hrc_learn.lerobot

policy = get_policy_class(sys.argv[2]).from_pretrained(sys.argv[1])
before, after = make_pre_post_processors(policy.config, pretrained_path=sys.argv[1])
seen = {k: torch.zeros(f.shape) for k, f in policy.config.input_features.items()}
print("action", *after(policy.select_action(before(seen))).flatten().tolist())
"""


def first_action_in_a_fresh_process(folder: Path, kind: str = "dmp") -> list[float]:
    done = subprocess.run(
        [sys.executable, "-c", FRESH, folder, kind], capture_output=True, text=True, check=True
    )
    (line,) = (x for x in done.stdout.splitlines() if x.startswith("action"))
    return [float(x) for x in line.split()[1:]]


@pytest.mark.parametrize("kind", ["dmp", "motion_chunk"])
def test_train_resume_tune_and_load_with_images(pictures, tmp_path, kind):
    out = tmp_path / "run"
    new = (DISCOVER, f"--policy.type={kind}", *SMALL, *common(pictures, out))
    train(*new, "--batch_size=4", "--steps=4", "--save_freq=2")
    config = json.loads((checkpoint(out) / "config.json").read_text())
    assert config["fps"] == FPS
    assert config["action_feature_names"] == ["a.pos", "b.pos"]
    saved = checkpoint(out, "000002") / "train_config.json"
    resumed = train(DISCOVER, f"--config_path={saved}", "--resume=true", "--steps=6")
    assert "Resuming data order at epoch 0, sample 8" in resumed
    assert checkpoint(out, "000006").is_dir()
    tuned = tmp_path / "tuned"
    start = f"--policy.path={checkpoint(out)}"
    train(ALSO_OF_A_PATH, start, *common(pictures, tuned), "--batch_size=4", "--steps=1")
    assert len(first_action_in_a_fresh_process(checkpoint(tuned), kind)) == 2


def test_two_ranks_learn_what_one_learns(numbers, tmp_path):
    """The same sixteen samples a step, in one batch or in two, before an epoch ends."""
    losses = {}
    episodes = read_episodes(numbers, (STATE, GOAL, "action"))
    for ranks in (1, 2):
        out = tmp_path / f"ranks{ranks}"
        new = (DISCOVER, "--policy.type=dmp", *SMALL, *common(numbers, out), "--seed=0")
        log = train(*new, f"--batch_size={16 // ranks}", "--steps=8", ranks=ranks)
        assert f"{16 // ranks} x {ranks} = 16" in log
        policy = DMPPolicy.from_pretrained(checkpoint(out))
        samples = windows(policy, episodes)
        losses[ranks] = policy.forward(samples.batch(torch.arange(len(samples))))[0].item()
    assert losses[2] == pytest.approx(losses[1], rel=0.01)


def test_a_closed_form_policy_is_a_checkpoint(numbers, tmp_path):
    folder, figures = tmp_path / "policy", tmp_path / "figures.json"
    fit = [sys.executable, ROOT / "training" / "fit_dmp.py", "--as-lerobot-policy"]
    fit += ["--dataset", numbers, "--out", folder, "--n-basis", "12"]
    subprocess.run([*fit, "--json", figures], env=OFFLINE, check=True)
    assert json.loads(figures.read_text())["demonstrations"] == 4
    # Where the arm is, and that is at the origin, but for the rounding of single precision.
    assert first_action_in_a_fresh_process(folder) == pytest.approx([0.0, 0.0], abs=1e-6)
    tuned = tmp_path / "tuned"
    start = f"--policy.path={folder}"
    train(ALSO_OF_A_PATH, start, *common(numbers, tuned), "--batch_size=4", "--steps=1")
    refused = subprocess.run([*fit, "--channels", "joint"], capture_output=True, text=True)
    assert refused.returncode == 2
    assert "takes --n-basis and --episodes alone" in refused.stderr


def test_the_distribution_is_found_by_its_name(numbers, tmp_path):
    """Wheels of both, in an environment that has their requirements and nothing of ours."""
    for project in (ROOT, ROOT / "plugins" / "lerobot_policy_dmp"):
        build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path]
        subprocess.run(build, cwd=project, check=True, capture_output=True)
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    wheels = sorted(tmp_path.glob("*.whl"))
    assert len(wheels) == 2
    install = [python, "-m", "pip", "install", "--no-deps", "--no-index", "--quiet", *wheels]
    subprocess.run(install, check=True)
    # A plain line adds a folder and runs none of the hooks in it, such as editable installs.
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "requirements.pth").write_text(sysconfig.get_path("purelib"))
    nothing_else = {name: x for name, x in OFFLINE.items() if name != "PYTHONPATH"}
    train_there = [python, "-m", "lerobot.scripts.lerobot_train", "--policy.type=dmp", *SMALL]
    done = subprocess.run(
        [*train_there, *common(numbers, tmp_path / "out"), "--batch_size=4", "--steps=1"],
        env=nothing_else,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    where = "import hrc_learn; print(hrc_learn.__file__)"
    found = subprocess.run(
        [python, "-c", where], env=nothing_else, capture_output=True, text=True, cwd=tmp_path
    )
    assert found.stdout.startswith(str(tmp_path / "venv"))
