"""Limit velocity, acceleration and jerk of the actions of any trained LeRobot policy.

The same as `hrc smooth`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("smooth")
