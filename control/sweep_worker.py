"""A thousand jobs beside workers as one batch: what keeping the distance costs.

The same as `hrc sweep worker`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("sweep", "worker")
