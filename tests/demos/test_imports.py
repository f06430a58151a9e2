"""Reading and recording need pyarrow alone."""

import subprocess
import sys

from hrc_learn.demos import DatasetWriter

HEAVY = ("lerobot", "datasets", "pandas", "av", "cv2", "mujoco", "rerun")


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def record_code(root) -> str:
    return f"""
import sys
from hrc_learn.demos import DatasetWriter
writer = DatasetWriter({str(root)!r}, 50, "any", ["a", "b"])
writer.start_episode("")
for k in range(20):
    writer.add_frame(joint_position=[k, k])
writer.save_episode()
loaded = [name for name in {HEAVY} if name in sys.modules]
"""


def test_recording_imports_nothing_heavy(tmp_path):
    assert run(record_code(tmp_path / "set") + "print(loaded)") == "[]\n"


def test_reading_and_checking_import_nothing_heavy(tmp_path):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a", "b"]) as writer:
        writer.start_episode("")
        for k in range(20):
            writer.add_frame(joint_position=[k, k])
        writer.save_episode()
    code = f"""
import sys
from hrc_learn.demos import check_dataset, load_demos
load_demos({str(writer.root)!r})
check_dataset({str(writer.root)!r})
print([name for name in {HEAVY} if name in sys.modules])
"""
    assert run(code) == "[]\n"
