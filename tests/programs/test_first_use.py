"""The benchmark of a newcomer's wait, which reads a page and watches a terminal."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import bench_first_use as first_use  # pyright: ignore[reportMissingImports]

PAGE = """# A page
```sh
hrc check --dataset demos   # is it good?

hrc page --out mine
hrc fit --dataset demos --out model
```
Words, and what is not for a shell:
```python
print("hrc show model")
```
```sh
hrc show model
```
"""


def test_commands_are_those_of_shell_blocks_that_end_by_themselves():
    assert first_use.commands_of(PAGE) == [
        "hrc check --dataset demos",
        "hrc fit --dataset demos --out model",
        "hrc show model",
    ]


def test_a_page_of_the_documentation_has_commands():
    commands = first_use.commands_of(first_use.Args().page.read_text("utf-8"))
    assert "hrc record placing" in " ".join(commands)


def test_the_longest_silence_is_the_one_without_output(tmp_path):
    # Three words at once, then silence that is longer than all others by far.
    program = "echo one; echo two; sleep 0.7; printf '\\033[1mthree\\033[0m\\n'"
    waited = first_use.wait_for(f'sh -c "{program}"', tmp_path)
    assert waited.status == 0
    assert waited.before == "two"
    assert 0.6 < waited.silence <= waited.wall
    assert waited.cpu < waited.wall  # it slept
    assert [line for line in waited.output.split() if "three" in line]


def test_what_children_take_is_counted(tmp_path):
    burn = "import time; e = time.process_time() + 0.5\nwhile time.process_time() < e: pass"
    (tmp_path / "burn.py").write_text(burn, "ascii")
    waited = first_use.wait_for(f"sh -c '{sys.executable} burn.py; true'", tmp_path)
    assert waited.cpu >= 0.5


def test_a_command_that_fails_says_so(tmp_path):
    assert first_use.wait_for("sh -c 'echo wrong; exit 3'", tmp_path).status == 3
    with pytest.raises(FileNotFoundError):
        first_use.wait_for("no-such-program", tmp_path)
