"""Defects in the CiA 402 adaptation, under the carriage that is correct."""

from contextlib import contextmanager
from unittest.mock import patch

from motorhil.motorapi.adaptations.cia402 import controlword
from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
from tests.conformance.mutants import MUTANTS, disturbed, lost  # noqa: F401 -- they register mutants
from tests.system.swarm.defects import defect
from tests.system.swarm.defects.carriage import RIG, Carriage


def _mutant(name):
    return lambda: MUTANTS[name].plant()


@contextmanager
def _stop_sent_once():
    with patch.object(controlword, "_REPEATS", 0):
        yield


@contextmanager
def _armed_for_good():
    with patch.object(DriveControl, "disarm", lambda control: None):
        yield


@defect(RIG, "always | ", patches=_mutant("whatever_comes_is_the_answer"))
class TakesAnyAnswer(Carriage):
    """In the adaptation: an SDO response that came twice is taken for the answer to the next
    request."""


@defect(RIG, "always | the carriage rests", patches=_mutant("dead_man_does_nothing"))
class DeadManDoesNothing(Carriage):
    """In the adaptation: 6007h is 0, so a drive that loses its host continues."""

    def obstacle(self, target):
        """Creep to a far place until the obstacle: a lost drive must not creep on."""
        super().obstacle(8.0)


@defect(RIG, "always | an arrival", patches=_mutant("done_after_the_cable_was_cut"))
class LostIsDone(Carriage):
    """In the adaptation: a drive that is not heard counts as at rest, so its motion is done."""


@defect(RIG, "always | doors open", "always | the carriage rests", patches=_stop_sent_once)
class StopSentOnce(Carriage):
    """In the adaptation: a stop is sent once, and nothing sees that its frame was lost."""

    def stop_all(self):
        self.group.stop()
        self.runtime.run_for(0.4)
        self.doors_open()
        self.group.wait_until_done(timeout_s=1.0)


@defect(RIG, "always | ", patches=_armed_for_good)
class ArmedForGood(Carriage):
    """In the adaptation: a set-point that was armed for a start that failed stays armed, until the
    next SYNC."""
