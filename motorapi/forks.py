"""What a forked child must not do with what its parent made."""

from motorapi.errors import UsageError


def refuse_fork(is_the_parents: bool) -> None:
    """Raises UsageError if what is about to be used is the parent's.

    Its connection to the bus is one that both would write to, and what comes in only the parent
    reads; locks of its threads may be locked for ever.
    """
    if is_the_parents:
        raise UsageError(
            "buses and motors were made in the process that this one was forked from, which uses"
            " them: make them anew here, or start this process with 'spawn'"
        )
