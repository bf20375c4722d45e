"""Unused lock files, and their removal.

Each bus has lock files of its own, and a hub is a new bus at each start. So the directory would
grow. Whenever a lock file is created, unused ones are removed:

- A released lock, once its bus is gone or after a day without use.
- An abandoned lock, after a day, if its bus is gone or belongs to a hub. Its next owner would bring
  the motor to rest; so that of a real drive stays.

The lock is held meanwhile. A process that has opened the file before finds it removed, and opens a
new one. A new file has greater tokens.
"""

import os
import re
import socket
import time
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import LockFile

UNUSED_S: Final = 24 * 3600.0
"""The time without use after which a released lock is removed [s]."""
_AT_ONCE_MAX: Final = 32
"""The number of files that one call examines at most; the next call continues."""
_INTERFACE: Final = re.compile(r"can-if(\d+)-net(\d+)(?=-|$)")
_SERIAL: Final = re.compile(r"(?:\w+-)?serial-(\d+)-(\d+)(?=-|$)")
_PTY: Final = 136
"""The major number of pseudo-terminals, which sysfs does not list."""


def is_bus_gone(name: str) -> bool:
    """Return True if the bus of a lock name no longer exists on this host."""
    interface, serial = _INTERFACE.match(name), _SERIAL.match(name)
    if interface is not None:
        index, namespace = map(int, interface.groups())
        if namespace != os.stat("/proc/self/ns/net").st_ino:
            return False
        try:
            return not socket.if_indextoname(index)
        except OSError:
            return True
    if serial is not None:
        major, minor = map(int, serial.groups())
        if major == _PTY:
            return not Path(f"/dev/pts/{minor}").exists()
        lines = Path("/sys/dev/char")
        return lines.exists() and not (lines / f"{major}:{minor}").exists()
    return False


def remove_unused(directory: LockDirectory) -> None:
    """Remove unused lock files; leave any other file alone."""
    now_s = time.time()
    with suppress(OSError, UsageError):
        candidates = (
            (name, now_s - used_s >= UNUSED_S)
            for name, used_s in directory.last_used()
            if now_s - used_s >= UNUSED_S or is_bus_gone(name)
        )
        for name, is_old in islice(candidates, _AT_ONCE_MAX):
            with suppress(OSError, UsageError):
                _remove(directory, name, is_old)


def _remove(directory: LockDirectory, name: str, is_old: bool) -> None:
    file = LockFile(directory, name)
    try:
        if file.is_new or not file.take_at_once() or file.is_gone:
            return
        last = file.last()
        was_abandoned = last is not None and last[2]
        if not was_abandoned or (is_old and (name.startswith("hub-") or is_bus_gone(name))):
            directory.remove(name)
    finally:
        file.close()
