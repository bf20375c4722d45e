"""A CiA 402 drive: power state machine, modes and object dictionary over a node and an axis."""
