"""Dynamixel servos."""
