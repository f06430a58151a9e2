"""Fit the image Jacobian of an uncalibrated camera to demonstrations.

The same as `hrc fit image-jacobian`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("fit", "image-jacobian")
