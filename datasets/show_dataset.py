"""Show the demonstrations of a LeRobot dataset, a run or a fit in Rerun.

The same as `hrc show`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("show")
