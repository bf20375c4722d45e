"""The media of a rig, made from what its file says of each bus."""

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
    """The bus, or line, exists in the world, with what goes wrong there.

    Args:
        world: of the rig.
        bus: what the file says of it.
        rules: of its faults, in the order of the file.
        random: its stream of the run's seed.
        clocks: by how much controllers' clocks are off, by name, as of `own_clocks`.
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
    """How much faster than true the clocks of a bus's controllers run [1e-12], of those that do.

    A controller's frames are sent by the oscillator that its firmware runs by.
    """
    clocks: dict[str, int] = {}
    for controller in description.controllers.values():
        if controller.bus == bus and "oscillator" in controller.settings:
            with suppress(SettingError):  # whoever builds the controller tells where it is
                own = oscillator_in(controller.settings, f"{seed}:{controller.name}")
                if own.error_1e12:
                    clocks[controller.name] = own.error_1e12
    return clocks
