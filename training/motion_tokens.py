"""Fit motion tokens to a dataset, and report their counts and errors.

The same as `hrc tokens`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("tokens")
