"""An emulated ODrive: its protocol, its controller and its motor."""
