"""The adaptation for Dynamixel servos."""
