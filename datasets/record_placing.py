"""Record demonstrations of placing an object, with the null-space posture of the arm.

The same as `hrc record placing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("record", "placing")
