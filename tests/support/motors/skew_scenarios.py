"""Random groups under random traffic, as rig files."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil

from tests.support.motors import software_rigs

HEAD = "[rig]\nseed = 1\n"
DRIVE = """
[controller.{name}]
kind = "cia402"
bus = "{bus}"
node_id = {node}
plant = {{ preset = "wheel_60w", coulomb_friction_n_m = 0.0 }}
servo = {{ tick_s = {tick_s} }}
timing = {{ sdo_reply_s = {reply_s} }}
oscillator = {{ ppm = {ppm}, phase_s = {phase_s} }}
{objects}
[motor.{name}]
adaptation = "cia402"
controller = "{name}"
timing_from_controller = true
status_inhibit_ms = {inhibit_ms}
"""
IDEAL_MOTOR = '[motor.{name}]\nadaptation = "ideal"\n'
MODEL = """[motor.{name}.model]
name = "wheel"
velocity_max_rad_s = 3.0
acceleration_max_rad_s2 = 10.0
"""
OTHER_SYNC = 'objects = { "1005h" = 0x81 }'  # it does not receive our commands, so it has no latch
MIXES = (
    ("latched",),
    ("alone",),
    ("latched", "alone"),
    ("latched", "alone", "live"),
    ("latched", "streamed"),
    ("latched", "alone", "live", "ideal", "streamed"),
    ("software", "ideal", "latched"),
    ("software", "latched", "alone"),
)
# Bit timing for nodes whose clocks differ by nearly 2 %.
WIDE_TIMING = "time_quanta = 8\nsample_point = 6\njump_width = 2\n"
_PPM_USUAL = 3000.0  # beyond twice that, nodes with the usual bit timing fail
_TPDO_SHARE = 0.3  # of a bus


@dataclass(frozen=True)
class Member:
    """One motor of a scenario. `kind`: see MIXES; `live`: a velocity that acts as it is written.

    `distance` also scales a velocity.
    """

    kind: str
    bus: int
    distance: float
    tick_s: float = 0.001
    reply_s: float = 0.001
    ppm: float = 0.0
    phase_s: float = 0.0


@dataclass(frozen=True)
class Message:
    """One declared message, and its transmission: see Sender."""

    bus: int
    can_id: int
    extended: bool
    length: int
    period_us: int
    jitter_us: int
    offset_us: int
    eager: bool


@dataclass(frozen=True)
class Scenario:
    """A group and the traffic on its buses."""

    members: tuple[Member, ...]
    messages: tuple[Message, ...]
    bitrates: tuple[int, ...]
    inhibit_ms: float = 5.0
    heartbeat: bool = True
    enabled_before: bool = False
    idle_us: int = 0
    seed: int = 0


class Choices:
    """The source of a scenario's choices: Hypothesis, or a seeded generator."""

    def __init__(self, whole: Callable[[int, int], int]) -> None:
        self.whole = whole

    def of(self, options):
        """Return one of the values; Hypothesis shrinks towards the first."""
        return options[self.whole(0, len(options) - 1)]

    def flag(self) -> bool:
        """Return True or False."""
        return self.whole(0, 1) == 1


def drawn(choices: Choices) -> Scenario:
    """Return a group of 2 to 14 motors on 1 or 2 buses, with traffic that leaves some capacity."""
    buses = choices.whole(1, 2)
    kinds = choices.of(MIXES)
    bitrates = tuple(choices.of((1_000_000, 500_000)) for _ in range(buses))
    if "software" in kinds:  # its cycle of 1 ms uses half of a bus
        bitrates = (1_000_000,) * buses
    members = tuple(_member(choices, kinds, buses) for _ in range(choices.whole(2, 14)))
    members = tuple(
        replace(one, kind="ideal")
        if one.kind == "software" and ("software", one.bus) in _places(members[:place])
        else one
        for place, one in enumerate(members)
    )
    messages: list[Message] = []
    room = [0.15 if ("software", bus) in _places(members) else 0.45 for bus in range(buses)]
    for _ in range(choices.whole(0, 6)):
        one = _message(choices, buses, [(m.bus, m.can_id, m.extended) for m in messages])
        takes = (160 if one.extended else 135) * 1e6 / bitrates[one.bus] / one.period_us
        if takes <= room[one.bus]:
            room[one.bus] -= takes
            messages.append(one)
    crowded = max(
        sum(one.bus == bus for one in members) * 115e3 / bitrate / _TPDO_SHARE
        for bus, bitrate in enumerate(bitrates)
    )
    return Scenario(
        members=members,
        messages=tuple(messages),
        bitrates=bitrates,
        inhibit_ms=max(float(choices.of((20, 10, 5, 2))), ceil(crowded)),
        heartbeat=choices.flag(),
        enabled_before=choices.flag(),
        idle_us=choices.whole(0, 20_000),
        seed=choices.whole(0, 1_000_000),
    )


def _places(members: Sequence[Member]) -> list[tuple[str, int]]:
    return [(one.kind, one.bus) for one in members]


def _member(choices: Choices, kinds: Sequence[str], buses: int) -> Member:
    return Member(
        kind=choices.of(kinds),
        bus=choices.whole(0, buses - 1),
        distance=choices.of((0.1, 0.02, 0.05, -0.08)),
        tick_s=choices.of((0.001, 0.0005, 0.002)),
        reply_s=choices.of((0.001, 0.0003)),
        ppm=choices.of((0.0, 0.0, 50.0, -100.0, 1000.0)),
        phase_s=choices.whole(0, 10) / 10_000,
    )


_FREE_IDS = (  # not used by any PDO or SDO
    *(*range(0x001, 0x07F), *range(0x100, 0x17F), *range(0x4A0, 0x4FF)),
    *(*range(0x520, 0x57F), *range(0x680, 0x6FF)),
)


def _message(choices: Choices, buses: int, taken: Sequence[tuple[int, int, bool]]) -> Message:
    bus, extended = choices.whole(0, buses - 1), choices.whole(0, 4) == 4
    can_id = choices.of(_FREE_IDS) << (18 if extended else 0)
    while (bus, can_id, extended) in taken:
        can_id += 1
    period_us = choices.of((2_000, 1_000, 5_000, 10_000, 50_000))
    return Message(
        bus=bus,
        can_id=can_id,
        extended=extended,
        length=choices.whole(0, 8),
        period_us=period_us,
        jitter_us=choices.of((0, 0, period_us // 10, period_us)),
        offset_us=choices.whole(0, 20_000),
        eager=choices.flag(),
    )


def rig_text(scenario: Scenario) -> str:
    """Return the rig of a scenario; motors are m1, m2 ..., with these node-IDs."""
    parts = [HEAD]
    for bus, rate in enumerate(scenario.bitrates):
        parts.append(f"[bus.can{bus}]\nbitrate_bit_s = {rate}\n")
        messages = [one for one in scenario.messages if one.bus == bus]
        if not messages:
            parts.append("message = []\n")
        for one in messages:
            parts.append(
                f"[[bus.can{bus}.message]]\nidentifier = {one.can_id}\nlength = {one.length}\n"
                f"period_s = {one.period_us / 1e6}\njitter_s = {one.jitter_us / 1e6}\n"
                f"extended = {str(one.extended).lower()}\n"
            )
        nodes = {f"m{n}": one for n, one in enumerate(scenario.members, 1) if one.bus == bus}
        if any(abs(one.ppm) > _PPM_USUAL for one in nodes.values()):
            parts += [f"[bus.can{bus}.node.{name}]\n{WIDE_TIMING}" for name in ("host", *nodes)]
    for number, member in enumerate(scenario.members, 1):
        parts.append(_motor_text(scenario, number, member))
    return "".join(parts)


def _motor_text(scenario: Scenario, number: int, member: Member) -> str:
    name = f"m{number}"
    if member.kind == "ideal":
        return IDEAL_MOTOR.format(name=name) + MODEL.format(name=name)
    if member.kind == "software":
        plant = f'[controller.io{number}.plant]\npreset = "wheel_60w"\ncoulomb_friction_n_m = 0.0\n'
        clock = f"[controller.io{number}.oscillator]\nppm = {member.ppm}\n"
        clock += f"phase_s = {member.phase_s / 10}\n"
        io = software_rigs.node(f"io{number}", number, more=plant + clock)
        beat = "amplifier_tick_ms = 0.251\n"
        beat += "" if scenario.heartbeat else "heartbeat_ms = 0"
        text = io + software_rigs.motor(name, f"io{number}", motor=beat, friction=0.0)
        return text.replace('"can0"', f'"can{member.bus}"')
    text = DRIVE.format(
        name=name,
        node=number,
        bus=f"can{member.bus}",
        tick_s=member.tick_s,
        reply_s=member.reply_s,
        ppm=member.ppm,
        phase_s=member.phase_s,
        objects=OTHER_SYNC if member.kind in ("alone", "live") else "",
        inhibit_ms=scenario.inhibit_ms,
    )
    beat = "" if scenario.heartbeat else "heartbeat_ms = 0\n"
    return text + beat + MODEL.format(name=name)
