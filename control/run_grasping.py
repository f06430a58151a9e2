"""Grasp an object from afar with a camera that nobody calibrated.

The same as `hrc run grasping`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "grasping")
