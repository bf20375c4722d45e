"""An emulated CANopen I/O node with amplifiers, motors and encoders (CiA 401, CiA 406)."""
