"""Look at the demonstrations of a LeRobot dataset: a Rerun recording of all of them.

The same as `hrc show`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("show")
