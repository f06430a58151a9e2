"""Guide the arm in a browser, and record your own demonstrations.

The same as `hrc page`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("page")
