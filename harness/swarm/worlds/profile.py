"""Profile of an undisturbed run: what a world can disturb, and when."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.emulators.controller import Controller, ControllerContext
from motorhil.frozen import frozen
from motorhil.harness.plugins import CONTROLLERS, named
from motorhil.harness.rig.config.derived import plant_in
from motorhil.harness.swarm.worlds.marks import Marks, Traffic, traffic_from

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
_VARIED: Final = (
    *("resistance_ohm", "torque_constant_n_m_a", "rotor_inertia_kg_m2", "coulomb_friction_n_m"),
    *("viscous_friction_n_m_s_rad", "load_inertia_kg_m2"),
)


@final
@frozen
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
@frozen
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
        reactions: traffic of a disturbed run, with marks after disturbances; (): unknown.
    """

    end_ns: int
    lines: tuple[str, ...]
    traffic: tuple[Traffic, ...]
    subjects: tuple[Subject, ...]
    parties: bool
    programs: tuple[str, ...] = ()
    soon_after_s: float | None = None
    reactions: tuple[Traffic, ...] = ()

    def as_table(self) -> dict[str, object]:
        """Return it for JSON."""
        return {**asdict(self), "traffic": [one.as_row() for one in self.traffic]}


def profile_from(table: Mapping[str, Any]) -> Profile:
    """Return the profile of `as_table`."""
    return Profile(
        table["end_ns"],
        tuple(table["lines"]),
        tuple(map(traffic_from, table["traffic"])),
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
        self._marks = Marks(rig.world, rig.description.controllers)

    def profile(self) -> Profile:
        """Return what was seen, up to now."""
        description = self._rig.description
        lines = tuple(bus.name for bus in description.buses.values() if bus.is_line)
        return Profile(
            self._rig.runtime.now_ns(),
            lines,
            self._marks.traffic(),
            subjects_of(description),
            self._rig.runtime.had_parties(),
            tuple(one.name for one in description.programs.values() if one.joins),
        )


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
