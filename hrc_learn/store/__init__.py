"""Write files and folders that are complete or absent, even if the writing is interrupted.

A file or folder is written in a workspace next to its destination, on the same file system:

    .NAME.writing/lock        locked by the only process that writes NAME; contains its ID
    .NAME.writing/new         new content
    .NAME.writing/old         previous content
    .NAME.writing/owned.json  parts of `old` that may be deleted

A folder replaces another in three steps, each on disk before the next: `owned.json` is written,
NAME is renamed to `old`, `new` is renamed to NAME. The content of a workspace therefore shows
how far a killed process got, and the next writer of NAME, or `recover`, cleans up:

    new          killed before `new` was complete: `new` is removed
    old and new  killed between the two renames: `new` is complete and is renamed to NAME
    old          killed after both renames: the owned parts of `old` are removed

Two renames are used instead of an exchange because every file system supports them.

When a folder is replaced, only files that its manifest lists, or that match the patterns of its
kind (`Kind.files`), are deleted. If a folder contains other files, these are carried over to
the new folder if its kind has patterns; otherwise the folder is not replaced. If a path is a
symbolic link, the link stays and its target is replaced.
"""

from hrc_learn.store._folder import DATASET as DATASET
from hrc_learn.store._folder import DISK_ERRORS as DISK_ERRORS
from hrc_learn.store._folder import EXPORT as EXPORT
from hrc_learn.store._folder import MADE_BY as MADE_BY
from hrc_learn.store._folder import MANIFEST as MANIFEST
from hrc_learn.store._folder import MODEL as MODEL
from hrc_learn.store._folder import Kind as Kind
from hrc_learn.store._folder import cache_home as cache_home
from hrc_learn.store._folder import changed_files as changed_files
from hrc_learn.store._folder import delete_files as delete_files
from hrc_learn.store._folder import naming as naming
from hrc_learn.store._folder import require_unchanged as require_unchanged
from hrc_learn.store._folder import source_of as source_of
from hrc_learn.store._folder import sync_file as sync_file
from hrc_learn.store._reading import Count as Count
from hrc_learn.store._reading import Metres as Metres
from hrc_learn.store._reading import Pixels as Pixels
from hrc_learn.store._reading import Positive as Positive
from hrc_learn.store._reading import Radians as Radians
from hrc_learn.store._reading import json_text as json_text
from hrc_learn.store._reading import parse_json as parse_json
from hrc_learn.store._reading import read_json as read_json
from hrc_learn.store._reading import read_toml as read_toml
from hrc_learn.store._writing import BusyError as BusyError
from hrc_learn.store._writing import Claim as Claim
from hrc_learn.store._writing import InTheWayError as InTheWayError
from hrc_learn.store._writing import JsonFile as JsonFile
from hrc_learn.store._writing import new_file as new_file
from hrc_learn.store._writing import new_folder as new_folder
from hrc_learn.store._writing import read_made_by as read_made_by
from hrc_learn.store._writing import recover as recover
from hrc_learn.store._writing import replacing as replacing
from hrc_learn.store._writing import resolved as resolved
from hrc_learn.store._writing import settle as settle
from hrc_learn.store._writing import write_json as write_json
from hrc_learn.store._writing import write_text as write_text
