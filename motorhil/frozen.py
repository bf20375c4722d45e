"""Frozen dataclasses that cost little until they are used.

`dataclasses.dataclass(frozen=True, slots=True)` compiles six methods of each class when its module
is imported. A program that imports 200 such classes spends a quarter of its start on them, and
uses a third. A class of `frozen` behaves alike, and is a dataclass for `fields`, `replace` and
`asdict`. Its `__init__` is compiled at its first use; the other methods need no compilation.

Compiled modules use `dataclass` itself: mypyc knows no other decorator.
"""

from collections.abc import Callable
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, field, fields, is_dataclass
from operator import attrgetter
from reprlib import recursive_repr
from types import FunctionType
from typing import Any, Final, TypeVar, dataclass_transform, final, overload

_Class = TypeVar("_Class", bound=type[Any])
_SET: Final = object.__setattr__  # the one of the class refuses


@final
class _Factory:
    """The default of an argument whose value is made for each instance."""

    def __repr__(self) -> str:
        return "<factory>"


_FACTORY: Final = _Factory()


@overload
def frozen(
    cls: None = None,
    /,
    *,
    kw_only: bool = False,
    slots: bool = True,
    eq: bool = True,
    repr: bool = True,
) -> Callable[[_Class], _Class]: ...
@overload
def frozen(cls: _Class, /) -> _Class: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(
    cls: type[Any] | None = None,
    /,
    *,
    kw_only: bool = False,
    slots: bool = True,
    eq: bool = True,
    repr: bool = True,
) -> Any:
    """Make a frozen dataclass with slots; the arguments are those of `dataclass`."""

    def make(decorated: type[Any]) -> type[Any]:
        methods = _methods(decorated, slots, eq, repr)
        if decorated.__doc__ is None:
            decorated.__doc__ = decorated.__qualname__  # otherwise `dataclass` makes a signature
        derives = any(is_dataclass(base) for base in decorated.__mro__[1:])
        made: type[Any] = dataclass(
            init=False,
            repr=False,
            eq=False,
            frozen=derives,  # a mutable base is refused
            slots=slots,
            kw_only=kw_only,
        )(decorated)
        made.__dataclass_params__.frozen = True  # for heirs that are made by `dataclass`
        for name, method in methods.items():
            setattr(made, name, method)
        return made

    return make if cls is None else make(cls)


def _methods(cls: type[Any], slots: bool, eq: bool, has_repr: bool) -> dict[str, object]:
    """Return the methods to add to a class."""
    own = cls.__dict__
    methods: dict[str, object] = {"__setattr__": _refuse_setting, "__delattr__": _refuse_deleting}
    if slots:
        methods |= {"__getstate__": _state, "__setstate__": _set_state}
    if eq and "__eq__" not in own:
        methods["__eq__"] = _Later("__eq__", _equality)
    if eq and own.get("__hash__") is None:
        methods["__hash__"] = _Later("__hash__", _hash)
    if has_repr and "__repr__" not in own:
        methods["__repr__"] = _text
    if "__init__" not in own:
        methods["__init__"] = _Later("__init__", _init)
    return methods


@final
class _Later:
    """A method that is made when it is first looked up, and then takes the place of this one."""

    __slots__ = ("_make", "_name")

    def __init__(self, name: str, make: Callable[[type[Any]], FunctionType]) -> None:
        self._name = name
        self._make = make

    def __get__(self, instance: object, owner: type[Any]) -> Any:
        holder = next(cls for cls in owner.__mro__ if cls.__dict__.get(self._name) is self)
        method = self._make(holder)
        method.__qualname__ = f"{holder.__qualname__}.{self._name}"
        setattr(holder, self._name, method)
        return method.__get__(instance, owner)


def _init(cls: type[Any]) -> FunctionType:
    """Compile `__init__`; keyword-only arguments come last, as with `dataclass`."""
    known: dict[str, object] = {"_set": _SET, "_FACTORY": _FACTORY}
    positional: list[str] = ["self"]
    named: list[str] = []
    body: list[str] = []
    for number, one in enumerate(fields(cls)):
        given = value = one.name
        if one.default is not MISSING:
            known[f"_default_{number}"] = one.default
            given, value = f"{given}=_default_{number}", value if one.init else f"_default_{number}"
        elif one.default_factory is not MISSING:
            known[f"_make_{number}"] = one.default_factory
            made = f"_make_{number}()"
            given = f"{given}=_FACTORY"
            value = f"{made} if {value} is _FACTORY else {value}" if one.init else made
        elif not one.init:
            continue  # __post_init__ sets it
        if one.init:
            (named if one.kw_only else positional).append(given)
        body.append(f"    _set(self, {one.name!r}, {value})")
    if hasattr(cls, "__post_init__"):
        body.append("    self.__post_init__()")
    arguments = ", ".join([*positional, "*", *named] if named else positional)
    made_here: dict[str, Any] = {}
    exec("\n".join([f"def __init__({arguments}):", *(body or ["    pass"])]), known, made_here)
    method: FunctionType = made_here["__init__"]
    method.__annotations__ = {one.name: one.type for one in fields(cls) if one.init}
    method.__annotations__["return"] = None
    return method


def _values(compared: list[Field[Any]]) -> Callable[[Any], tuple[object, ...]]:
    names = [one.name for one in compared]
    if len(names) > 1:
        return attrgetter(*names)
    return lambda instance: tuple(getattr(instance, name) for name in names)


def _equality(cls: type[Any]) -> FunctionType:
    values = _values([one for one in fields(cls) if one.compare])

    def __eq__(self: Any, other: object) -> bool:  # noqa: N807 -- it becomes a method
        if other.__class__ is not self.__class__:
            return NotImplemented
        return values(self) == values(other)

    return __eq__  # type: ignore[return-value]  # a function is a FunctionType


def _hash(cls: type[Any]) -> FunctionType:
    hashed = [one for one in fields(cls) if (one.compare if one.hash is None else one.hash)]
    values = _values(hashed)

    def __hash__(self: Any) -> int:  # noqa: N807 -- it becomes a method
        return hash(values(self))

    return __hash__  # type: ignore[return-value]  # a function is a FunctionType


@recursive_repr()
def _text(self: Any) -> str:
    shown = [f"{one.name}={getattr(self, one.name)!r}" for one in fields(self) if one.repr]
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _refuse_setting(self: object, name: str, value: object) -> None:
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_deleting(self: object, name: str) -> None:
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _state(self: Any) -> list[object]:
    return [getattr(self, one.name) for one in fields(self)]


def _set_state(self: Any, state: list[object]) -> None:
    for one, value in zip(fields(self), state, strict=True):
        _SET(self, one.name, value)
