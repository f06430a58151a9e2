"""Reading and recording need pyarrow alone."""

import subprocess
import sys

from hrc_learn.demos import DatasetWriter

HEAVY = ("lerobot", "datasets", "pandas", "av", "cv2", "mujoco", "rerun")
CODE = f"""
import sys

from hrc_learn.demos import DatasetWriter, check_dataset, load_demos

def loaded():
    return [name for name in {HEAVY} if name in sys.modules]

writer = DatasetWriter(sys.argv[1], 50, "any", ["a"])
writer.start_episode("")
writer.add_frame(joint_position=[1])
writer.save_episode()
print("recording", loaded())
load_demos(sys.argv[2])
check_dataset(sys.argv[2])
print("reading", loaded())
"""


def test_recording_reading_and_checking_import_nothing_heavy(tmp_path):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a"]) as writer:
        writer.start_episode("")
        for k in range(20):
            writer.add_frame(joint_position=[k])
        writer.save_episode()
    words = [sys.executable, "-c", CODE, str(tmp_path / "new"), str(tmp_path / "set")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "recording []\nreading []\n"
