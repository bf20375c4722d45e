"""Known facts about a recording's motors: limits, units, places.

They come from the attached rig and its motor models, from `--rig RIG`, or from a file of limits:

    [motor.left]                     # its name in the recording, or any
    bus = "can0"                     # its place, unless the recording's rig gives it
    node_id = 1
    axis = 1
    increments_per_rad = 21008.45    # 6064h; velocity_unit_rad_s: meaning of 1 in 606Ch
    position_min_rad = -1.7          # rad or m
    position_max_rad = 1.7
    velocity_max_rad_s = 2.0
    acceleration_max_rad_s2 = 20.0
    torque_max_n_m = 12.0            # linear: force_max_n
    current_max_a = 4.0
    following_error_max_rad = 0.05
    position_max_inc = 40000         # or in the drive's own units: 6064h, 60F4h ...
    velocity_max_raw = 3000          # ... 606Ch, ...
    torque_max_permille = 1000       # ... 6077h

Limits of a model apply to commands. Limits of a file apply to measured values.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import Table, read_source
from motorhil.harness.rig.recording import named_files
from motorhil.settings import Declaration, Key, Number, Rule, Text, given
from motorhil.traces.decoding.attached_rig import MotorFacts, facts_of
from motorhil.traces.mcap.records import Attachment

_FREE: Final = float("inf")
_LIMIT_KEYS: Final = (
    *("torque_max_n_m", "force_max_n", "current_max_a"),
    *("position_min_inc", "position_max_inc", "following_error_max_inc"),
    *("velocity_max_raw", "torque_max_permille"),
    *("position_min_{u}", "position_max_{u}", "velocity_max_{u}_s", "acceleration_max_{u}_s2"),
    *("following_error_max_{u}", "increments_per_{u}", "velocity_unit_{u}_s"),
)
_SIGNED: Final = ("position_m", "increments_per_")


def _limit_key(name: str) -> Key:
    of_scale = name.startswith("increments_per_")
    low = -_FREE if name.startswith(_SIGNED) else 0.0
    return Key(Number(low, not_zero=of_scale), "A limit of measured values.", name)


_LIMITS: Final = Declaration(
    "limits",
    "Limits of one motor's measured values.",
    {
        "bus": Key(Text(shown='"can0"'), "Its bus."),
        "node_id": Key(Number(1, 127, is_whole=True, shown="1"), "Its node-ID."),
        "axis": Key(Number(1, 8, is_whole=True), "Its axis."),
        "controller": Key(Text(), "The controller with its truth."),
        **{name: _limit_key(name) for name in _LIMIT_KEYS},
    },
    {"bus": None, "node_id": None, "axis": 1, "controller": None, **dict.fromkeys(_LIMIT_KEYS)},
    (
        Rule("bus", required=("node_id",), remedy="write node_id = 1"),
        Rule("node_id", required=("bus",), remedy='write bus = "can0"'),
    ),
)


@final
@frozen
class Subject:
    """A motor.

    Attributes:
        name: its name.
        place: (bus, node, axis); None: unknown.
        controller: the controller with its truth.
        channel: channel of that controller, from 1.
        unit: "rad", "m" or "".
        increments_per_unit, velocity_unit, acceleration_unit: of its drive, signed; None: unknown.
        commanded: limits of commands, from its model, with the model's keys without units.
        limits: limits of measured values, from a file of limits, with units in the keys.
        objects: objects of its drive set by the rig at power-on: (index, sub-index) to value.
    """

    name: str
    place: tuple[str, int, int] | None = None
    controller: str | None = None
    channel: int = 1
    unit: str = ""
    increments_per_unit: float | None = None
    velocity_unit: float | None = None
    acceleration_unit: float | None = None
    commanded: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    objects: Mapping[tuple[int, int], int] = field(default_factory=dict)

    def truth_key(self, quantity: str) -> str:
        """Return the key of a quantity of its channel in a controller snapshot."""
        return quantity if self.channel == 1 else f"channel_{self.channel}_{quantity}"


@final
@frozen
class Facts:
    """The facts known beforehand.

    Attributes:
        motors: by name.
        is_complete: True if the user asserts that no frame is missing.
        attachments: files beside those of the recording.
    """

    motors: Mapping[str, Subject] = field(default_factory=dict)
    is_complete: bool = False
    attachments: Sequence[Attachment] = ()

    def with_more(self, motors: Mapping[str, Subject]) -> "Facts":
        """Return these facts with more motors; for equal names, existing facts take precedence."""
        merged = dict(self.motors)
        for name, one in motors.items():
            known = merged.get(name)
            merged[name] = one if known is None else _joined(known, one)
        return replace(self, motors=merged)


def _joined(first: Subject, second: Subject) -> Subject:
    """Return the first subject, completed by the second one."""
    return Subject(
        first.name,
        first.place or second.place,
        first.controller or second.controller,
        first.channel if first.controller else second.channel,
        first.unit or second.unit,
        first.increments_per_unit or second.increments_per_unit,
        first.velocity_unit or second.velocity_unit,
        first.acceleration_unit or second.acceleration_unit,
        {**second.commanded, **first.commanded},
        {**second.limits, **first.limits},
        {**second.objects, **first.objects},
    )


def subjects_in(attachments: Iterable[Attachment]) -> dict[str, Subject]:
    """Return the motors of an attached rig; unreadable attachments are ignored."""
    rig = facts_of(attachments)
    return {name: _subject(motor, rig.settings) for name, motor in rig.motors.items()}


def _subject(motor: MotorFacts, settings: Mapping[str, Mapping[str, Any]]) -> Subject:
    unit, model = motor.unit, motor.model_table
    keys = {
        "position_min": f"position_min_{unit}",
        "position_max": f"position_max_{unit}",
        "velocity_max": f"velocity_max_{unit}_s",
        "acceleration_max": f"acceleration_max_{unit}_s2",
        "deceleration_max": f"deceleration_max_{unit}_s2",
    }
    values = {key: _number(model.get(name)) for key, name in keys.items()}
    commanded = {key: value for key, value in values.items() if value is not None}
    place = None if motor.place is None else (*motor.place, motor.channel)
    return Subject(
        *(motor.name, place, motor.controller, motor.channel, unit),
        *(motor.increments_per_unit, motor.velocity_unit),
        _number(model.get(f"acceleration_unit_{unit}_s2")),
        commanded,
        objects=_objects(settings.get(motor.controller or "", {})),
    )


def _objects(controller: Mapping[str, Any]) -> dict[tuple[int, int], int]:
    """Return the objects whose power-on values the rig sets instead of the EDS."""
    found: dict[tuple[int, int], int] = {}
    values = controller.get("objects")
    for key, value in values.items() if isinstance(values, dict) else ():
        index, _, subindex = key.partition(":")
        try:
            place = int(index.rstrip("hH"), 16), int(subindex or "0")
        except ValueError:
            continue
        if isinstance(value, int):
            found[place] = value
    return found


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def read_rig(path: Path) -> Facts:
    """Return the facts of a rig file: its motors, with the models it names, and its files.

    Raises:
        RigError: it cannot be read, is not valid TOML, or has no motor.
    """
    source = read_source(path, "name a rig; motorhil new DIR writes one")
    root = source.root()
    files = [Attachment(path.name, "application/toml", 0, source.text.encode())]
    for named, media_type in named_files(root.values):
        if named.endswith(".toml"):
            text = read_source(path.parent / named, f"{path} names it as a motor model").text
            files.append(Attachment(Path(named).name, media_type, 0, text.encode()))
    subjects = subjects_in(files)
    if not subjects:
        raise root.missing("motor", "a rig has [motor.NAME]; motorhil new DIR writes one")
    return Facts(subjects, attachments=files)


def read_limits(path: Path) -> dict[str, Subject]:
    """Return the motors of a file of limits.

    Raises:
        RigError: it cannot be read, or has a wrong key or value.
    """
    root = read_source(path, "write one as in docs/how-to/judge-a-recording.md").root()
    root.refuse_unknown(("motor",))
    motors = root.table("motor")
    if not motors.values:
        raise root.missing("motor", "write [motor.NAME], as in docs/how-to/judge-a-recording.md")
    return {name: _limits_of(name, motors.table(name)) for name in motors.values}


def _limits_of(name: str, table: Table) -> Subject:
    unit = _unit_of(table)
    with table.source.with_lines():
        values = given(_LIMITS, table.values, table.path, unit=unit)
    place = None
    if "bus" in values:
        place = (values.pop("bus"), values.pop("node_id"), values.pop("axis", 1))
    values.pop("axis", None)
    controller = values.pop("controller", None)
    limits: dict[str, float] = {key.replace("{u}", unit): value for key, value in values.items()}
    scale = limits.pop(f"increments_per_{unit}", None)
    velocity_unit = limits.pop(f"velocity_unit_{unit}_s", None)
    if not limits:
        remedy = "write velocity_max_rad_s = 2.0, or another limit"
        raise table.source.error(table.path, "has no limit", remedy)
    return Subject(name, place, controller, 1, unit, scale, velocity_unit, None, {}, limits)


def _unit_of(table: Table) -> str:
    """Return the unit of a table; raise RigError if rad and m are mixed."""
    units = {unit: key for key in table.values for unit in ("rad", "m") if _has_unit(key, unit)}
    if len(units) > 1:
        raise table.error(
            units["m"],
            "is in m, but other keys are in rad",
            "use one unit: rad for rotary, m for linear motors",
        )
    return next(iter(units), "")


def _has_unit(key: str, unit: str) -> bool:
    return any(key == pattern.format(u=unit) for pattern in _LIMIT_KEYS if "{u}" in pattern)
