"""Let a trained LeRobot policy's actions be smoothed: any policy, wherever it is run.

The same as `hrc smooth`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("smooth")
