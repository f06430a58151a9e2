"""The command `hrc`, and what programs share with it.

`main` is the command; `main("record", "placing")` one of its commands. Other programs have a
dataclass for a command line and `run` it. Importing this imports no library.
"""

from hrc_learn.cli._commands import main as main
from hrc_learn.cli._run import one_line as one_line
from hrc_learn.cli._run import run as run
from hrc_learn.store import write_json as write_json
from hrc_learn.store import write_text as write_text
