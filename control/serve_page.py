"""Lead the simulated arm in a browser, and record demonstrations of your own.

The same as `hrc page`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("page")
