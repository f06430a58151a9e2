"""Record demonstrations of servoing to an object in the image of an uncalibrated camera.

The same as `hrc record servoing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("record", "servoing")
