"""An adaptation to the drive of the template with few hooks, so that defaults of others are met.

It tells a fault only when it is asked for, measures positions in steps, and gives no low-level
access.
"""

from motorhil.harness.examples.new_drive.host import MotorTable, MydriveHwMotor, MydriveMotor
from motorhil.motorapi import Motor
from motorhil.motorapi.api import CanBuilder, adaptation

STEP_RAD = 0.001
ASK_S = 0.01


class FewHooksMotor(MydriveMotor):
    """A logical motor that keeps most defaults."""

    _asked_fault = None
    _open_low_level = Motor._open_low_level
    _close_low_level = Motor._close_low_level
    _quantise = Motor._quantise

    def _latest(self):
        latest = super()._latest()
        if latest is None:
            return None
        return latest._replace(position=round(latest.position / STEP_RAD) * STEP_RAD)

    def _refresh(self):
        self._asked_fault = self.hardware.fault()
        return ASK_S

    def _latest_fault(self):
        return self._asked_fault

    def _check_fault(self):
        self._refresh()
        super()._check_fault()


few_hooks = adaptation(api=1)(CanBuilder(MotorTable, MydriveHwMotor, FewHooksMotor))
