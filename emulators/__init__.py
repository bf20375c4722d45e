"""Virtual motor controllers: the other side of the wire, sans-I/O, told frames and the time."""
