"""Check a LeRobot dataset: what is broken, and what is odd enough to look at before training.

The same as `hrc check`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("check")
