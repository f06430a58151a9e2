"""Grasp objects near a person, carry them to the cabinet and place them on shelves.

The same as `hrc run collaboration`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "collaboration")
