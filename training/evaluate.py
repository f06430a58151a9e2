"""Evaluate fitted movement primitives on demonstrations, such as those held out.

The same as `hrc evaluate`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("evaluate")
