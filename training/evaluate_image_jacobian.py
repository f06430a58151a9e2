"""Measure a learned image Jacobian against the truth, which the simulator knows.

The same as `hrc evaluate image-jacobian`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("evaluate", "image-jacobian")
