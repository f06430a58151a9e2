"""Grasp an object from afar with an uncalibrated camera.

The same as `hrc run grasping`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "grasping")
