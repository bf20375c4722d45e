"""A MyActuator RMD on CAN: one request, one answer, angles of the output shaft."""
