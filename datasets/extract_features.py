"""Find a marker in the videos of a LeRobot dataset and keep its pixels beside the dataset.

The same as `hrc extract`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("extract")
