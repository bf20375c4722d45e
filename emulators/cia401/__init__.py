"""An emulated CANopen I/O node with torque amplifiers, motors and encoders (CiA 401, CiA 406)."""
