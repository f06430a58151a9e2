"""A lock on a file, which the system gives back when its holder dies."""

import contextlib
import errno
import os
import socket
from pathlib import Path
from typing import TextIO

# Of file systems that have no locks, such as some network ones.
_NO_LOCKS = {errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL}


def try_lock(file: TextIO) -> bool:
    """Lock an open file, unless another process has done so."""
    try:
        if os.name == "nt":
            import msvcrt

            # One byte far behind the text: others must be able to read that.
            file.seek(2**30)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            return False
        # The best there is then: to believe what the file says of its writer.
        file.seek(0)
        number = file.read().partition(" ")[0]
        return not (number.isdecimal() and is_alive(int(number)))
    return True


def sign(file: TextIO) -> None:
    """Say in a locked file who holds it."""
    file.seek(0)
    file.truncate()
    file.write(f"{os.getpid()} {socket.gethostname()}\n")
    file.flush()


def holder(path: Path) -> str:
    """Who holds the lock on a file, in words."""
    with contextlib.suppress(OSError):
        number, _, host = path.read_text(encoding="utf-8").strip().partition(" ")
        if number:
            return f"process {number}" + ("" if host == socket.gethostname() else f" on {host}")
    return "another process"


def is_at(file: TextIO, path: Path) -> bool:
    """Whether an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def is_alive(pid: int) -> bool:
    """Whether a process of this machine is running, as far as can be told."""
    if os.name == "nt":
        return True  # signal 0 is no question there: it would end the process
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True
