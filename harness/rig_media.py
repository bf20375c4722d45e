"""Construction of a rig's buses and lines from their descriptions."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from emulators.controller import SettingError
from emulators.media.byte_pipe import BytePipe
from emulators.media.can_bus import CanBus
from emulators.media.can_node import PLAIN
from emulators.media.faults import FaultPlan, FaultRule
from emulators.media.serial_faults import SerialFaultPlan, SerialFaultRule
from emulators.media.serial_line import SerialLine
from emulators.setting_tables import oscillator_in
from emulators.world import World
from harness.rig_buses import MODBUS_RTU, BusDescription

if TYPE_CHECKING:
    from harness.rig_file import RigDescription


def add_bus(
    world: World,
    bus: BusDescription,
    rules: Sequence[FaultRule | SerialFaultRule],
    random: Callable[[], float],
    clocks: Mapping[str, int],
) -> None:
    """Add the bus or line to the world, with its faults.

    Args:
        world: the rig's world.
        bus: description of the bus.
        rules: rules of its faults, in the order of the file.
        random: its random stream, derived from the run's seed.
        clocks: clock errors of controllers by name, as returned by `own_clocks`.
    """
    if not bus.is_line:
        frames = [rule for rule in rules if isinstance(rule, FaultRule)]
        plan = FaultPlan(frames, random)
        can = CanBus(bus.name, bus.bitrate_bit_s, plan, bus.data_bitrate_bit_s)
        chips = dict(bus.nodes)
        for name, error in clocks.items():
            chip = chips.get(name, PLAIN)
            if not chip.clock_error_1e12:
                chips[name] = replace(chip, clock_error_1e12=error)
        world.add_bus(can, chips)
        return
    line_plan = SerialFaultPlan([one for one in rules if isinstance(one, SerialFaultRule)], random)
    if bus.kind == MODBUS_RTU:
        line = SerialLine(bus.name, bus.bitrate_bit_s, bus.parity, bus.stop_bits, line_plan)
        world.add_serial_line(line, line_plan)
    else:
        world.add_tcp(BytePipe(bus.name, bus.latency_ns, line_plan), line_plan, bus.timeout_ns)


def own_clocks(description: "RigDescription", bus: str, seed: int) -> dict[str, int]:
    """Return the clock errors of a bus's controllers by name [1e-12]; positive runs fast.

    A controller sends its frames with the oscillator of its firmware. Exact clocks are omitted.
    """
    clocks: dict[str, int] = {}
    for controller in description.controllers.values():
        if controller.bus == bus and "oscillator" in controller.settings:
            with suppress(SettingError):  # reported with its line when the controller is built
                own = oscillator_in(controller.settings, f"{seed}:{controller.name}")
                if own.error_1e12:
                    clocks[controller.name] = own.error_1e12
    return clocks
