"""Record demonstrations of placing a thing on a shelf, hand and body shape at once.

The same as `hrc record placing`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("record", "placing")
