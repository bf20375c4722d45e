"""Worlds of a rig: their disturbances, how they are drawn, observed, judged and made small."""
