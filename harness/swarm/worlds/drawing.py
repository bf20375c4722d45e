"""Drawing of worlds, and their mutation, from a stream of random numbers."""

from collections.abc import Callable, Mapping, Sequence
from math import exp, log
from random import Random
from typing import Final

from motorhil.emulators.can.fault_rules import FrameError
from motorhil.harness.rig.config.worlds import WEIGHTS, SwarmTable
from motorhil.harness.swarm.worlds.disturbance import Disturbance, Value, World
from motorhil.harness.swarm.worlds.profile import Profile, Subject, Traffic

_LIMITS: Final = (1, 1, 1, 2, 3, 5)
_ERRORS: Final = tuple(one.value for one in FrameError)
_CODES: Final = (0x2310, 0x3210, 0x3220, 0x4310, 0x5441, 0x7300, 0x8611)
"""EMCY error codes of CiA 402: current, voltage, temperature, contacts, sensor, following error."""
_DIGITS: Final = 3
_ONCE: Final = ("interleaving", "quirk", "clock")
"""Kinds of which one place has at most one."""
_Draw = Callable[[Random, Profile, SwarmTable], Disturbance | None]


def drawn(random: Random, profile: Profile, table: SwarmTable) -> World:
    """Return a new world, with 1 to `disturbances` of them, few more often than many."""
    most = table.disturbances
    if most == 0:
        return ()
    count = min(1 + int(random.expovariate(2.0 / most)), most)
    world: World = ()
    for _ in range(count):
        world = _added(world, random, profile, table)
    return world


def mutated(world: World, random: Random, profile: Profile, table: SwarmTable) -> World:
    """Return a world that differs from a given one in one or two disturbances."""
    for _ in range(random.choice((1, 1, 2))):
        act = random.randrange(4)
        if act == 0 and len(world) > 1:
            place = random.randrange(len(world))
            world = world[:place] + world[place + 1 :]
        elif act == 1 or not world:
            if len(world) >= max(1, table.disturbances):
                world = world[1:]
            world = _added(world, random, profile, table)
        else:
            place = random.randrange(len(world))
            other = _moved(world[place], random)
            world = (*world[:place], other, *world[place + 1 :])
    return world


def _added(world: World, random: Random, profile: Profile, table: SwarmTable) -> World:
    """Return the world with one more disturbance, or as it is if none could be drawn."""
    kinds = [kind for kind in WEIGHTS if table.weight(kind) > 0.0]
    if not kinds:
        return world
    for _ in range(20):
        kind = random.choices(kinds, [table.weight(one) for one in kinds])[0]
        one = _DRAWS[kind](random, profile, table)
        if one is not None and not _is_there(world, one):
            return (*world, one)
    return world


def _is_there(world: World, one: Disturbance) -> bool:
    """Return True if the world has a disturbance that excludes this one."""
    if one.kind == "plant":
        return any(
            (other.kind, other.on, other.get("key")) == ("plant", one.on, one.get("key"))
            for other in world
        )
    return one.kind in _ONCE and any((one.kind, one.on) == (two.kind, two.on) for two in world)


def _moved(one: Disturbance, random: Random) -> Disturbance:
    """Return the disturbance with one number changed a little, or its target frame moved."""
    numbers = [key for key, value in one.values if not isinstance(value, str)]
    numbers = [key for key in numbers if key not in ("identifier", "code")]
    if not numbers:
        return one
    key = random.choice(numbers)
    value = one.number(key)
    if key == "skip":
        return one.with_value(key, max(0, int(value) + random.choice((-3, -2, -1, 1, 2, 3))))
    if key == "limit":
        return one.with_value(key, random.choice(_LIMITS))
    if key in ("seed", "bit", "after"):
        return one.with_value(key, int(value) + 1)
    return one.with_value(key, _rounded(value * exp(random.gauss(0.0, 0.2))))


# --- kinds ---------------------------------------------------------------------------------------


def _rounded(value: float) -> float:
    """Return a positive number with three digits, so that fragments stay readable."""
    return float(f"{value:.{_DIGITS}g}")


def _log_uniform(random: Random, low: float, high: float) -> float:
    return _rounded(exp(random.uniform(log(low), log(high))))


def _moment(random: Random, profile: Profile) -> float:
    """Return a time within the undisturbed run [s]."""
    return float(f"{random.uniform(0.0, profile.end_ns / 1e9):.4f}")


def _stream_of(random: Random, profile: Profile, lines: bool) -> Traffic | None:
    """Return the frames to hit: each identifier is as likely as any other."""
    some = [one for one in profile.traffic if (one.bus in profile.lines) is lines]
    return random.choice(some) if some else None


def _hits(random: Random, one: Traffic) -> tuple[tuple[str, Value], ...]:
    own: tuple[tuple[str, Value], ...] = (("sender", one.sender),)
    if one.identifier is not None:
        own += (("identifier", one.identifier),)
    skip = min(int(_log_uniform(random, 1.0, one.frames + 1.0)) - 1, one.frames - 1)
    return (*own, ("skip", skip), ("limit", random.choice(_LIMITS)))


def _frames(
    kind: str, lines: bool | None, more: Callable[[Random, SwarmTable], Value | None], key: str = ""
) -> _Draw:
    def draw(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
        on_line = bool(profile.lines) and random.random() < 0.5 if lines is None else lines
        one = _stream_of(random, profile, on_line)
        if one is None:
            return None
        value = more(random, table)
        extra = () if value is None else ((key, value),)
        return Disturbance(kind, one.bus, (*_hits(random, one), *extra))

    return draw


def _nothing(random: Random, table: SwarmTable) -> None:
    return None


def _cut(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    some = [one for one in profile.subjects if one.bus not in profile.lines]
    if not some:
        return None
    one = random.choice(some)
    values = (("node", one.name), *_span(random, profile, table))
    return Disturbance("cut", one.bus, values)


def _span(
    random: Random, profile: Profile, table: SwarmTable
) -> tuple[tuple[str, Value], tuple[str, Value]]:
    low = min(0.001, table.lasting_s)
    return ("at_s", _moment(random, profile)), ("for_s", _log_uniform(random, low, table.lasting_s))


def _noise(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    buses = list(dict.fromkeys(one.bus for one in profile.traffic))
    buses = [one for one in buses if one not in profile.lines]
    if not buses:
        return None
    rate = ("rate", _log_uniform(random, 1e-5, 1e-2))
    return Disturbance("noise", random.choice(buses), (*_span(random, profile, table), rate))


def _with(random: Random, profile: Profile, stimulus: str) -> Subject | None:
    some = [one for one in profile.subjects if stimulus in one.stimuli]
    return random.choice(some) if some else None


def _torque(kind: str, low: float, high: float) -> _Draw:
    def draw(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
        one = _with(random, profile, "load_torque_n_m")
        if one is None or not one.torque_n_m:
            return None
        sign = random.choice((-1.0, 1.0))
        value = sign * _rounded(one.torque_n_m * random.uniform(low, high))
        return Disturbance(kind, one.name, (("value", value), *_span(random, profile, table)))

    return draw


def _heat(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    one = _with(random, profile, "device_temperature_c")
    if one is None:
        return None
    value = ("value", _rounded(random.uniform(50.0, 130.0)))
    return Disturbance("heat", one.name, (value, *_span(random, profile, table)))


def _supply(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    one = _with(random, profile, "supply_v")
    if one is None or not one.supply_v:
        return None
    value = ("value", _rounded(one.supply_v * random.uniform(0.3, 1.4)))
    after = ("after", one.supply_v)
    return Disturbance("supply", one.name, (value, *_span(random, profile, table), after))


def _power(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    one = _with(random, profile, "power")
    if one is None:
        return None
    return Disturbance("power", one.name, (("value", 0.0), *_span(random, profile, table)))


def _fault(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    one = _with(random, profile, "fault")
    if one is None:
        return None
    values = (("code", random.choice(_CODES)), ("at_s", _moment(random, profile)))
    return Disturbance("fault", one.name, values)


def _quirk(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    some = [one for one in profile.subjects if one.quirks]
    if not some:
        return None
    one = random.choice(some)
    return Disturbance("quirk", one.name, (("name", random.choice(one.quirks)),))


def _clock(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    some = [one for one in profile.subjects if one.has_clock]
    if not some or not table.clock_ppm:
        return None
    ppm = float(f"{random.uniform(-table.clock_ppm, table.clock_ppm):.{_DIGITS}g}")
    return Disturbance("clock", random.choice(some).name, (("ppm", ppm),))


def _plant(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    some = [(one.name, key, value) for one in profile.subjects for key, value in one.plant if value]
    if not some or not table.plant_tolerance:
        return None
    name, key, value = random.choice(some)
    factor = random.uniform(1.0 - table.plant_tolerance, 1.0 + table.plant_tolerance)
    return Disturbance("plant", name, (("key", key), ("value", _rounded(value * factor))))


def _interleaving(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    if not profile.parties:
        return None
    return Disturbance("interleaving", "", (("seed", random.randrange(1_000)),))


def _delay_s(random: Random, table: SwarmTable) -> float:
    return _log_uniform(random, min(1e-4, table.delay_s), table.delay_s)


_DRAWS: Final[Mapping[str, _Draw]] = {
    "drop": _frames("drop", False, _nothing),
    "delay": _frames("delay", None, _delay_s, "delay_s"),
    "duplicate": _frames("duplicate", False, _nothing),
    "corrupt": _frames("corrupt", None, _nothing),
    "error": _frames("error", False, lambda random, _: random.choice(_ERRORS), "error"),
    "lose": _frames("lose", True, _nothing),
    "truncate": _frames("truncate", True, lambda random, _: random.randrange(1, 5), "after"),
    "cut": _cut,
    "noise": _noise,
    "load": _torque("load", 0.05, 0.8),
    "stall": _torque("stall", 1.5, 3.0),
    "heat": _heat,
    "supply": _supply,
    "power": _power,
    "fault": _fault,
    "quirk": _quirk,
    "clock": _clock,
    "plant": _plant,
    "interleaving": _interleaving,
}
assert list(_DRAWS) == list(WEIGHTS)


def kinds_of(worlds: Sequence[World]) -> dict[str, int]:
    """Return how many disturbances of each kind some worlds have."""
    counts: dict[str, int] = {}
    for world in worlds:
        for one in world:
            counts[one.kind] = counts.get(one.kind, 0) + 1
    return counts


_TRIES: Final = 20


def possible(profile: Profile, table: SwarmTable) -> tuple[str, ...]:
    """Return the kinds of disturbances that worlds of a rig can have."""
    random = Random("possible")
    return tuple(
        kind
        for kind in WEIGHTS
        if table.weight(kind) > 0.0
        and any(_DRAWS[kind](random, profile, table) is not None for _ in range(_TRIES))
    )
