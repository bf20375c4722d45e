"""The media of a rig, made from what its file says of each bus."""

from collections.abc import Callable, Sequence

from emulators.media.byte_pipe import BytePipe
from emulators.media.can_bus import CanBus
from emulators.media.faults import FaultPlan, FaultRule
from emulators.media.serial_faults import SerialFaultPlan, SerialFaultRule
from emulators.media.serial_line import SerialLine
from emulators.world import World
from harness.rig_buses import MODBUS_RTU, BusDescription


def add_bus(
    world: World,
    bus: BusDescription,
    rules: Sequence[FaultRule | SerialFaultRule],
    random: Callable[[], float],
) -> None:
    """The bus, or line, exists in the world, with what goes wrong there.

    Args:
        world: of the rig.
        bus: what the file says of it.
        rules: of its faults, in the order of the file.
        random: its stream of the run's seed.
    """
    if not bus.is_line:
        frames = [rule for rule in rules if isinstance(rule, FaultRule)]
        plan = FaultPlan(frames, random)
        can = CanBus(bus.name, bus.bitrate_bit_s, plan, bus.data_bitrate_bit_s)
        world.add_bus(can, bus.nodes)
        return
    line_plan = SerialFaultPlan([one for one in rules if isinstance(one, SerialFaultRule)], random)
    if bus.kind == MODBUS_RTU:
        line = SerialLine(bus.name, bus.bitrate_bit_s, bus.parity, bus.stop_bits, line_plan)
        world.add_serial_line(line, line_plan)
    else:
        world.add_tcp(BytePipe(bus.name, bus.latency_ns, line_plan), line_plan, bus.timeout_ns)
