"""`python -m hrc_learn.cli`: the command `hrc` if its script is not installed."""

from hrc_learn.cli import main

if __name__ == "__main__":
    main()
