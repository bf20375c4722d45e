"""Objects of an I/O node: outputs, inputs and counters.

| object     | what                                                                          |
| ---------- | ----------------------------------------------------------------------------- |
| 6411h:c    | analogue output of channel c, INTEGER16, +-10 V left-adjusted                   |
| 6443h, 6444h | its reaction when the host is lost: 0 nothing, 1 takes this value             |
| 6200h:1    | digital outputs; bit c - 1 enables the amplifier of channel c                   |
| 6206h, 6207h | their reaction when the host is lost: bits that take a value, and which       |
| 6000h:1    | digital inputs; bits 2c - 2 and 2c - 1 are *ready* and *fault* of channel c      |
| 6820h:c    | encoder counter of channel c, INTEGER32, wraps around; 6810h:c sets it           |

CiA 401 has no position counter. Encoders are CiA 406, and a device of two profiles has the objects
of the second one 800h further on (CiA 301, multiple device modules: 1000h is FFFFh, 67FFh and 6FFFh
have the two device types). A counter is therefore 6020h + 800h, "position value for multi-sensor
devices", and its preset 6010h + 800h. Field bus couplers with counter modules use the same objects
(Turck BL20 among them), so other programs know them. The speed value of CiA 406 is left out: its 16
bits contain less than two counts of 32.
"""

from typing import Final, final

from emulators.canopen.abort_code import OK
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia401.channel import Channel

INPUTS: Final = 0x6000
OUTPUTS: Final = 0x6200
ANALOGUE_OUTPUT: Final = 0x6411
PRESET: Final = 0x6810
POSITION: Final = 0x6820

_ERROR_MODE_8: Final = 0x6206
_ERROR_VALUE_8: Final = 0x6207
_ERROR_MODE: Final = 0x6443
_ERROR_VALUE: Final = 0x6444
_D = DataType


@final
class IoObjects:
    """The values that hosts wrote, and the values that they may read.

    Attributes:
        is_written: a write has happened since the node last looked; the node clears this.
        presets: counters to be set, by channel from 0; the node clears them.
    """

    def __init__(self, od: ObjectDictionary, channels: list[Channel]) -> None:
        self.is_written: bool = False
        self.presets: dict[int, int] = {}
        self._channels = channels
        ensure = od.ensure
        self._outputs = ensure(OUTPUTS, 1, _D.UNSIGNED8, 0)
        self._outputs.writer = self._write
        self._error_mode_8 = ensure(_ERROR_MODE_8, 1, _D.UNSIGNED8, 0xFF)
        self._error_value_8 = ensure(_ERROR_VALUE_8, 1, _D.UNSIGNED8, 0)
        self._analogue: list[Variable] = []
        self._error_mode: list[Variable] = []
        self._error_value: list[Variable] = []
        ensure(INPUTS, 1, _D.UNSIGNED8, 0).reader = self.inputs
        for place, channel in enumerate(channels):
            number = place + 1
            output = ensure(ANALOGUE_OUTPUT, number, _D.INTEGER16, 0)
            output.writer = self._write
            self._analogue.append(output)
            self._error_mode.append(ensure(_ERROR_MODE, number, _D.UNSIGNED8, 1))
            self._error_value.append(ensure(_ERROR_VALUE, number, _D.INTEGER32, 0))
            ensure(POSITION, number, _D.INTEGER32, 0).reader = channel.axis.position_inc
            ensure(PRESET, number, _D.INTEGER32, 0).writer = _Preset(self, place).write

    def inputs(self) -> int:
        """Return the digital inputs, 6000h:1."""
        value = 0
        shift = 0
        for channel in self._channels:
            value |= channel.inputs << shift
            shift += 2
        return value

    def apply(self) -> None:
        """Set the outputs from the objects."""
        enables = self._outputs.integer()
        for place, channel in enumerate(self._channels):
            channel.set_output(self._analogue[place].integer())
            channel.set_enabled(enables >> place & 1 != 0)

    def fall_back(self) -> None:
        """Set the outputs to their error values (6206h, 6207h, 6443h, 6444h) without a host."""
        mode = self._error_mode_8.integer()
        self._outputs.value = self._outputs.integer() & ~mode | self._error_value_8.integer() & mode
        for place, output in enumerate(self._analogue):
            if self._error_mode[place].integer() == 1:
                value = self._error_value[place].integer()
                output.value = max(-32768, min(32767, value))

    def _write(self, value: int) -> int:
        self.is_written = True
        return OK


@final
class _Preset:
    """The writer of one channel's preset."""

    def __init__(self, objects: IoObjects, place: int) -> None:
        self._objects = objects
        self._place = place

    def write(self, value: int) -> int:
        self._objects.presets[self._place] = value
        self._objects.is_written = True
        return OK
