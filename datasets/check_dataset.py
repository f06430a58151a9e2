"""Check a LeRobot dataset: list errors, and oddities to inspect before training.

The same as `hrc check`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("check")
