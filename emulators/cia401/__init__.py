"""An emulated I/O node with amplifiers and encoders (CiA 401, CiA 406)."""
