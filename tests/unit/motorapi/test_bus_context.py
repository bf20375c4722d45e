"""State of this process for one bus: its parts, and the medium that bus objects share."""

import gc
import os
import weakref
from collections.abc import Callable

import pytest

from motorhil.motorapi.bus_context import BusContext, Parts, context_of


class Bus:
    def __init__(self, name: str = "unknown") -> None:
        self.channel_info = name


class Line:
    def __init__(self, path: str) -> None:
        self.path = path


class Runtime:
    def __init__(self) -> None:
        self.context = BusContext()


class Kept:
    def __init__(self, number: int = 0) -> None:
        self.number = number


def test_part_is_made_once_and_again_after_its_drop():
    parts = Parts()
    assert parts.find(Kept) is None
    first = parts.part(Kept, lambda: Kept(7))
    assert first.number == 7
    assert parts.part(Kept) is parts.find(Kept) is first
    parts.drop(Kept())  # another one
    assert parts.find(Kept) is first
    parts.drop(first)
    assert parts.part(Kept).number == 0


@pytest.mark.parametrize(
    ("make", "shared"),
    [
        (lambda: Bus("a bus"), True),
        (lambda: Bus(), False),
        (lambda: Line("/dev/null"), True),
        (lambda: Line("not a device"), False),
    ],
)
def test_bus_objects_share_the_medium_if_it_is_known(make: Callable[[], object], shared: bool):
    first, second = make(), make()
    assert context_of(first) is context_of(first)
    assert context_of(first).parts is not context_of(second).parts
    assert (context_of(first).medium is context_of(second).medium) is shared


def test_runtime_holds_its_context_itself():
    runtime = Runtime()
    assert context_of(runtime) is runtime.context


def test_medium_is_gone_with_its_last_bus_object():
    first, second = Bus("gone"), Bus("gone")
    kept = weakref.ref(context_of(first).medium.part(Kept))
    context_of(second)
    del first
    gc.collect()
    assert kept() is context_of(second).medium.find(Kept)
    del second
    gc.collect()
    assert kept() is None


def test_forked_child_can_look_contexts_up():
    child = os.fork()
    if child == 0:
        context_of(Bus())
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


def test_bus_that_its_own_parts_refer_to_can_go():
    def use() -> weakref.ref[Bus]:
        bus = Bus("referred to")
        context_of(bus).parts.part(dict, lambda: {"bus": bus})
        return weakref.ref(bus)

    gone = use()
    gc.collect()
    assert gone() is None
