"""The adaptation of the motor interface to an ODrive."""
