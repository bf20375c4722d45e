"""A thread that waits in the kernel until a place in a queue is the first, and says so.

A wait on a lock between processes cannot be given up, so it has a thread of its own, one per lock,
which lives as long as there is something to wait for, and a little longer. It only makes waits
prompt: whoever waits also looks by itself now and then.

A thread that waits for what a living process has lost, and keeps, would wait for ever: when the
lock was taken over it is left behind, and another one waits for what counts now.
"""

import threading
from collections.abc import Callable
from typing import Final, final

from motorapi.lock_file import LockFile

_LINGER_S: Final = 1.0
"""How long the thread stays when there is nothing to wait for: who waits once waits again."""


@final
class Watch:
    """One who waits: `is_first` once nobody is before it, and then `wake` was called."""

    __slots__ = ("is_first", "is_over", "place", "wake")

    def __init__(self, place: int, wake: Callable[[], None]) -> None:
        self.place: Final = place
        self.wake: Final = wake
        self.is_first = False
        self.is_over = False


@final
class QueueWatcher:
    """Watches over the places that one process has in one queue."""

    def __init__(self, open_file: Callable[[], LockFile]) -> None:
        self._open_file = open_file
        self._changed = threading.Condition()
        self._watches: list[Watch] = []
        self._current: Watch | None = None  # the one that is waited for in the kernel ...
        self._epoch = 0  # ... in this epoch
        self._thread: threading.Thread | None = None
        self._busy_before = 0

    @property
    def busy_before(self) -> int:
        """The place it waits for now: a new place before that is found free only later."""
        return self._busy_before

    def watch(self, place: int, wake: Callable[[], None]) -> Watch:
        """`wake` is called, in another thread, when nobody is before the place."""
        watch = Watch(place, wake)
        with self._changed:
            self._watches.append(watch)
            if self._thread is None:
                self._begin()
            self._changed.notify()
        return watch

    def forget(self, watch: Watch) -> None:
        """`wake` is not called any more, or has no effect."""
        watch.is_over = True

    def move_on(self, epoch: int) -> None:
        """Nobody waits any more for what counted before this epoch."""
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
                    return  # left behind
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
        """Nobody is before it; False: another thread waits for that."""
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
