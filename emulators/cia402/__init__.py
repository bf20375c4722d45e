"""CiA 402 drive: power state machine, modes and objects."""
