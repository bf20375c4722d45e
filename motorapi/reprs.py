"""Representation of values as the call that creates them."""

from dataclasses import MISSING, fields
from enum import Enum
from typing import Any


def given(value: Any) -> str:
    """Return the call that creates this dataclass, without default arguments."""
    arguments = []
    for field in fields(value):
        held = getattr(value, field.name)
        if field.default is MISSING or held != field.default:
            shown = f"{type(held).__name__}.{held.name}" if isinstance(held, Enum) else repr(held)
            arguments.append(f"{field.name}={shown}")
    return f"{type(value).__name__}({', '.join(arguments)})"
