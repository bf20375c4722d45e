"""Stage of shared motors: a rig in virtual time, its history, and its parties."""

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
    """The motions of the owners; owner number n goes (n + 1) times as far, and takes longer.

    Attributes:
        distance: of the first owner's motions [rad or m].
        duration_s: of the first owner's motions [s]; owner n takes (1 + n / 2) times as long.
        window: maximum distance from the target at the end [rad or m].
        tolerance_s: maximum deviation of a motion's reported duration [s].
    """

    distance: float = 0.05
    duration_s: float = 0.3
    window: float = 0.004
    tolerance_s: float = 0.06

    def of(self, number: int) -> tuple[float, float]:
        """Return (distance, duration_s) of owner `number`."""
        return self.distance * (number + 1), self.duration_s * (1.0 + number / 2.0)


def several_owners(rig: str | Path | RigDescription, owners: Sequence[str]) -> RigDescription:
    """Return the rig with each motor once per owner, as "owner.motor"; groups are left out."""
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
    """Return a function that opens the rig with these owners of every motor."""
    description = several_owners(rig, owners)
    return lambda: Rig(description)


@final
class Stage:
    """The common state of all owners of one run: time, history, counts, violations."""

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
        """Return the time [ns], later than the last returned one."""
        self._last_ns = max(self._last_ns + 1, self.runtime.now_ns())
        return self._last_ns

    def physical_motors(self) -> list[list[Motor]]:
        """Return the logical motors of each physical one, both in the order of the rig."""
        found: dict[int, list[Motor]] = {}
        for name in self.rig.motors:
            motor = self.rig.motors[name]
            found.setdefault(id(motor._physical), []).append(motor)
        return list(found.values())

    def require(self, holds: bool, words: str) -> None:
        """Note a violation if the condition does not hold."""
        if not holds:
            self.violations.append(f"at {self.runtime.now_ns() / 1e9:.6f} s: {words}")

    def check(self) -> None:
        """Raise SharingViolated if there are violations."""
        if self.violations:
            raise SharingViolated("\n".join(self.violations))


class Party:
    """A party that does errands in the rig's virtual time, until it is killed."""

    def __init__(self, name: str, stage: Stage) -> None:
        self.name: Final = name
        self.stage: Final = stage
        self.errand: Callable[[], None] | None = None
        self._party: Final[VirtualParty] = stage.runtime.spawn(name, self._work)
        self._party.joined = True  # errors are reported by the stage
        stage.runtime.run_for(0.0)  # it has begun, and can be killed from now on

    @property
    def is_idle(self) -> bool:
        """True if it lives and has nothing to do."""
        return self.errand is None and not self._party.finished

    def kill(self) -> None:
        """Kill the party, and wait until it has left its blocks."""
        self.stage.runtime.end(self._party)
        self.stage.require(self._party.join(_LONG_S), f"{self.name} did not end after the kill")

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
        """Close everything that the party has open."""
