"""A lock between processes, while somebody has it."""

import threading
from types import TracebackType
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from motorapi.lock_file import LockFile
    from motorapi.process_lock import ProcessLock
    from motorapi.runtime import Runtime


@final
class Hold:
    """A lock that was taken, until `release`; also a context manager.

    Attributes: owner, token (greater than that of anybody before), changed_hands (whether another
    lock object, of whatever process, had it in between, or this one has it for the first time),
    was_abandoned (whether the one before died with it).
    """

    __slots__ = (
        "_counting",
        "_depth",
        "_file",
        "_lock",
        "changed_hands",
        "owner",
        "token",
        "was_abandoned",
    )

    def __init__(
        self,
        lock: "ProcessLock",
        file: "LockFile",
        owner: object,
        token: int,
        *,
        changed_hands: bool,
        was_abandoned: bool,
    ) -> None:
        self._lock = lock
        self._file = file
        self._depth = 1
        self._counting = threading.Lock()
        self.owner: Final = owner
        self.token: Final = token
        self.changed_hands: Final = changed_hands
        self.was_abandoned: Final = was_abandoned

    def __enter__(self) -> "Hold":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    @property
    def is_held(self) -> bool:
        """Whether it was not let go. Never in a forked child: it is the parent's."""
        return self._depth > 0 and not self._file.is_closed

    @property
    def lost_to(self) -> str | None:
        """Who took it over, and why, in words; None: nobody did."""
        return None

    def renew(self) -> None:
        """The lease begins anew.

        Raises:
            MotorBusyError: it was taken over meanwhile; says by whom.
        """

    def again(self) -> None:
        """It takes one more `release` to let go."""
        with self._counting:
            self._depth += 1

    def keep_for(self, runtime: "Runtime", time_s: float) -> None:
        """It is kept for so long [s] after now, whoever releases it meanwhile."""
        self.again()

        def over() -> None:
            timer.cancel()
            self.release()

        try:
            timer = runtime.every(max(time_s, 1e-6), over)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """It was taken once less; after the last time the next one has it. More do nothing."""
        with self._counting:
            self._depth -= 1
            is_last = self._depth == 0
        if is_last:
            self._file.tell_release(self.token)
            self._lock.give_back(self._file)
