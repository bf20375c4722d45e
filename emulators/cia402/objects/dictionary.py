"""The drive's objects 6000h-67FFh that have an effect.

Objects in the EDS are bound to the drive. Objects missing there are invisible to SDO and PDO, but
act with the default stated where they are bound (CiA 402-2's, or derived from the motor). Related
objects have a module: motion, torque, offsets, interpolation, windows, homing, option codes, gains.

6502h, supported drive modes, shows only modes that are emulated. The bit of a mode is one less than
its number in 6060h; bits 16 to 31 are manufacturer-specific.
"""

from collections.abc import Sequence
from typing import Final, final

from motorhil.emulators.canopen.codes import OK, AbortCode
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.cia402.objects.changes import Choice, ObjectChange, ObjectChanges, watch
from motorhil.emulators.cia402.objects.mode_objects import HomingObjects, IpObjects
from motorhil.emulators.cia402.objects.motion import MotionObjects, OptionCodes, WindowObjects
from motorhil.emulators.cia402.objects.torque import ControlParameters, OffsetObjects, TorqueObjects
from motorhil.emulators.cia402.objects.units import (
    POSITION_POLARITY,
    VELOCITY_POLARITY,
    DriveDefaults,
    FactorGroup,
    Units,
    fill_factors,
)
from motorhil.emulators.cia402.settings import EMULATED_MODES, DriveSettings

_SERVO_DRIVE: Final = 0x0002_0192  # 1000h: profile 402; CiA 402-1, device type
_STANDARD: Final = 0xFFFF
_EMULATED: Final = sum(1 << (code - 1) for code in EMULATED_MODES.values())
_TARGETS: Final = (
    ("pp", 0x607A),
    ("pv", 0x60FF),
    ("tq", 0x6071),
    ("ip", 0x60C1),
    ("csp", 0x607A),
    ("csv", 0x60FF),
    ("cst", 0x6071),
)

_D = DataType
_CONTROLWORD: Final = int(ObjectChange.CONTROLWORD)
_GAINS: Final = int(ObjectChange.GAINS)
_MODE: Final = int(ObjectChange.MODE)
POLARITIES: Final = frozenset((0, VELOCITY_POLARITY, POSITION_POLARITY, 0xC0))  # 607Eh


def modes_with_target(od: ObjectDictionary) -> int:
    """Return the emulated modes whose target object exists, for an EDS without a 6502h."""
    modes = _EMULATED
    for name, index in _TARGETS:
        if not od.has_index(index):
            modes &= ~(1 << (EMULATED_MODES[name] - 1))
    return modes


def honest_modes(stated: int, names: Sequence[str] | None) -> int:
    """Return the modes of the rig (None: as stated), without those that are not emulated."""
    wanted = stated & _STANDARD
    if names is not None:
        wanted = 0
        for name in names:
            wanted |= 1 << (EMULATED_MODES[name] - 1)
    return (stated & ~_STANDARD) | (wanted & _EMULATED)


@final
class GainWatch:
    """A writer that refuses a gain that would make the current loop unstable."""

    def __init__(self, control: ControlParameters, place: int, changes: ObjectChanges) -> None:
        self._control = control
        self._place = place
        self._changes = changes

    def write(self, value: int) -> int:
        """Check a value before it is stored; return 0 or an abort code."""
        code = self._control.check(self._place, value)
        if code == OK:
            self._changes.pending |= _GAINS
        return code


@final
class DriveObjects:
    """The objects that a host can write, converted to increments and seconds.

    Attributes:
        changes: kinds of objects written since the drive last looked; the drive clears the bits.
        controlword, mode: as last written.
        error_code: 603Fh.
        supported_modes: 6502h.
        factors, units: the meaning of the raw numbers.
        motion, torque, offsets, ip, windows, homing, options: groups of related objects.
        control: the servo's gains.
    """

    def __init__(self, od: ObjectDictionary, settings: DriveSettings) -> None:
        self.od = od
        self.settings = settings
        self.changes: ObjectChanges = ObjectChanges()
        self.controlword: int = 0
        self.mode: int = 0
        plant = settings.plant
        fill_factors(od, plant)
        ensure = od.ensure
        ensure(0x1000, 0, _D.UNSIGNED32, _SERVO_DRIVE)
        polarity = ensure(0x607E, 0, _D.UNSIGNED8, 0)
        polarity.writer = Choice(POLARITIES, self.changes, ObjectChange.FACTORS).write
        for subindex in (1, 2):
            ensure(0x607B, subindex, _D.INTEGER32, 0)
        self.factors: FactorGroup = FactorGroup(od, settings)
        self.units: Units = self.factors.units
        defaults = DriveDefaults(plant, self.units)
        self._controlword = ensure(0x6040, 0, _D.UNSIGNED16, 0)
        self._controlword.writer = self._write_controlword
        self._mode = ensure(0x6060, 0, _D.INTEGER8, EMULATED_MODES["pp"])
        self._mode.writer = self._write_mode
        self.error_code: Variable = ensure(0x603F, 0, _D.UNSIGNED16, 0)
        self._supported = ensure(0x6502, 0, _D.UNSIGNED32, modes_with_target(od))
        self.supported_modes: int = self._honest_modes()

        self.motion: MotionObjects = MotionObjects(od, plant, self.factors, defaults, self.changes)
        self.torque: TorqueObjects = TorqueObjects(od, plant, defaults)
        self.offsets: OffsetObjects = OffsetObjects(od, self.factors, self.torque)
        self.ip: IpObjects = IpObjects(od, self.factors, self.changes)
        self.windows: WindowObjects = WindowObjects(od, self.factors, defaults)
        self.homing: HomingObjects = HomingObjects(od, self.factors, self.motion, defaults)
        self.options: OptionCodes = OptionCodes(od, self.motion)
        self.control: ControlParameters = ControlParameters(
            od,
            plant,
            settings.gains,
            settings.tick_ns,
            settings.current_steps,
            settings.oscillator.rate(),
        )
        for place, gain in enumerate(self.control.places):
            gain.writer = GainWatch(self.control, place, self.changes).write
        watch(od, self.changes)
        self.reload()

    def reload(self) -> None:
        """Reload the values after they were reset to their defaults (reset node)."""
        self.changes.pending = 0
        self.controlword = self._controlword.integer()
        self.mode = self._mode.integer()
        self.motion.reload()
        self.ip.reload()
        self.reload_units()

    def reload_units(self) -> None:
        """Reload the units after a factor object was written."""
        self.factors.reload()
        self.units = self.factors.units

    def supports(self, mode: int) -> bool:
        """Return True if 6502h contains the mode."""
        return mode > 0 and self.supported_modes >> (mode - 1) & 1 != 0

    def _honest_modes(self) -> int:
        """Set 6502h to the modes that are really emulated, and return it."""
        modes = honest_modes(self._supported.integer(), self.settings.supported_modes)
        self._supported.set_default(modes)
        return modes

    def _write_controlword(self, value: int) -> int:
        self.controlword = value
        self.changes.pending |= _CONTROLWORD
        return OK

    def _write_mode(self, value: int) -> int:
        if value != 0 and not self.supports(value):
            return AbortCode.INVALID_VALUE
        self.mode = value
        self.changes.pending |= _MODE
        return OK
