"""A program that uploads 1018h:01h of node 1 of a hub.

python -m tests.support.programs.sdo_asker CHANNEL
"""

import sys

import can

from motorhil.motorapi.adaptations.canopen.bus import open_bus
from motorhil.motorapi.adaptations.canopen.node import node_locks
from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel
from motorhil.motorapi.runtime.wall import runtime_of


def channel_of(bus, *, quarantine_s):
    """Return the SDO channel of node 1, as hardware objects have it."""
    runtime = runtime_of(bus)
    channel = SdoChannel(open_bus(bus, runtime).link, 1, timeout_s=30.0, quarantine_s=quarantine_s)
    channel.process_lock = node_locks(bus, runtime, 1, "node 1")[1]
    return channel


def main():
    with can.Bus(interface="emulated", channel=sys.argv[1]) as bus:
        channel = channel_of(bus, quarantine_s=30.0)
        print("ready", flush=True)
        channel.upload(0x1018, 1)


if __name__ == "__main__":
    main()
