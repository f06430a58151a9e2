"""Look through the episodes of a LeRobot dataset and decide which of them stay.

The same as `hrc curate`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("curate")
