import subprocess
import sys


def test_each_module_imports_only_the_library_that_it_draws_with():
    code = (
        "import sys, hrc_learn.viz, hrc_learn.viz.panels, hrc_learn.viz.report;"
        "print({'rerun', 'matplotlib', 'cv2', 'PIL'} & sys.modules.keys());"
        "import hrc_learn.viz.figures; print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split("\n")[:2] == ["set()", "False"], done.stderr
