"""A CANopen slave (CiA 301), sans-I/O: one object dictionary and the protocols that serve it."""
