"""Classes of `frozen` do what frozen dataclasses of the standard library do."""

import copy
import inspect
import pickle
from dataclasses import FrozenInstanceError, asdict, dataclass, field, fields, replace
from typing import ClassVar

import pytest

from motorhil.frozen import frozen


def shapes(make):
    """Return classes made by `make`, which takes the arguments of `dataclass`."""

    @make()
    class Plain:
        a: int
        b: str = "b"
        c: list[int] = field(default_factory=list)

    @make(kw_only=True)
    class Named:
        KIND: ClassVar[str] = "named"
        a: int = 1
        b: int

    @make()
    class Checked:
        a: int
        doubled: int = field(init=False, compare=False)
        kept: int = field(init=False, default=7, repr=False)
        made: list[int] = field(init=False, default_factory=list, hash=False)
        last: int = field(default=3, kw_only=True)

        def __post_init__(self):
            object.__setattr__(self, "doubled", 2 * self.a)

    @make()
    class Derived(Plain):
        d: float = 0.5

    @make(eq=False, repr=False)
    class Bare:
        a: int

    @make()
    class Own:
        a: int

        def __repr__(self):
            return "own"

        def __eq__(self, other):
            return True

    @make(slots=False)
    class Open:
        a: int

    @make()
    class Empty:
        pass

    return {cls.__name__: cls for cls in (Plain, Named, Checked, Derived, Bare, Own, Open, Empty)}


def of_library(**options):
    return dataclass(**{"frozen": True, "slots": True, **options})


OURS, LIBRARY = shapes(frozen), shapes(of_library)
CALLS = [
    ("Plain", (1,), {}),
    ("Plain", (1, "x", [2]), {}),
    ("Plain", (), {"c": [1], "a": 2}),
    ("Plain", (), {}),
    ("Plain", (1, 2, 3, 4), {}),
    ("Plain", (1,), {"other": 2}),
    ("Named", (), {"b": 2}),
    ("Named", (), {"a": 1}),
    ("Named", (1,), {"b": 2}),
    ("Checked", (4,), {}),
    ("Checked", (4,), {"last": 5}),
    ("Checked", (4, 5), {}),
    ("Derived", (1, "x", [2], 2.5), {}),
    ("Bare", (1,), {}),
    ("Own", (1,), {}),
    ("Open", (1,), {}),
    ("Empty", (), {}),
]


def outcome(call):
    """Return the result of a call, or its error, without addresses."""
    try:
        return call()
    except Exception as error:
        return type(error), str(error)


def seen(cls, args, options):
    """Return all that shows of an instance."""
    one = cls(*args, **options)
    names = [each.name for each in fields(one)]
    hashed = outcome(lambda: hash(one)) if cls.__eq__ is not object.__eq__ else "by identity"
    text = repr(one) if cls.__repr__ is not object.__repr__ else "by address"
    return text, hashed, names, asdict(one), cls.__match_args__, hasattr(one, "__dict__")


@pytest.mark.parametrize(("name", "args", "options"), CALLS)
def test_frozen_class_shows_as_dataclass(name, args, options):
    ours, library = (outcome(lambda c=c: seen(c[name], args, options)) for c in (OURS, LIBRARY))
    assert ours == library


@pytest.mark.parametrize("name", OURS)
def test_frozen_class_has_signature_of_dataclass(name):
    assert str(inspect.signature(OURS[name])) == str(inspect.signature(LIBRARY[name]))
    assert OURS[name].__init__.__qualname__ == LIBRARY[name].__init__.__qualname__


@pytest.mark.parametrize("kind", [OURS, LIBRARY])
def test_frozen_instances_compare_by_class_and_values(kind):
    plain = kind["Plain"]
    assert plain(1) == plain(1) != plain(2)
    assert plain(1) != kind["Derived"](1)
    assert plain(1) != (1, "b", [])
    assert kind["Checked"](1) != kind["Checked"](1, last=4)
    assert kind["Bare"](1) != kind["Bare"](1)
    assert {kind["Named"](b=2): "found"}[kind["Named"](a=1, b=2)] == "found"


@pytest.mark.parametrize("kind", [OURS, LIBRARY])
@pytest.mark.parametrize("name", ["Plain", "Open"])
def test_frozen_instance_refuses_to_change(kind, name):
    one = kind[name](1)
    with pytest.raises(FrozenInstanceError, match="cannot assign to field 'a'"):
        one.a = 2
    with pytest.raises(FrozenInstanceError, match="cannot delete field 'a'"):
        del one.a
    assert one.a == 1


@pytest.mark.parametrize("kind", [OURS, LIBRARY])
def test_frozen_instance_replaced_keeps_other_fields(kind):
    assert replace(kind["Plain"](1, "x"), a=2) == kind["Plain"](2, "x")


@pytest.mark.parametrize("kind", [OURS, LIBRARY])
def test_frozen_instance_in_itself_is_shown(kind):
    items = []
    one = kind["Plain"](1, "x", items)
    items.append(one)
    assert repr(one).endswith(".Plain(a=1, b='x', c=[...])")


@frozen
class Carried:
    """A class that pickle finds."""

    a: int
    b: list[int] = field(default_factory=list)


@frozen(slots=False)
class CarriedOpen:
    """Likewise, without slots."""

    a: int


@pytest.mark.parametrize("one", [Carried(1, [2]), CarriedOpen(3)])
@pytest.mark.parametrize(
    "carry", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))]
)
def test_frozen_instance_is_copied_and_pickled(one, carry):
    assert carry(one) == one


@pytest.mark.parametrize("base", [frozen, of_library])
@pytest.mark.parametrize("heir", [frozen, of_library])
def test_frozen_class_derives_from_either_kind(base, heir):
    @base(kw_only=True, slots=False)
    class Base:
        a: int = 1

    @heir(kw_only=True, slots=False)
    class Heir(Base):
        b: int = 2

    assert asdict(Heir(b=3)) == {"a": 1, "b": 3}
    assert Heir(b=3) == Heir(a=1, b=3) != Heir()
    with pytest.raises(FrozenInstanceError):
        Heir().a = 2


@pytest.mark.parametrize("make", [frozen, of_library])
def test_class_derived_from_mutable_dataclass_is_refused(make):
    @dataclass
    class Base:
        a: int

    with pytest.raises(TypeError, match="frozen"):

        @make()
        class Heir(Base):
            b: int


def test_frozen_class_without_use_is_not_compiled():
    @frozen
    class Unused:
        a: int

    held = vars(Unused)["__init__"]
    assert not inspect.isfunction(held)
    Unused(1)
    assert inspect.isfunction(vars(Unused)["__init__"])


def test_frozen_subclass_compiles_method_of_its_base():
    @frozen
    class Base:
        a: int

    class Heir(Base):
        pass

    assert Heir(1).a == 1
    assert inspect.isfunction(vars(Base)["__init__"])
    assert "__init__" not in vars(Heir)
