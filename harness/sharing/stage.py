"""Where owners share motors: a rig in virtual time, its history, and who acts there."""

# ruff: noqa: SLF001 -- the harness looks at who has a motor

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from harness.rig import Rig, installed_plugins
from harness.rig_file import RigDescription, read_rig
from harness.sharing.history import History, SharingViolated
from motorapi import Motor

if TYPE_CHECKING:
    from harness.parties import VirtualParty
    from harness.sharing.owners import Owner
    from harness.virtual_time import VirtualRuntime

_LONG_S: Final = 60.0


@final
@dataclass(frozen=True, slots=True)
class Course:
    """What owners do with a motor: owner number n goes (n + 1) times as far, and takes longer.

    distance: of the first owner's motions [rad or m].
    duration_s: likewise; of owner n it is (1 + n / 2) times that.
    window: how far from its target a motor may end [rad or m].
    tolerance_s: how much longer or shorter than asked for a motion may be told to be.
    """

    distance: float = 0.05
    duration_s: float = 0.3
    window: float = 0.004
    tolerance_s: float = 0.06

    def of(self, number: int) -> tuple[float, float]:
        """(distance, duration_s) of owner `number`."""
        return self.distance * (number + 1), self.duration_s * (1.0 + number / 2.0)


def several_owners(rig: str | Path | RigDescription, owners: Sequence[str]) -> RigDescription:
    """The rig with every motor once for each owner, as "owner.motor"; groups are left out."""
    if not isinstance(rig, RigDescription):
        rig = read_rig(Path(rig), installed_plugins())
    motors = {}
    for owner in owners:
        for motor in rig.motors.values():
            settings = dict(motor.settings)
            if motor.adaptation == "ideal":
                settings.setdefault("axis", motor.name)
            name = f"{owner}.{motor.name}"
            motors[name] = replace(motor, name=name, settings=settings)
    return replace(rig, motors=motors, groups={})


def shared_rig(
    rig: str | Path | RigDescription, owners: Sequence[str] = ("ann", "ben", "cem")
) -> Callable[[], Rig]:
    """What opens the rig with so many owners of every motor, as often as it is called."""
    description = several_owners(rig, owners)
    return lambda: Rig(description)


@final
class Stage:
    """What all owners of one run share: its time, the history, what was seen, what went wrong."""

    def __init__(self, rig: Rig, course: Course) -> None:
        self.rig: Final = rig
        self.runtime: Final[VirtualRuntime] = rig.runtime
        self.course: Final = course
        self.history: Final = History(self._tick)
        self.counts: Final[Counter[str]] = Counter()
        self.violations: Final[list[str]] = []
        self.owners: Final[list[Owner]] = []
        self._last_ns = -1

    def _tick(self) -> int:
        """The time, a little later than the last time that was told."""
        self._last_ns = max(self._last_ns + 1, self.runtime.now_ns())
        return self._last_ns

    def physical_motors(self) -> list[list[Motor]]:
        """The logical motors of each physical one, both in the order of the rig."""
        found: dict[int, list[Motor]] = {}
        for name in self.rig.motors:
            motor = self.rig.motors[name]
            found.setdefault(id(motor._physical), []).append(motor)
        return list(found.values())

    def require(self, holds: bool, words: str) -> None:
        """Notes it as a violation if it does not hold."""
        if not holds:
            self.violations.append(f"at {self.runtime.now_ns() / 1e9:.6f} s: {words}")

    def check(self) -> None:
        """Raises SharingViolated if anything went wrong."""
        if self.violations:
            raise SharingViolated("\n".join(self.violations))


class Party:
    """Somebody who does errands in the rig's virtual time, until he is killed."""

    def __init__(self, name: str, stage: Stage) -> None:
        self.name: Final = name
        self.stage: Final = stage
        self.errand: Callable[[], None] | None = None
        self._party: Final[VirtualParty] = stage.runtime.spawn(name, self._work)
        self._party.joined = True  # what goes wrong is told by the stage
        stage.runtime.run_for(0.0)  # he has begun, and can be killed from now on

    @property
    def is_idle(self) -> bool:
        """Whether he has nothing to do, and lives."""
        return self.errand is None and not self._party.finished

    def kill(self) -> None:
        """He does nothing more than leaving his blocks; it is waited for."""
        self.stage.runtime.end(self._party)
        self.stage.require(self._party.join(_LONG_S), f"{self.name} does not die")

    def _work(self) -> None:
        runtime = self.stage.runtime
        try:
            while True:
                runtime.wait_until(lambda: self.errand is not None)
                assert self.errand is not None
                self.errand()
                self.errand = None
        except Exception as error:
            self.stage.violations.append(f"{self.name}: {type(error).__name__}: {error}")
        finally:
            self.leave()

    def leave(self) -> None:
        """What he has open is closed."""
