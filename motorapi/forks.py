"""Refusal of inherited buses and motors in a forked child."""

from motorapi.errors import UsageError


def refuse_fork(is_the_parents: bool) -> None:
    """Raise UsageError if an object to be used belongs to the parent process.

    Both processes would write to its connection, and only the parent reads. Locks of the parent's
    threads may stay locked for ever.
    """
    if is_the_parents:
        raise UsageError(
            "these buses and motors were created in the parent process, which still uses them: "
            "create new ones in this process, or start it with 'spawn'"
        )
