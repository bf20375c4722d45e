"""Read access to a motor at any time: state, fault and measurements.

Read access needs no ownership and never disturbs the owner of the motor. During low-level access
nothing is requested from the drive: readings return the last value received, or raise an error that
names the holder. U is the unit of position of the motor: rad, or m if linear.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, final

from motorapi.errors import MotorError, PluginError
from motorapi.hooks import MotorHooks
from motorapi.ownership import Ownership
from motorapi.state import Fault, Measurement, MotorState

P = ParamSpec("P")
R = TypeVar("R")


class ReadableMotor(MotorHooks):
    """The read-only part of `motorapi.motor.Motor`."""

    @property
    @final
    def ownership(self) -> Ownership:
        """The ownership of the physical motor; its `listeners` receive its events."""
        return self._physical.ownership

    @final
    def state(self) -> MotorState:
        """Return the state; OFFLINE if the motor does not respond."""
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                return self._call(self._read_state)
        latest = self.latest()
        if latest is None:
            raise access.busy(self.name)
        return latest.state

    @final
    def fault(self) -> Fault | None:
        """Return the fault reported by the drive, or None."""
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                return self._call(self._read_fault)
        latest = self.latest()
        if latest is None or latest.state is MotorState.FAULT:
            raise access.busy(self.name)  # only a request could tell the fault
        return None

    @final
    def is_referenced(self) -> bool:
        """Return True if position 0 is that of the model."""
        with self._physical.passage(self.name):
            self._call(self._connect)
            return self._call(self._read_referenced)

    @final
    def position(self) -> float:
        """Return the measured position [U]."""
        return self._measured(self._read_position, lambda latest: latest.position)

    @final
    def velocity(self) -> float:
        """Return the measured velocity [U/s]."""
        return self._measured(self._read_velocity, lambda latest: latest.velocity)

    @final
    def torque(self) -> float:
        """Return the measured torque [N·m], or force [N]."""
        return self._measured(self._read_torque, lambda latest: latest.torque)

    @final
    def following_error(self) -> float:
        """Return demand minus actual position [U]."""
        return self._measured(self._read_following_error, lambda latest: latest.following_error)

    @final
    def latest(self) -> Measurement | None:
        """Return the last measurement received; nothing is sent, so callbacks may call this."""
        return self._call(self._latest)

    def __repr__(self) -> str:
        text = f"<{type(self).__name__} {self.name!r} on {self._physical.label}"
        try:
            latest = self._latest()
        except Exception as error:  # at a prompt, a repr that raises hides the problem
            return f"{text}: {error!r}>"
        if latest is None:
            return f"{text}>"
        where = "" if latest.position is None else f", {latest.position:g} {self.model.unit}"
        return f"{text}: {latest.state.value}{where}>"

    # ---- internal: shared with Motor, motorapi.execution and motorapi.group ----

    @final
    def _measured(
        self, read: Callable[[], float], heard: Callable[[Measurement], float | None]
    ) -> float:
        """Return a measured value; during low-level access, the last one received.

        Raises:
            MotorBusyError: low-level access is active, and no value was received.
        """
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                self._call(self._connect)
                return self._call(read)
        latest = self.latest()
        value = None if latest is None else heard(latest)
        if value is None:
            raise access.busy(self.name)
        return value

    @final
    def _call(self, hook: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the hook and return its result; convert foreign exceptions to PluginError."""
        try:
            return hook(*args, **kwargs)
        except MotorError:
            raise
        except Exception as error:
            where = getattr(hook, "__name__", None) or repr(hook)
            raise PluginError(
                plugin=type(self).__qualname__, where=str(where), problem=repr(error)
            ) from error
