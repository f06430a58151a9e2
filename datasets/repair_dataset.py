"""Write a repaired copy of a LeRobot dataset, and list the changes by episode.

The same as `hrc repair`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("repair")
