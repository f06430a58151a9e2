"""Files and folders that are whole or not there at all, however the writing ends.

Whatever is written takes shape in a workspace beside its place, on the same file system:

    .NAME.writing/lock        held by the one process that writes NAME, and says which
    .NAME.writing/new         what is being written
    .NAME.writing/old         what had the name before
    .NAME.writing/owned.json  the parts of `old` that may be deleted

A folder replaces another in three steps, each on disk before the next: `owned.json` is written,
NAME is renamed to `old`, `new` is renamed to NAME. So the contents of a workspace tell how far
a killed process came, and the next writer of NAME, or `recover`, mends it under the lock:

    new          not finished, or not acknowledged: removed
    old and new  between the two renames, so `new` is whole: it takes the name
    old          after them: the owned parts of `old` are removed

Two renames instead of one exchange, because every file system and operating system has them.

Of an older result only what its manifest lists is ever deleted, and a folder that holds
anything else is not replaced. A path through a symbolic link keeps the link and replaces what
it points to.
"""

from hrc_learn.store._claim import BusyError as BusyError
from hrc_learn.store._claim import Claim as Claim
from hrc_learn.store._claim import InTheWayError as InTheWayError
from hrc_learn.store._claim import recover as recover
from hrc_learn.store._claim import resolved as resolved
from hrc_learn.store._claim import settle as settle
from hrc_learn.store._disk import delete_files as delete_files
from hrc_learn.store._disk import sync_file as sync_file
from hrc_learn.store._ownership import DATASET as DATASET
from hrc_learn.store._ownership import EXPORT as EXPORT
from hrc_learn.store._ownership import MADE_BY as MADE_BY
from hrc_learn.store._ownership import MANIFEST as MANIFEST
from hrc_learn.store._ownership import MODEL as MODEL
from hrc_learn.store._ownership import RESULTS as RESULTS
from hrc_learn.store._ownership import Kind as Kind
from hrc_learn.store._ownership import source_of as source_of
from hrc_learn.store._writing import new_file as new_file
from hrc_learn.store._writing import new_folder as new_folder
from hrc_learn.store._writing import read_made_by as read_made_by
from hrc_learn.store._writing import replacing as replacing
from hrc_learn.store._writing import write_json as write_json
from hrc_learn.store._writing import write_text as write_text
