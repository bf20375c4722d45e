"""What may be asked of a motor at any time: its state, its fault, and what is measured.

Reading takes nobody's permission and never disturbs whoever has the motor. While somebody has
low-level access nothing is asked: readings tell what was heard last, else who has the motor.
U stands for the motor's unit of position: rad, or m if linear.
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
    """The part of `motorapi.motor.Motor` that only looks."""

    @property
    @final
    def ownership(self) -> Ownership:
        """Who owns the physical motor; its `listeners` are told of what happens to that."""
        return self._physical.ownership

    @final
    def state(self) -> MotorState:
        """The state; OFFLINE if the motor is not heard."""
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
        """What the drive says is wrong; None if nothing is."""
        access = self._physical.access
        if access is None:
            with self._physical.passage(self.name):
                return self._call(self._read_fault)
        latest = self.latest()
        if latest is None or latest.state is MotorState.FAULT:
            raise access.busy(self.name)  # which fault would have to be asked
        return None

    @final
    def is_referenced(self) -> bool:
        """Whether position 0 is where it is meant to be."""
        with self._physical.passage(self.name):
            self._call(self._connect)
            return self._call(self._read_referenced)

    @final
    def position(self) -> float:
        """Measured position [U]."""
        return self._measured(self._read_position, lambda latest: latest.position)

    @final
    def velocity(self) -> float:
        """Measured velocity [U/s]."""
        return self._measured(self._read_velocity, lambda latest: latest.velocity)

    @final
    def torque(self) -> float:
        """Measured torque [N·m], or force [N]."""
        return self._measured(self._read_torque, lambda latest: latest.torque)

    @final
    def following_error(self) -> float:
        """Demand minus actual position [U]."""
        return self._measured(self._read_following_error, lambda latest: latest.following_error)

    @final
    def latest(self) -> Measurement | None:
        """What was heard of the motor last; nothing is sent, so callbacks may ask."""
        return self._call(self._latest)

    def __repr__(self) -> str:
        text = f"<{type(self).__name__} {self.name!r} on {self._physical.label}"
        try:
            latest = self._latest()
        except Exception as error:  # at a prompt a repr that raises hides what is wrong
            return f"{text}: {error!r}>"
        if latest is None:
            return f"{text}>"
        where = "" if latest.position is None else f", {latest.position:g} {self.model.unit}"
        return f"{text}: {latest.state.value}{where}>"

    # ---- inside: shared with Motor, motorapi.execution and motorapi.group ----

    @final
    def _measured(
        self, read: Callable[[], float], heard: Callable[[Measurement], float | None]
    ) -> float:
        """What is read; under somebody's low-level access, what was heard last.

        Raises:
            MotorBusyError: somebody has low-level access, and it was not heard.
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
        """What the hook returns; its errors are of the error tree."""
        try:
            return hook(*args, **kwargs)
        except MotorError:
            raise
        except Exception as error:
            where = getattr(hook, "__name__", None) or repr(hook)
            raise PluginError(
                plugin=type(self).__qualname__, where=str(where), problem=repr(error)
            ) from error
