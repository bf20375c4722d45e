"""ODrive motor controllers (CANSimple, firmware 0.6.10) for motorhil.

`host` is the motor interface's side, `emulated` the other side of the wire. They share nothing, not
even a constant: each has its own reading of the protocol, so that a mistake in one shows.
"""
