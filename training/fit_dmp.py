"""Fit movement primitives to the demonstrations of a LeRobot dataset.

The same as `hrc fit`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("fit")
