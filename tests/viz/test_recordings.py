import subprocess
import sys

import pytest
from sample_runs import sample_fit


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": ()}, "hold 0, 3 and 3"),
        (
            {"reproductions": tuple(d[:-1] for d in sample_fit().demos)},
            "demonstration 0 has 80",
        ),
    ],
)
def test_a_fit_needs_matching_samples(change, message):
    with pytest.raises(ValueError, match=message):
        sample_fit(**change)


def test_importing_viz_imports_no_library_that_draws():
    code = (
        "import sys, hrc_learn.viz, hrc_learn.viz.panels, hrc_learn.viz.report;"
        "print({'rerun', 'matplotlib', 'cv2', 'PIL'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr
