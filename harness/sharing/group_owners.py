"""Owners of overlapping groups; the counterpart of `Owner` for single motors."""

# ruff: noqa: SLF001 -- the harness looks at who has a motor, and lets arming fail

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Final, final

from harness.sharing.history import Action, Note
from harness.sharing.stage import Party, Stage
from motorapi import (
    ControlMode,
    LinkError,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    TrapezoidalTrajectory,
)
from motorapi.commands import Motion
from motorapi.synchronization import Trigger

_PATIENT_S: Final = 120.0


@final
class _WatchedTrigger:
    """A trigger that reports its firing; everything else is delegated."""

    def __init__(self, trigger: Trigger, watch: "Watch") -> None:
        self.trigger = trigger
        self._watch = watch

    def __getattr__(self, name: str) -> object:
        return getattr(self.trigger, name)

    def __repr__(self) -> str:
        return repr(self.trigger)

    def fire(self) -> None:
        """Report the firing, then fire the trigger."""
        self._watch.fired()
        self.trigger.fire()


@final
class Watch:
    """Observer of arming and firing of one logical motor; can make arming fail.

    Attributes:
        refuses: True if the motor refuses to be armed next.
        was_armed: True if it was armed since `begin`.
        fired: called before its trigger is fired.
    """

    def __init__(self, motor: Motor) -> None:
        self.motor: Final = motor
        self.refuses = False
        self.was_armed = False
        self.fired: Callable[[], None] = lambda: None
        self._arm = motor._arm
        self._known: list[_WatchedTrigger] = []  # a common trigger stays a single one
        motor._arm = self._watched_arm  # type: ignore[method-assign]

    def begin(
        self, fired: Callable[[], None], known: list[_WatchedTrigger], *, refuses: bool
    ) -> None:
        """Begin a start; its triggers are added to `known`."""
        self.was_armed, self.refuses, self.fired, self._known = False, refuses, fired, known

    def _watched_arm(self, motion: Motion, *, together: bool) -> Trigger:
        if self.refuses:
            raise LinkError(
                link=self.motor._physical.label, reason="it refuses, as planned by the test"
            )
        trigger = self._arm(motion, together=together)
        self.was_armed = True
        for known in self._known:
            if known.trigger is trigger:
                return known
        self._known.append(_WatchedTrigger(trigger, self))
        return self._known[-1]


def watched(motor: Motor) -> Watch:
    """Return an observer of the motor."""
    return Watch(motor)


@final
class GroupOwner(Party):
    """An owner with a logical motor of each physical one, who moves them in groups.

    Args:
        name: its name.
        motors: its logical motor of each physical one, in the order of the rig.
        number: its number among all owners.
    """

    def __init__(self, name: str, motors: Sequence[Watch], number: int, stage: Stage) -> None:
        self.number: Final = number
        self.motors: Final = list(motors)
        super().__init__(name, stage)

    def move(
        self, chosen: Sequence[int], refuses: int | None, reserves: bool, patient: bool
    ) -> None:
        """Move the chosen motors together, or none if one refuses or is not free."""
        stage = self.stage
        places = list(dict.fromkeys(place % len(self.motors) for place in chosen))
        watches = [self.motors[place] for place in places]
        refusing = None if refuses is None else watches[refuses % len(watches)]
        group = MotorGroup(*(watch.motor for watch in watches))
        timeout_s = _PATIENT_S if patient else None
        words = f"{len(watches)} motors"
        with ExitStack() as held:
            try:
                if reserves:
                    reservation = group.reserve("together", timeout_s=timeout_s)
                    held.enter_context(self._noted(reservation, watches))
                self._start(group, watches, refusing, timeout_s, reserves)
            except MotorBusyError as error:
                stage.counts[f"{words}: refused"] += 1
                stage.require(
                    not patient, f"{self.name} waited {_PATIENT_S:g} s: {error}; a deadlock"
                )
            except LinkError:
                stage.counts[f"{words}: one refused to be armed"] += 1
                stage.require(refusing is not None, f"{self.name}: a motor refused unexpectedly")
            except MotorError as error:
                stage.counts[f"{words}: {type(error).__name__}"] += 1
            else:
                stage.counts[f"{words}: moved{' in a reservation' if reserves else ''}"] += 1

    def _start(
        self,
        group: MotorGroup,
        watches: Sequence[Watch],
        refusing: Watch | None,
        timeout_s: float | None,
        reserved: bool,
    ) -> None:
        stage = self.stage
        distance, duration_s = stage.course.of(self.number)
        before = [watch.motor.position() for watch in watches]
        ways = [distance if place <= 0.0 else -distance for place in before]

        def fired() -> None:
            late = [watch.motor.name for watch in watches if not watch.was_armed]
            stage.counts["trigger fired"] += 1
            stage.require(not late, f"{self.name}: fired before {', '.join(late)} was armed")

        known: list[_WatchedTrigger] = []
        for watch in watches:
            watch.begin(fired, known, refuses=watch is refusing)
            watch.motor.set_control_mode(ControlMode.TRAJECTORY)
        group.set_trajectory(*(TrapezoidalTrajectory(way, duration_s=duration_s) for way in ways))
        try:
            group.start(timeout_s)
        except LinkError:
            if reserved:
                self._require_moved(watches, before, [0.0] * len(ways), "although one refused")
            raise
        if not reserved:
            self._take(watches)
        gives = [] if reserved else self._gives(watches)  # owned as long as they move
        group.wait_until_done(_PATIENT_S)
        for give in gives:
            give.returned()
        took_s = (stage.runtime.now_ns() - self._begun_ns(watches)) / 1e9
        stage.require(
            abs(took_s - duration_s) <= stage.course.tolerance_s,
            f"{self.name} asked for {duration_s:g} s, but the motion took {took_s:g} s",
        )
        if reserved:
            self._require_moved(watches, before, ways, "to its target")

    def _begun_ns(self, watches: Sequence[Watch]) -> int:
        runs = [watch.motor._run for watch in watches]
        return min(run.since_ns for run in runs if run is not None)

    def _require_moved(
        self, watches: Sequence[Watch], before: Sequence[float], ways: Sequence[float], why: str
    ) -> None:
        for watch, place, way in zip(watches, before, ways, strict=True):
            went = watch.motor.position() - place
            self.stage.counts["positions compared"] += 1
            self.stage.require(
                abs(went - way) <= self.stage.course.window,
                f"{self.name}: {watch.motor.name} went {went:g} instead of {way:g} {why}",
            )

    @contextmanager
    def _noted(
        self, reservation: AbstractContextManager[object], watches: Sequence[Watch]
    ) -> Iterator[None]:
        gives: list[Note] = []
        try:
            with reservation:
                self._take(watches)
                try:
                    yield
                finally:
                    gives = self._gives(watches)
        finally:
            for give in gives:
                give.returned()

    def _take(self, watches: Sequence[Watch]) -> None:
        for watch in watches:
            label = watch.motor._physical.label
            self.stage.history.call(self.name, label, Action.TAKE).returned()

    def _gives(self, watches: Sequence[Watch]) -> list[Note]:
        """Begin the notes of release; they are completed when ownership has ended."""
        labels = [watch.motor._physical.label for watch in watches]
        return [self.stage.history.call(self.name, label, Action.GIVE) for label in labels]
