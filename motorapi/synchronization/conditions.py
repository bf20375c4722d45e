"""Conditions for the start of a group: maximum skew, guaranteed in advance."""

from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import SynchronizationError, UsageError
from motorhil.motorapi.synchronization.quality import SyncCapability, SyncLevel


def check_asked(require: object, max_skew_s: object) -> None:
    """Raise UsageError if a condition is not valid."""
    if require is not None and not isinstance(require, SyncLevel):
        raise UsageError(f"require = {require!r}: give a SyncLevel, or None")
    if max_skew_s is not None and not as_number(max_skew_s) >= 0.0:
        raise UsageError(f"max_skew_s = {max_skew_s!r}: must be a number of seconds >= 0")


def require_synchronised(
    capability: SyncCapability, require: SyncLevel | None, max_skew_s: float | None
) -> None:
    """Require that a start can meet the conditions.

    Raises:
        SynchronizationError: it cannot, or no bound is known.
    """
    whose = f"because of {capability.weakest}: {capability.reason}"
    if require is not None and capability.level < require:
        raise SynchronizationError(
            capability=capability,
            asked=f"a start that is at least {require.name}",
            found=f"and it is {capability.level.name} {whose}",
        )
    if max_skew_s is None:
        return
    asked = f"a start skew of at most {max_skew_s:g} s"
    if capability.start_skew_s is None:
        why = capability.no_start_bound or whose
        raise SynchronizationError(
            capability=capability, asked=asked, found=f"and there is no bound: {why}"
        )
    if capability.start_skew_s > max_skew_s:
        raise SynchronizationError(
            capability=capability,
            asked=asked,
            found=f"and it may be {capability.start_skew_s:g} s {whose}",
        )
