"""Merge LeRobot datasets whose columns differ in order, names or units.

The same as `hrc merge`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("merge")
