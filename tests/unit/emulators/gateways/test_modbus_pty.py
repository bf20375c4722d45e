"""The gateway to a pseudo-terminal, with a client that only writes."""

import os
import select

import pytest

from motorhil.emulators.gateways.modbus_pty import ModbusPty
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

REQUEST = with_crc(bytes.fromhex("010300000001"))
S = 1_000_000_000


@pytest.mark.parametrize("has_silences", [True, False])
def test_client_that_only_writes_waits_for_the_line(tmp_path, has_silences):
    queue = EventQueue()
    world = World(queue)
    world.add_serial_line(SerialLine("line", 115_200, silences=has_silences), None)
    gateway = ModbusPty(tmp_path / "tty", world, "line")
    client = os.open(tmp_path / "tty", os.O_WRONLY | os.O_NONBLOCK)

    def flood():
        """Return how many bytes the gateway takes at one time, of 1 MB at most."""
        written = 0
        for _ in range(2_000):
            try:
                written += os.write(client, REQUEST * 64)
            except BlockingIOError:
                room = select.select([], [client], [], 0.1)[1]  # the kernel makes some by itself
                if not room and not gateway.sources():
                    break
            for source in gateway.sources():
                gateway.readable(source)
        return written

    try:
        assert flood() < 100_000
        assert gateway.sources() == ()
        queue.run_until(60 * S)
        assert gateway.sources() == (gateway,)
        assert 1_000 < flood() < 100_000
    finally:
        os.close(client)
        gateway.close()
