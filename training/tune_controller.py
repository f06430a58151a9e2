"""Tune gains of the controller: the gripper's marker sooner at its target, in simulation.

The same as `hrc tune`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("tune")
