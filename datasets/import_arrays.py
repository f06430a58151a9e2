"""Convert recordings of any format, such as .npz, .npy or .csv, to a LeRobot dataset.

The same as `hrc import`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("import")
