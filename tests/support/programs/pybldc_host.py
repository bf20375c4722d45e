"""pybldc as a program of its own, for the licence's sake: frames as lines on its pipes.

    python pybldc_host.py CONTROLLER_ID ping | send HEX [ANSWER_HEX]

A line is "identifier data" in hexadecimal digits. The last line says what pybldc made of it.
"""

import logging
import select
import sys

import can

INPUT = open(0, "rb", buffering=0)  # noqa: SIM115  (select does not see what a buffer holds)


class PipeBus(can.BusABC):
    """A bus on standard input and output."""

    def __init__(self, channel=None, **settings):
        super().__init__(channel, can_filters=settings.get("can_filters"))

    def send(self, msg, timeout=None):
        """Write a frame."""
        print(f"{msg.arbitration_id:08X} {bytes(msg.data).hex().upper()}", flush=True)

    def _recv_internal(self, timeout):
        if not select.select([INPUT], [], [], timeout)[0]:
            return None, False
        line = INPUT.readline().decode().split()
        if len(line) != 2:
            return None, False
        data = bytes.fromhex(line[1])
        return can.Message(arbitration_id=int(line[0], 16), data=data), False


can.Bus = PipeBus

from pybldc import PyBldcCan  # noqa: E402  (with the bus above)


def main():
    """Do what the arguments say, and print the outcome."""
    controller_id, verb, *rest = sys.argv[1:]
    host = PyBldcCan(logging.getLogger(), int(controller_id), interface="pipe")
    if verb == "ping":
        print("pong" if host.ping(timeout=30.0) else "silence", flush=True)
    else:
        packet, *answer = (list(bytes.fromhex(one)) for one in rest)
        host._send_implementation(packet, [], timeout=0.0)
        if answer:
            heard = host._can_listener.packet_queue.get(timeout=30.0)
            print("answer" if heard == answer[0] else f"other answer {heard}", flush=True)
        print("sent", flush=True)
    host.shutdown()


main()
