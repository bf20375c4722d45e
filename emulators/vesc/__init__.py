"""A VESC on CAN: identifiers of 29 bits, currents, ERPM and angles, packets over frames."""
