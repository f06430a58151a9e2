"""Repair a LeRobot dataset into a new copy, and say what was changed in which episode.

The same as `hrc repair`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("repair")
