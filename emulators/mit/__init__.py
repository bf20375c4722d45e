"""Drives with MIT frames (mini cheetah, CubeMars AK, Damiao), and RobStride's variant."""
