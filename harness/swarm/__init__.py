"""Swarm: many disturbed worlds of one rig, judged; each failure repeats from its fragment."""
