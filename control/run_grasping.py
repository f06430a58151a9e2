"""Grasp an object with an uncalibrated camera, from a distant start.

The same as `hrc run grasping`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "grasping")
