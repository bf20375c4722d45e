"""Profile of an undisturbed run: what a world can disturb, and when."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.emulators.controller import Controller, ControllerContext
from motorhil.harness.plugins import CONTROLLERS, named
from motorhil.harness.rig.config.derived import plant_in

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
    from motorhil.harness.rig.rig import Rig

_STIMULI: Final[Mapping[str, float]] = {
    "load_torque_n_m": 0.0,
    "device_temperature_c": 25.0,
    "supply_v": 24.0,
    "power": 1.0,
    "fault": 0x5000,
    "alarm": 0x20,
}
_MARKS_MAX: Final = 48
_RARE: Final = 2
"""A frame is marked if its bytes come that often at most."""
_VARIED: Final = (
    *("resistance_ohm", "torque_constant_n_m_a", "rotor_inertia_kg_m2", "coulomb_friction_n_m"),
    *("viscous_friction_n_m_s_rad", "load_inertia_kg_m2"),
)


@final
@dataclass(frozen=True, slots=True)
class Traffic:
    """Frames of one identifier from one sender, or all transmissions of a sender on a line.

    Attributes:
        bus: the bus or line.
        sender: the sender's name, as faults name it.
        identifier: the CAN identifier; None on a line.
        frames: number of frames in the undisturbed run.
        marks: number and time [s] of commands, whose bytes are rare, or of the answers to them.
    """

    bus: str
    sender: str
    identifier: int | None
    frames: int
    marks: tuple[tuple[int, float], ...] = ()


@final
@dataclass(frozen=True, slots=True)
class Subject:
    """A controller that can be disturbed.

    Attributes:
        name: its name.
        bus: its bus or line, on which it can be cut off.
        stimuli: inputs that it has.
        quirks: quirks that it can have.
        has_clock: True if its clock can have an error.
        plant: numbers of its plant that may differ, by key.
        torque_n_m: the torque that its motor can give at the output [N m].
        supply_v: its supply [V].
    """

    name: str
    bus: str
    stimuli: tuple[str, ...]
    quirks: tuple[str, ...]
    has_clock: bool
    plant: tuple[tuple[str, float], ...]
    torque_n_m: float
    supply_v: float


@final
@dataclass(frozen=True, slots=True)
class Profile:
    """Traffic and controllers of an undisturbed run.

    Attributes:
        end_ns: its duration [ns].
        lines: serial lines and TCP connections among the buses.
        traffic: who sends what, in order of the first time.
        subjects: controllers, in the order of the rig.
        parties: True if several parties take turns.
        programs: programs of the rig that share its time, which can be killed.
        soon_after_s: draw times soon after this one [s]; None: anywhere.
    """

    end_ns: int
    lines: tuple[str, ...]
    traffic: tuple[Traffic, ...]
    subjects: tuple[Subject, ...]
    parties: bool
    programs: tuple[str, ...] = ()
    soon_after_s: float | None = None

    def as_table(self) -> dict[str, object]:
        """Return it for JSON."""
        return asdict(self)


def profile_from(table: Mapping[str, Any]) -> Profile:
    """Return the profile of `as_table`."""
    return Profile(
        table["end_ns"],
        tuple(table["lines"]),
        tuple(
            Traffic(**{**one, "marks": tuple((number, at_s) for number, at_s in one["marks"])})
            for one in table["traffic"]
        ),
        tuple(
            Subject(
                **{
                    **one,
                    "stimuli": tuple(one["stimuli"]),
                    "quirks": tuple(one["quirks"]),
                    "plant": tuple((key, value) for key, value in one["plant"]),
                }
            )
            for one in table["subjects"]
        ),
        table["parties"],
        tuple(table["programs"]),
    )


@final
class Profiler:
    """Observer of the undisturbed run."""

    def __init__(self, rig: "Rig") -> None:
        self._rig = rig
        self._heard: dict[_Stream, list[tuple[int, bytes]]] = {}
        rig.world.tap_frames(self._frame)
        rig.world.tap_lines(self._adu)

    def profile(self) -> Profile:
        """Return what was seen, up to now."""
        description = self._rig.description
        lines = tuple(bus.name for bus in description.buses.values() if bus.is_line)
        return Profile(
            self._rig.runtime.now_ns(),
            lines,
            tuple(self._traffic(*key) for key in self._heard),
            subjects_of(description),
            self._rig.runtime.had_parties(),
            tuple(one.name for one in description.programs.values() if one.joins),
        )

    def _traffic(self, bus: str, sender: str, identifier: int | None) -> Traffic:
        heard = self._heard[bus, sender, identifier]
        if sender in self._rig.description.controllers:
            rare = _after(heard, [one for key in self._commands(bus) for one in _rare(key)])
        else:
            rare = _rare(heard)
        return Traffic(bus, sender, identifier, len(heard), _thinned(rare))

    def _commands(self, bus: str) -> list[list[tuple[int, bytes]]]:
        """Return the streams of a bus that no controller sends."""
        controllers = self._rig.description.controllers
        return [
            heard
            for key, heard in self._heard.items()
            if key[0] == bus and key[1] not in controllers
        ]

    def _frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        key = (bus, sender, int.from_bytes(frame[:4], "little") & 0x1FFF_FFFF)
        self._heard.setdefault(key, []).append((time_ns, frame))

    def _adu(
        self,
        line: str,
        now_ns: int,
        begin_ns: int,
        end_ns: int,
        sender: str,
        adu: bytes,
        *_: object,
    ) -> None:
        self._heard.setdefault((line, sender, None), []).append((begin_ns, adu))


_Stream = tuple[str, str, int | None]


def _rare(heard: Sequence[tuple[int, bytes]]) -> list[tuple[int, float]]:
    """Return number and time of the frames whose bytes are rare."""
    counts = Counter(data for _, data in heard)
    return [
        (number, round(time_ns / 1e9, 4))
        for number, (time_ns, data) in enumerate(heard)
        if counts[data] <= _RARE
    ]


def _after(
    heard: Sequence[tuple[int, bytes]], commands: Sequence[tuple[int, float]]
) -> list[tuple[int, float]]:
    """Return number and time of the first frame after each command."""
    times = [round(time_ns / 1e9, 4) for time_ns, _ in heard]
    numbers = sorted({bisect_left(times, at_s) for _, at_s in commands})
    return [(number, times[number]) for number in numbers if number < len(times)]


def _thinned(marks: Sequence[tuple[int, float]]) -> tuple[tuple[int, float], ...]:
    step = -(-len(marks) // _MARKS_MAX) or 1
    return tuple(marks[step - 1 :: step])


def subjects_of(description: "RigDescription") -> tuple[Subject, ...]:
    """Return the controllers of a rig as what can be disturbed."""
    return tuple(_subject(description, one) for one in description.controllers.values())


def _subject(description: "RigDescription", one: "ControllerDescription") -> Subject:
    core = _built(description, one, {})
    plant = plant_in(one)
    return Subject(
        one.name,
        one.bus,
        tuple(name for name, value in _STIMULI.items() if _takes(core, name, value)),
        tuple(
            quirk.name
            for quirk in CATALOGUE
            if "quirks" not in one.settings
            and _built(description, one, {"quirks": [quirk.name]}) is not None
        ),
        "oscillator" not in one.settings
        and _built(description, one, {"oscillator": {"ppm": 1.0}}) is not None,
        () if plant is None else tuple((key, getattr(plant, key)) for key in _VARIED),
        0.0
        if plant is None
        else plant.torque_constant_n_m_a * plant.current_max_a * plant.gear_ratio,
        0.0 if plant is None else plant.supply_v,
    )


def _built(
    description: "RigDescription", one: "ControllerDescription", more: Mapping[str, object]
) -> Controller | None:
    """Return the controller with further settings, or None if it cannot have them."""
    context = ControllerContext(one.name, description.folder, 0)
    settings = {**one.settings, **more}
    settings.pop("nonvolatile_memory", None)
    try:
        built: Controller = named(CONTROLLERS, one.kind).load()(settings, context)
        built.start(0)
    except Exception:
        return None
    return built


def _takes(core: Controller | None, name: str, value: float) -> bool:
    if core is None:
        return False
    try:
        core.stimulate(name, value, 0)
    except ValueError:
        return False
    return True
