"""Mistakes of sign, unit and place."""

from math import degrees

from motorapi.adaptations.cia402_motor import Cia402Motor
from tests.conformance.mutants import mutant, replaced


@mutant("cia402", "UNIT-01")
def degrees_for_radians():
    """Angles are sent to the drive in degrees."""
    from dataclasses import replace

    def wrong(arm):
        def armed(motor, motion, *, together):
            if motion.target is not None:
                motion = replace(motion, target=degrees(motion.target))
            return arm(motor, motion, together=together)

        return armed

    with replaced(Cia402Motor, "_arm", wrong):
        yield
