"""Benches for the checks: emulated rigs, their variations, and real buses."""
