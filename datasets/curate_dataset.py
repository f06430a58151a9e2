"""Review the episodes of a LeRobot dataset and decide which episodes to keep.

The same as `hrc curate`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("curate")
