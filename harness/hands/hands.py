"""Hands on one rig: acts, each at an instant of its own, and their place in the record.

An act takes effect between the event that ran last and the next one, so nothing else happens at its
instant. In the rig file its alarm is set when the rig opens. Here it is set just before it expires.
The order of all other events is the same. Reads no clock: the brake tells how far time has come.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.emulators.simulation.event_queue import Action
from motorhil.harness.hands.elements import elements_of
from motorhil.harness.hands.requests import (
    Inject,
    Mend,
    Request,
    Stimulate,
    request_in,
)
from motorhil.harness.rig.config.faults import FaultDescription, read_faults
from motorhil.harness.rig.config.stimuli import StimulusDescription, read_stimuli
from motorhil.harness.rig.config.toml import RigError, Source, Table, written
from motorhil.harness.rig.fragment import end_of, number_of, table_of
from motorhil.settings import SettingError, dotted

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig

_PAGE: Final = Path("page")


@final
class RefusedError(Exception):
    """A request cannot be fulfilled; the text is for the page's reader."""


@final
class Hands:
    """The hands on one rig.

    Attributes:
        count: number of acts so far.
        is_busy: True while an act is scheduled that has not taken effect.
        revision: increases with every change of `state`.
    """

    def __init__(self, rig: "Rig") -> None:
        self.count: int = 0
        self.is_busy: bool = False
        self.revision: int = 0
        self._rig = rig
        self._can_act = not rig.description.attached  # a recorded rig takes no fragment
        known = [number_of(fault.rule.name) for fault in rig.description.faults]
        self._last = max(known, default=0)
        self._faults: dict[str, FaultDescription] = {}
        self._begun: dict[str, dict[str, Any]] = {}
        self._values: dict[str, dict[str, float]] = {}
        self._told = ""

    def elements(self) -> dict[str, Any]:
        """Return everything that a hand can act on."""
        if not self._can_act:
            return {"controllers": [], "buses": []}
        return elements_of(self._rig.description, self._rig.acts)

    def state(self) -> dict[str, Any]:
        """Return the effect of all acts so far: inputs, faults, and the latest act in words."""
        return {
            "values": self._values,
            "faults": list(self._begun.values()),
            "acts": self.count,
            "told": self._told,
        }

    def now_ns(self) -> int:
        """Return the time of the latest event [ns]."""
        return self._rig.runtime.queue.now_ns

    def flush(self) -> None:
        """Write the record up to now, since time stands still."""
        if self._rig.recording is not None:
            self._rig.recording.flush()

    def act(self, request: Request, time_ns: int) -> None:
        """Schedule an act for this time, which is before the next event.

        Raises:
            RefusedError: the rig does not permit it; nothing was scheduled.
        """
        if not self._can_act:
            raise RefusedError("rig: is a recording, on which no hand acts; run its rig file")
        try:
            if isinstance(request, Stimulate):
                self._stimulate(request, time_ns)
            elif isinstance(request, Inject):
                self._inject(request, time_ns)
            elif isinstance(request, Mend):
                self._mend(request, time_ns)
        except SettingError as error:
            raise RefusedError(str(error)) from None
        except RigError as error:
            key = error.key.partition(".")[2] or error.key
            raise RefusedError(f"{key}: {error.message}; {error.remedy}".rstrip("; ")) from None
        self.is_busy = True

    # ---------------------------------------------------------------------------------- inside

    def _stimulate(self, request: Stimulate, time_ns: int) -> None:
        keys = {
            "controller": request.controller,
            "name": request.name,
            "value": request.value,
            "at_s": time_ns / 1e9,
        }
        text = written("stimulus", keys.items())
        (one,) = read_stimuli(_root(text), list(self._rig.description.controllers))
        try:
            self._rig.acts.check(one)
        except ValueError as error:
            raise RefusedError(f"{one.controller}: {error}") from None
        acts = self._rig.acts
        self._at(time_ns, acts.stimulation(one), lambda: self._stimulated(one, text))

    def _stimulated(self, one: StimulusDescription, text: str) -> None:
        self._values.setdefault(one.controller, {})[one.name] = one.value
        self._note(table_of(text), one.at_ns, f"{one.controller}: {one.name} = {one.value:g}")

    def _inject(self, request: Inject, time_ns: int) -> None:
        description = self._rig.description
        name = f"hand {self._last + 1}"
        keys = {"bus": request.bus, "kind": request.kind, "name": name, **request.further()}
        keys |= {"from_s": time_ns / 1e9, "by_hand": True}
        text = written("fault", keys.items())
        controllers = {
            bus: [one.name for one in description.controllers.values() if one.bus == bus]
            for bus in description.buses
        }
        (fault,) = read_faults(_root(text), controllers, description.buses)
        begin, _ = self._rig.acts.injection(fault)
        self._at(time_ns, begin, lambda: self._injected(fault, request, text, time_ns))

    def _injected(self, fault: FaultDescription, on: Inject, text: str, time_ns: int) -> None:
        self._note(table_of(text), time_ns, f"{on.bus}: {on.kind} {on.keys or ''}".rstrip())
        name = fault.rule.name
        self._faults[name] = fault
        self._begun[name] = {"name": name, "bus": on.bus, "kind": on.kind, "keys": on.keys or ""}

    def _mend(self, request: Mend, time_ns: int) -> None:
        fault = self._faults.get(request.name)
        if fault is None:
            known = ", ".join(self._faults) or "none"
            raise RefusedError(f"{request.name}: is not a fault by hand (known: {known})")
        _, end = self._rig.acts.injection(fault)
        self._at(time_ns, end, lambda: self._mended(fault, time_ns))

    def _mended(self, fault: FaultDescription, time_ns: int) -> None:
        name = fault.rule.name
        self._note(end_of(name, time_ns / 1e9), time_ns, f"{fault.bus}: {name} is over")
        del self._faults[name], self._begun[name]

    def _at(self, time_ns: int, action: Action, done: Callable[[], None]) -> None:
        """Act at this time, and then call `done`."""

        def happen(now_ns: int) -> None:
            self.is_busy = False
            try:
                action(now_ns)
            except ValueError as error:  # a controller refuses what its twin took
                self._told = f"refused, at {now_ns / 1e9:.6f} s: {error}"
                self.revision += 1
                return
            done()

        self._rig.acts.at(time_ns, happen)

    def _note(self, values: Mapping[str, str], time_ns: int, told: str) -> None:
        """Count an act, and record it as metadata; its effects are messages already."""
        self.count += 1
        self._last += 1
        self.revision += 1
        self._told = f"{told}, at {time_ns / 1e9:.6f} s"
        if self._rig.recording is not None:
            self._rig.recording.note(f"hand {self._last}", values)


def checked(table: Mapping[str, object]) -> Request:
    """Return the request that a page has sent.

    Raises:
        RefusedError: it is not a request.
    """
    try:
        return request_in(table)
    except SettingError as error:
        raise RefusedError(f"{dotted(error.path)}: {error.message}; {error.remedy}") from None


def _root(text: str) -> Table:
    return Source(_PAGE, text).root()
