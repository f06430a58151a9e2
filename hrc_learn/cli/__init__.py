"""The command `hrc`, and the common code of programs with a command line.

`main()` runs the typed command, and `main("record", "placing")` runs `hrc record placing`.
Other programs declare a dataclass as their command line and call `run`. Importing this package
imports no large library.
"""

from hrc_learn.cli._commands import commands as commands
from hrc_learn.cli._commands import main as main
from hrc_learn.cli._run import one_line as one_line
from hrc_learn.cli._run import run as run
from hrc_learn.cli._run import write_values as write_values
from hrc_learn.store import write_json as write_json
from hrc_learn.store import write_text as write_text
