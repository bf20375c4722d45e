"""Oracles: what must be so in any recording of drives on a bus, ours or a user's.

from harness.oracles.judge import judge
"""
