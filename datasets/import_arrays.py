"""Turn recordings kept as plain arrays (.npz, .npy, .csv) into a LeRobot dataset.

The same as `hrc import`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("import")
