"""The emulated CAN bus: ports, arbitration, faults."""
