"""Disturbance of a world, as a value and as TOML.

A world is a tuple of disturbances. `fragment` writes it as TOML that is appended to a rig's file.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import written

Value = str | int | float
FRAME_KINDS: Final = ("drop", "delay", "duplicate", "corrupt", "error", "lose", "truncate")
"""Kinds that act on single frames, or transmissions on a line."""
INPUTS: Final[Mapping[str, tuple[str, float]]] = {
    "load": ("load_torque_n_m", 0.0),
    "stall": ("load_torque_n_m", 0.0),
    "heat": ("device_temperature_c", 25.0),
    "supply": ("supply_v", 0.0),
    "power": ("power", 1.0),
}
"""Kinds that change an input of a controller for a while: the input, and its value afterwards."""


@final
@frozen
class Disturbance:
    """One disturbance.

    Attributes:
        kind: a key of `WEIGHTS` of the rig file.
        on: the bus, line or controller; "" for the order of parties.
        values: its parameters by name, units in the names, in the order of drawing.
    """

    kind: str
    on: str
    values: tuple[tuple[str, Value], ...] = ()

    def get(self, name: str) -> Value | None:
        """Return a parameter, or None."""
        return dict(self.values).get(name)

    def number(self, name: str) -> float:
        """Return a parameter that is a number."""
        value = dict(self.values)[name]
        assert not isinstance(value, str)
        return value

    def with_value(self, name: str, value: Value) -> "Disturbance":
        """Return the disturbance with another value of one parameter."""
        values = tuple((key, value if key == name else old) for key, old in self.values)
        return Disturbance(self.kind, self.on, values)

    def as_table(self) -> list[object]:
        """Return it for JSON."""
        return [self.kind, self.on, dict(self.values)]


World = tuple[Disturbance, ...]


def from_table(table: Sequence[object]) -> Disturbance:
    """Return the disturbance of `as_table`."""
    kind, on, values = table
    assert isinstance(values, Mapping)
    return Disturbance(str(kind), str(on), tuple(values.items()))


def fragment(world: World) -> str:
    """Return the world as TOML to append to the rig's file."""
    tables: list[str] = []
    for one in world:
        if one.kind == "interleaving":
            tables.append(f"[world]\ninterleaving = {one.get('seed')}\n")
    counts: dict[str, int] = {}
    for one in world:
        counts[one.kind] = counts.get(one.kind, 0) + 1
        for header, keys in _WRITERS[one.kind](one, f"{one.kind} {counts[one.kind]}"):
            tables.append(written(header, keys))
    return "\n".join(tables)


def kinds_in(text: str) -> frozenset[str]:
    """Return the kinds of disturbances in a fragment; an input names each kind that changes it."""
    table = tomllib.loads(text)
    kinds = {str(one.get("kind")) for one in table.get("fault", ())}
    for one in table.get("stimulus", ()):
        name = one.get("name")
        kinds.update(kind for kind, (own, _) in INPUTS.items() if own == name)
        if name in ("fault", "alarm"):
            kinds.add("fault")
    for one in table.get("world", {}).get("change", ()):
        key = str(one.get("key")).partition(".")[0]
        kinds.add({"quirks": "quirk", "oscillator": "clock"}.get(key, key))
    return frozenset(kinds)


_Tables = list[tuple[str, list[tuple[str, object]]]]


def _frames(one: Disturbance, name: str) -> _Tables:
    keys: list[tuple[str, object]] = [("bus", one.on), ("kind", one.kind), ("name", name)]
    for key, value in one.values:
        keys.append((key, value))
        if key == "identifier" and isinstance(value, int) and value > 0x7FF:
            keys.append(("extended", True))
    return [("fault", keys)]


def _span(one: Disturbance) -> list[tuple[str, object]]:
    start = one.number("at_s")
    return [("from_s", start), ("until_s", round(start + one.number("for_s"), 9))]


def _cut(one: Disturbance, name: str) -> _Tables:
    keys = [("bus", one.on), ("kind", "cut"), ("name", name), ("nodes", [one.get("node")])]
    return [("fault", [*keys, *_span(one)])]


def _noise(one: Disturbance, name: str) -> _Tables:
    keys = [("bus", one.on), ("kind", "noise"), ("name", name)]
    return [("fault", [*keys, *_span(one), ("bit_error_rate", one.number("rate"))])]


def _input(one: Disturbance, name: str) -> _Tables:
    stimulus, rest = INPUTS[one.kind]
    start, value = one.number("at_s"), one.number("value")
    after = one.get("after")
    ends = [(start, value)]
    if one.get("for_s") is not None:
        end = round(start + one.number("for_s"), 9)
        ends.append((end, rest if after is None else one.number("after")))
    return [
        (
            "stimulus",
            [("controller", one.on), ("name", stimulus), ("value", value), ("at_s", at_s)],
        )
        for at_s, value in ends
    ]


def _fault(one: Disturbance, _: str) -> _Tables:
    code, at_s = one.number("code"), one.number("at_s")
    name = one.get("input") or "fault"
    return [("stimulus", [("controller", one.on), ("name", name), ("value", code), ("at_s", at_s)])]


def _change(one: Disturbance, key: str, value: object) -> _Tables:
    return [("world.change", [("controller", one.on), ("key", key), ("value", value)])]


_WRITERS: Final[Mapping[str, Callable[[Disturbance, str], _Tables]]] = {
    **dict.fromkeys(FRAME_KINDS, _frames),
    **dict.fromkeys(INPUTS, _input),
    "cut": _cut,
    "noise": _noise,
    "fault": _fault,
    "quirk": lambda one, _: _change(one, "quirks", [one.get("name")]),
    "clock": lambda one, _: _change(one, "oscillator.ppm", one.number("ppm")),
    "plant": lambda one, _: _change(one, f"plant.{one.get('key')}", one.number("value")),
    "interleaving": lambda one, _: [],
    "kill": lambda one, _: [("world.kill", [("program", one.on), ("at_s", one.number("at_s"))])],
}
