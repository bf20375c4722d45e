"""ODrive motor controllers (CANSimple, firmware 0.6.10) for motorhil.

`host` is the motor interface's side, and `emulated` is the drive's side of the bus. They share
nothing, not even a constant. Each has its own implementation of the protocol, so that a mistake in
one of them shows.
"""
