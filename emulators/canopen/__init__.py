"""A CANopen slave (CiA 301), sans-I/O: an object dictionary and its protocols."""
