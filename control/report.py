"""Make one page from the folders of one or several runs.

The same as `hrc report`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("report")
