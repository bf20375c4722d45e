"""Watcher thread, which waits in the kernel for the turn of a place in a queue.

A kernel wait for a lock between processes cannot be cancelled. So each lock has a thread for it,
which lives while there is something to wait for, and a little longer. The thread only makes waits
prompt: waiters also check by themselves from time to time.

After a takeover, a thread that waits for the bytes of the former, living holder would never return.
This thread is abandoned, and another one waits for the bytes of the new epoch.
"""

import threading
from collections.abc import Callable
from typing import Final, final

from motorhil.motorapi.locking.lock_file import LockFile

_LINGER_S: Final = 1.0
"""The lifetime of an idle thread [s]: a process that waited once is likely to wait again."""


@final
class Watch:
    """One waiter: when no process is before it, `is_first` is set and `wake` is called."""

    __slots__ = ("is_first", "is_over", "place", "wake")

    def __init__(self, place: int, wake: Callable[[], None]) -> None:
        self.place: Final = place
        self.wake: Final = wake
        self.is_first: bool = False
        self.is_over: bool = False


@final
class QueueWatcher:
    """Watcher of the places of one process in one queue."""

    def __init__(self, open_file: Callable[[], LockFile]) -> None:
        self._open_file = open_file
        self._changed = threading.Condition()
        self._watches: list[Watch] = []
        self._current: Watch | None = None  # the watch that the thread waits for in the kernel ...
        self._epoch = 0  # ... in this epoch
        self._thread: threading.Thread | None = None
        self._busy_before = 0

    @property
    def busy_before(self) -> int:
        """The place awaited now: an earlier place would be noticed later only."""
        return self._busy_before

    def watch(self, place: int, wake: Callable[[], None]) -> Watch:
        """Call `wake`, in another thread, when no process is before the place."""
        watch = Watch(place, wake)
        with self._changed:
            self._watches.append(watch)
            if self._thread is None:
                self._begin()
            self._changed.notify()
        return watch

    def forget(self, watch: Watch) -> None:
        """Cancel a watch: `wake` is not called any more, or has no effect."""
        watch.is_over = True

    def move_on(self, epoch: int) -> None:
        """Abandon a wait for bytes of an epoch before `epoch`."""
        with self._changed:
            current = self._current
            if current is None or self._epoch >= epoch:
                return
            self._watches.append(current)
            self._current = None
            self._busy_before = 0
            self._begin()

    def _begin(self) -> None:
        self._thread = threading.Thread(
            target=self._work, name="motorapi waits for a lock", daemon=True
        )
        self._thread.start()

    def _work(self) -> None:
        file: LockFile | None = None
        try:
            while True:
                watch = self._next()
                if watch is None:
                    return
                if file is None or file.is_gone:
                    file = self._open_file()
                if not self._wait(file, watch):
                    return  # abandoned
                watch.is_first = True
                if not watch.is_over:
                    watch.wake()
        finally:
            with self._changed:
                if self._is_mine():
                    self._thread = None
                    self._busy_before = 0
            if file is not None:
                file.close()

    def _wait(self, file: LockFile, watch: Watch) -> bool:
        """Wait until no process is before it; False: another thread has taken over the wait."""
        file.look_up()
        while True:
            with self._changed:
                if not self._is_mine():
                    return False
                self._epoch = file.epoch
            file.wait_before(watch.place)
            if file.look_up():
                continue
            file.wait_for_mark()
            if not file.look_up():
                break
        with self._changed:
            if not self._is_mine():
                return False
            self._current = None
        return True

    def _is_mine(self) -> bool:
        return self._thread is threading.current_thread()

    def _next(self) -> Watch | None:
        with self._changed:
            if not self._is_mine():
                return None
            self._busy_before = 0
            while True:
                self._watches = [watch for watch in self._watches if not watch.is_over]
                if self._watches:
                    watch = min(self._watches, key=lambda one: one.place)
                    self._watches.remove(watch)
                    self._busy_before = watch.place
                    self._current = watch
                    return watch
                if not self._changed.wait(_LINGER_S) and not self._watches:
                    self._thread = None
                    return None
