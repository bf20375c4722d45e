"""Properties that an application states about itself, for campaigns and for plain runs.

    from motorhil import always, sometimes

    always(not (left.is_moving() and door_is_open), "no motion behind an open door")
    sometimes(retries > 0, "a command was repeated")

`always` raises if the condition is false, in any run. `sometimes` only counts: a campaign tells
which of its conditions no world has met.
"""

from typing import Final


class PropertyViolated(AssertionError):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A condition of `always` was false; its name is the message."""


_MET: Final[dict[str, int]] = {}


def always(condition: object, name: str) -> None:
    """Require that the condition is true whenever the application comes here.

    Raises:
        PropertyViolated: it is false.
    """
    if not condition:
        raise PropertyViolated(name)


def sometimes(condition: object, name: str) -> None:
    """Count that the condition was true; each campaign should meet it at least once."""
    _MET[name] = _MET.get(name, 0) + bool(condition)


def met() -> dict[str, int]:
    """Return how often each condition of `sometimes` was true in this process."""
    return dict(_MET)


def forget() -> None:
    """Start to count anew."""
    _MET.clear()
