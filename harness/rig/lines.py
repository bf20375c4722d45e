"""Serial lines as a rig describes them."""

from motorhil.emulators.media.serial_faults import SerialFaultPlan
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.harness.rig.config.buses import MODBUS_RTU, BusDescription


def serial_line(bus: "BusDescription", plan: SerialFaultPlan | None = None) -> SerialLine:
    """Return the wires of a serial line of a rig."""
    settings = (bus.bitrate_bit_s, bus.parity, bus.stop_bits)
    return SerialLine(bus.name, *settings, plan, silences=bus.kind == MODBUS_RTU)
