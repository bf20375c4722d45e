"""Oracles of drives with a protocol of their own: MIT, RobStride, RMD, moteus, VESC, Dynamixel."""
