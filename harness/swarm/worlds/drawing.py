"""Drawing of worlds, and their mutation, from a stream of random numbers.

Times are drawn where they matter: half of them anywhere in the run, half around a mark, which is a
command or the answer to one. Frames to hit are drawn in the same way. A further disturbance often
accompanies an earlier one: it concerns the same controller, soon after it, while the program
recovers. A mutation does so even more often, and knows the reactions of the program: the marks
after the disturbances of its parent.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import exp, log
from random import Random
from typing import Any, Final, final

from motorhil.emulators.can.fault_rules import FrameError
from motorhil.frozen import frozen
from motorhil.harness.rig.config.worlds import WEIGHTS, SwarmTable
from motorhil.harness.swarm.worlds.disturbance import Disturbance, Value, World, from_table
from motorhil.harness.swarm.worlds.marks import Traffic, traffic_from
from motorhil.harness.swarm.worlds.profile import Profile, Subject

_LIMITS: Final = (1, 1, 1, 2, 3, 5, 12, 40)
"""Frames in a row that are hit: one, or a frame with all its repetitions."""
_ERRORS: Final = tuple(one.value for one in FrameError)
_CODES: Final = (0x2310, 0x3210, 0x3220, 0x4310, 0x5441, 0x7300, 0x8611)
"""EMCY error codes of CiA 402: current, voltage, temperature, contacts, sensor, following error."""
_ALARMS: Final = (0x10, 0x20, 0x21, 0x22)
_DIGITS: Final = 3
_ACCOMPANIED: Final = 0.4
_ACCOMPANIED_MUTANT: Final = 0.85
_ADDS: Final = 4  # of 8
_AGAIN: Final = 0.5
"""How often a companion tends to be of the same kind: a second fault, a further loss."""
_MARKED: Final = 0.5
_SOON_S: Final = 0.5
"""A program recovers from a disturbance in about this time."""
_REACTING_S: Final = 2.0
"""Reactions are looked for so long after a disturbance: they may await deadlines before."""
_STEP_S: Final = 5e-4
"""The smallest step between two times that are drawn near each other."""
_AHEAD_S: Final = 2e-4
"""A fault rule begins so long before the frame that it should hit."""
_FRAMES_SOON: Final = 30.0
"""Frames of a stream within about `_SOON_S`."""
_TIMES: Final = ("at_s", "from_s")
_ONCE: Final = ("interleaving", "quirk", "clock", "kill")
"""Kinds of which one place has at most one."""
_Draw = Callable[[Random, Profile, SwarmTable], Disturbance | None]


@final
@frozen
class Parent:
    """A world that has met something new.

    Attributes:
        world: its disturbances.
        reactions: frames of its run; their marks are those after a disturbance struck.
        reached: number of conditions of `sometimes` that were true.
    """

    world: World
    reactions: tuple[Traffic, ...] = ()
    reached: int = 0

    def as_table(self) -> list[object]:
        """Return it for JSON."""
        world, reactions = self.world, self.reactions
        rows = [one.as_row() for one in reactions]
        return [[one.as_table() for one in world], rows, self.reached]


def parent_from(table: Sequence[Any]) -> Parent:
    """Return the parent of `as_table`."""
    world, reactions, reached = table
    return Parent(tuple(map(from_table, world)), tuple(map(traffic_from, reactions)), reached)


def drawn(random: Random, profile: Profile, table: SwarmTable) -> World:
    """Return a new world, with 1 to `disturbances` of them, few more often than many."""
    most = table.disturbances
    if most == 0:
        return ()
    count = min(1 + int(random.expovariate(2.0 / most)), most)
    world: World = ()
    for _ in range(count):
        world = _added(world, random, profile, table, _ACCOMPANIED)
    return world


def mutated(parent: Parent, random: Random, profile: Profile, table: SwarmTable) -> World:
    """Return a world that differs from its parent in one or two disturbances."""
    world = parent.world
    profile = replace(profile, reactions=parent.reactions)
    for _ in range(random.choice((1, 1, 2))):
        act = random.randrange(8)
        if act == 0 and len(world) > 1:
            place = random.randrange(len(world))
            world = world[:place] + world[place + 1 :]
        elif act <= _ADDS or not world:
            if len(world) >= max(1, table.disturbances):
                place = random.randrange(len(world))
                world = world[:place] + world[place + 1 :]
            world = _added(world, random, profile, table, _ACCOMPANIED_MUTANT)
        else:
            place = random.randrange(len(world))
            other = _moved(world[place], random)
            world = (*world[:place], other, *world[place + 1 :])
    return world


def _added(
    world: World, random: Random, profile: Profile, table: SwarmTable, accompanied: float
) -> World:
    """Return the world with one more disturbance, or as it is if none could be drawn.

    Args:
        world: the disturbances so far.
        random: where numbers come from.
        profile: the undisturbed run.
        table: the declarations of the rig.
        accompanied: how often it accompanies an earlier one.
    """
    kinds = [kind for kind in WEIGHTS if table.weight(kind) > 0.0]
    if not kinds:
        return world
    weights = [table.weight(one) for one in kinds]
    if world and random.random() < accompanied:
        first = random.choice(world)
        profile = _around(profile, first, random)
        if random.random() < _AGAIN and first.kind in kinds:
            weights[kinds.index(first.kind)] += sum(weights)
    for _ in range(20):
        kind = random.choices(kinds, weights)[0]
        one = _DRAWS[kind](random, profile, table)
        if one is not None and not _is_there(world, one):
            return (*world, one)
    return world


def _around(profile: Profile, one: Disturbance, random: Random) -> Profile:
    """Return the profile as if it were only what happens around a disturbance.

    Marks are those of the parent's reactions, if they are known. One half of the time, controllers
    are restricted to the one concerned.
    """
    at_s = _time_of(profile, one)
    traffic, known = profile.traffic, profile.reactions or profile.traffic
    lasting_s = _REACTING_S if profile.reactions else _SOON_S
    if at_s is not None:
        near = [replace(stream, marks=_near(stream, at_s, lasting_s)) for stream in known]
        traffic = tuple(stream for stream in near if stream.marks)
        traffic = traffic or tuple(replace(stream, marks=()) for stream in profile.traffic)
    subjects = tuple(subject for subject in profile.subjects if subject.name == _concerned(one))
    if not subjects or random.random() < 0.5:
        subjects = profile.subjects
    return replace(profile, traffic=traffic, subjects=subjects, soon_after_s=at_s)


def _near(stream: Traffic, at_s: float, lasting_s: float) -> tuple[tuple[int, float], ...]:
    return tuple(mark for mark in stream.marks if 0.0 <= mark[1] - at_s <= lasting_s)


def _time_of(profile: Profile, one: Disturbance) -> float | None:
    """Return when a disturbance strikes first, as far as it is known."""
    for key in _TIMES:
        if one.get(key) is not None:
            return one.number(key)
    skip = one.get("skip")
    for stream in profile.traffic:
        same = (stream.sender, stream.identifier) == (one.get("sender"), one.get("identifier"))
        if same and stream.bus == one.on and isinstance(skip, int):
            later = [at_s for number, at_s in stream.marks if number >= skip]
            return later[0] if later else None
    return None


def _concerned(one: Disturbance) -> Value | None:
    return one.get("node") or one.get("sender") or one.on


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
        step = round(_log_uniform(random, 1.0, _FRAMES_SOON)) * random.choice((-1, 1))
        return one.with_value(key, max(0, int(value) + step))
    if key == "limit":
        return one.with_value(key, random.choice(_LIMITS))
    if key in ("seed", "bit", "after"):
        return one.with_value(key, int(value) + 1)
    if key in _TIMES:
        step_s = _log_uniform(random, _STEP_S, _SOON_S) * random.choice((-1, 1))
        return one.with_value(key, float(f"{max(0.0, value + step_s):.4f}"))
    return one.with_value(key, _rounded(value * exp(random.gauss(0.0, 0.2))))


# --- kinds ---------------------------------------------------------------------------------------


def _rounded(value: float) -> float:
    """Return a positive number with three digits, so that fragments stay readable."""
    return float(f"{value:.{_DIGITS}g}")


def _log_uniform(random: Random, low: float, high: float) -> float:
    return _rounded(exp(random.uniform(log(low), log(high))))


def _moment(random: Random, profile: Profile) -> float:
    """Return a time within the undisturbed run, or soon after a mark [s]."""
    marked = [one for one in profile.traffic if one.marks]
    if profile.soon_after_s is not None:
        commands = [one for one in marked if not one.answers]
        if commands and random.random() < _MARKED:
            at_s = _next_mark(random, commands)[1] + _log_uniform(random, _STEP_S, _SOON_S)
        else:
            after_s = random.choice((random.uniform(0.0, _SOON_S), _soon(random)))
            at_s = profile.soon_after_s + after_s
        return float(f"{at_s:.4f}")
    if marked and random.random() < _MARKED:
        _, at_s = _mark(random, random.choice(marked).marks)
        after_s = _soon(random)
        return float(f"{max(0.0, at_s + after_s * random.choice((1, 1, 1, -1))):.4f}")
    return float(f"{random.uniform(0.0, profile.end_ns / 1e9):.4f}")


def _soon(random: Random) -> float:
    return _log_uniform(random, _SOON_S / 100, _SOON_S)


def _mark(random: Random, marks: Sequence[tuple[int, float]]) -> tuple[int, float]:
    """Return a mark: any, or the one nearest to some time, so that crowds do not prevail."""
    if random.random() < 0.5:
        return random.choice(marks)
    at_s = random.uniform(marks[0][1], marks[-1][1])
    return min(marks, key=lambda mark: abs(mark[1] - at_s))


def _next_mark(random: Random, marked: Sequence[Traffic]) -> tuple[Traffic, float]:
    """Return a stream and the time of one of its marks: half of the time an early one."""
    marks = [(at_s, place) for place, one in enumerate(marked) for _, at_s in one.marks]
    marks.sort()
    rank = random.randrange(len(marks))
    if random.random() < 0.5:
        rank = min(rank, int(_log_uniform(random, 1.0, len(marks) + 1.0)) - 1)
    at_s, place = marks[rank]
    return marked[place], at_s


def _stream_of(random: Random, profile: Profile, lines: bool) -> Traffic | None:
    """Return the frames to hit: each identifier is as likely as any other."""
    some = [one for one in profile.traffic if (one.bus in profile.lines) is lines]
    return random.choice(some) if some else None


def _hits(random: Random, profile: Profile, one: Traffic) -> tuple[Traffic, tuple[str, Value]]:
    """Return the stream to hit, and from which number or time on."""
    if profile.soon_after_s is not None and one.marks:  # frames have other numbers then
        at_s = _mark(random, one.marks)[1]
        if random.random() < _MARKED:
            some = [two for two in profile.traffic if two.bus == one.bus and two.marks]
            one, at_s = _next_mark(random, some)
        return one, ("from_s", float(f"{max(0.0, at_s - _AHEAD_S):.4f}"))
    if one.marks and random.random() < _MARKED:
        return one, ("skip", _mark(random, one.marks)[0])
    if random.random() < 0.5:
        return one, ("from_s", _moment(random, profile))
    skip = min(int(_log_uniform(random, 1.0, one.frames + 1.0)) - 1, one.frames - 1)
    return one, ("skip", skip)


def _frames(
    kind: str,
    lines: bool | None,
    more: Callable[[Random, SwarmTable, bool], Value | None],
    key: str = "",
) -> _Draw:
    def draw(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
        on_line = _is_on_line(random, profile) if lines is None else lines
        one = _stream_of(random, profile, on_line)
        if one is None:
            return None
        one, first = _hits(random, profile, one)
        values: list[tuple[str, Value]] = [("sender", one.sender)]
        if one.identifier is not None:
            values.append(("identifier", one.identifier))
        values += (first, ("limit", random.choice(_LIMITS)))
        value = more(random, table, _may_be_late(one))
        if value is not None:
            values.append((key, value))
        return Disturbance(kind, one.bus, tuple(values))

    return draw


def _is_on_line(random: Random, profile: Profile) -> bool:
    """Return whether to take a line, of a rig with lines and CAN one half of the time."""
    kinds = {one.bus in profile.lines for one in profile.traffic}
    return random.random() < 0.5 if len(kinds) > 1 else True in kinds


def _nothing(random: Random, table: SwarmTable, may_be_late: bool) -> None:
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
    low, most = min(0.001, table.lasting_s), table.lasting_s
    lasting_s = random.choice(
        (_log_uniform(random, low, most), _rounded(random.uniform(low, most)))
    )
    return ("at_s", _moment(random, profile)), ("for_s", lasting_s)


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
        return _alarm(random, profile)
    values = (("code", random.choice(_CODES)), ("at_s", _moment(random, profile)))
    return Disturbance("fault", one.name, values)


def _alarm(random: Random, profile: Profile) -> Disturbance | None:
    """Return the fault of a drive that calls it an alarm."""
    one = _with(random, profile, "alarm")
    if one is None:
        return None
    values: tuple[tuple[str, Value], ...] = (("code", random.choice(_ALARMS)),)
    values += (("at_s", _moment(random, profile)), ("input", "alarm"))
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


def _kill(random: Random, profile: Profile, table: SwarmTable) -> Disturbance | None:
    if not profile.programs:
        return None
    at_s = ("at_s", _moment(random, profile))
    return Disturbance("kill", random.choice(profile.programs), (at_s,))


def _may_be_late(one: Traffic) -> bool:
    """Return whether frames may be later than deadlines.

    Answers may. A late command acts after its program has given up, and a late status that nothing
    asked for is taken for the present one: no program can tell.
    """
    is_asked_for = one.identifier is None or 2 * len(one.marks) >= one.frames
    return one.answers and is_asked_for


def _delay_s(random: Random, table: SwarmTable, may_be_late: bool) -> float:
    """Return a delay: one half by magnitude, one half evenly, which is often beyond a deadline."""
    most = table.answer_delay_s if may_be_late else table.delay_s
    low = min(1e-3, most)
    return random.choice((_log_uniform(random, low, most), _rounded(random.uniform(low, most))))


_DRAWS: Final[Mapping[str, _Draw]] = {
    "drop": _frames("drop", False, _nothing),
    "delay": _frames("delay", None, _delay_s, "delay_s"),
    "duplicate": _frames("duplicate", False, _nothing),
    "corrupt": _frames("corrupt", None, _nothing),
    "error": _frames("error", False, lambda random, *_: random.choice(_ERRORS), "error"),
    "lose": _frames("lose", True, _nothing),
    "truncate": _frames("truncate", True, lambda random, *_: random.randrange(1, 5), "after"),
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
    "kill": _kill,
}
assert list(_DRAWS) == list(WEIGHTS)


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
