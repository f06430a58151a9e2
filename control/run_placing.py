"""Place an object on three shelves by a motion that was demonstrated for one of them.

The same as `hrc run placing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "placing")
