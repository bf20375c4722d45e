"""Fixture: rigs of emulated drives on one bus."""

from tests.support.motors.drive_rigs import open_rig  # noqa: F401
