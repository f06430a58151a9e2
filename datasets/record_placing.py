"""Record demonstrations of placing an object, end effector and null-space posture at once.

The same as `hrc record placing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("record", "placing")
