"""Place an object on three shelves, with a motion that was demonstrated for one shelf.

The same as `hrc run placing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("run", "placing")
