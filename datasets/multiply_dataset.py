"""Make many judged demonstrations from a few.

The same as `hrc multiply`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("multiply")
