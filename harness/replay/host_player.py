"""Plays a recorded host: what it sends when, told what is heard and what time it is.

Sans-I/O. A step is sent when all it waited for has been told again, and as much time has passed
behind the last of that, or behind the host's last frame, as in the recording. What is not told
within the patience after its time is missed: that is noted, and the host goes on, as a person
watching would.
The host's own heartbeat waits for nothing, and goes on as long as there is something to send.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, final

from traces.host_tape import ANSWER, HostStep, Listener, Subject, Told

PATIENCE_NS: Final = 2_000_000_000
_SDO_REQUEST: Final = 12  # function code of the pre-defined connection set


@final
@dataclass(frozen=True, slots=True)
class Missed:
    """Something the host had waited for, and that was not told: when it gave up, what, instead."""

    time_ns: int
    awaited: Told
    step: HostStep
    instead: str


@final
class _Heartbeat:
    """Frames of one identifier that go out by the clock alone."""

    def __init__(self, steps: list[HostStep], speed: float) -> None:
        self.steps = steps
        self.sent = 0
        self.due_ns = 0
        self._speed = speed
        last = steps[-1].start_ns - steps[-2].start_ns if len(steps) > 1 else None
        self._period_ns = last

    def start(self, begin_ns: int, now_ns: int) -> None:
        self.due_ns = now_ns + round((self.steps[0].start_ns - begin_ns) / self._speed)

    def take(self) -> HostStep:
        """The next one; it is then due again, with the last period when the recording is over."""
        place = min(self.sent, len(self.steps) - 1)
        step = self.steps[place]
        self.sent += 1
        if self.sent < len(self.steps):
            pause_ns = self.steps[self.sent].start_ns - step.start_ns
            self.due_ns += round(pause_ns / self._speed)
        elif self._period_ns:
            self.due_ns += round(self._period_ns / self._speed)
        else:
            self.due_ns = _NEVER_NS
        return step


_NEVER_NS: Final = 1 << 62


@final
class HostPlayer:
    """One host on all buses.

    Args:
        steps: of the recording.
        listener: that hears the live buses.
        begin_ns: when the recording begins [ns of it].
        lines: which of the buses are lines that speak Modbus.
        speed: how much faster pauses are than recorded.
        patience_ns: for each thing that is waited for, beyond the time it took when recorded [ns].

    Attributes:
        sent: how many frames were sent, without heartbeats.
        unsent: how many frames of the recorded host cannot be sent (CAN FD, malformed).
        missed: what was waited for in vain.
        pairs: (time in the recording, live time) of frames that were on their bus [ns].
    """

    def __init__(
        self,
        steps: Sequence[HostStep],
        listener: Listener,
        begin_ns: int = 0,
        lines: Collection[str] = (),
        speed: float = 1.0,
        patience_ns: int = PATIENCE_NS,
    ) -> None:
        self.sent = 0
        self.unsent = 0
        self.missed: list[Missed] = []
        self.pairs: list[tuple[int, int]] = []
        self._steps = [step for step in steps if not step.is_free]
        free: dict[tuple[str, bytes], list[HostStep]] = {}
        for step in steps:
            if step.is_free:
                free.setdefault((step.bus, step.frame[:4]), []).append(step)
        self._heartbeats = [_Heartbeat(one, speed) for one in free.values()]
        self._listener = listener
        self._speed = speed
        self._patience_ns = patience_ns
        self._told: dict[Subject, list[Told]] = {}
        self._seen: dict[Subject, int] = {}
        self._anchor = (begin_ns, 0)  # the last that is known of: when recorded, when live
        self._lines = frozenset(lines)
        self._waiting_since_ns = 0
        self._given_up: set[Subject] = set()  # answers that may yet come, late
        self._in_flight: list[HostStep] = []
        self._waits: list[Told] = []
        self._begin()

    def start(self, now_ns: int) -> None:
        """The recording begins now."""
        begin_ns = self._anchor[0]
        self._anchor = (begin_ns, now_ns)
        self._waiting_since_ns = now_ns
        for one in self._heartbeats:
            one.start(begin_ns, now_ns)

    def is_over(self) -> bool:
        """Whether all has been sent."""
        return self.sent == len(self._steps)

    def heard(self, bus: str, frame: bytes, now_ns: int, transmitted: bool) -> None:
        """A frame was complete on a live bus; `transmitted`: it was one of the host's own."""
        if transmitted:
            for place, step in enumerate(self._in_flight):
                if step.bus == bus and step.frame == frame:
                    del self._in_flight[place]
                    self._is_out(step, now_ns)
                    break
            self._listener.decode(bus, frame)
            return
        for told in self._listener.told(now_ns, bus, self._listener.decode(bus, frame)):
            self._told.setdefault(told.subject, []).append(told)

    def answered(self, line: str, unit: int, now_ns: int) -> None:
        """A unit's answer was complete on a live line."""
        subject = (line, unit, ANSWER)
        self._told.setdefault(subject, []).append(Told(now_ns, subject, True, "its answer"))

    def next_deadline_ns(self) -> int | None:
        """When `take` is wanted at the latest, if nothing is heard before [ns]."""
        if self.is_over():
            return None
        due_ns = self._due_ns() if self._is_ready() else self._patient_until_ns()
        return min([due_ns, *(one.due_ns for one in self._heartbeats)])

    def take(self, now_ns: int) -> list[tuple[str, bytes]]:
        """(bus, frame) of what is to be sent by now."""
        out: list[tuple[str, bytes]] = []
        for one in self._heartbeats:
            while one.due_ns <= now_ns and not self.is_over():
                step = one.take()
                out.append((step.bus, step.frame))
        while not self.is_over():
            if not self._is_ready():
                if now_ns < self._patient_until_ns():
                    break
                self._give_up(now_ns)
                continue
            if self._due_ns() > now_ns:
                break
            step = self._steps[self.sent]
            self._forget_late(step)
            out.append((step.bus, step.frame))
            if step.bus in self._lines:  # nobody tells when it is out: it is a moment later
                self._is_out(step, now_ns + step.end_ns - step.start_ns)
            else:
                self._in_flight.append(step)
            self.sent += 1
            self._waiting_since_ns = now_ns
            self._begin()
        return out

    # ------------------------------------------------------------------------------ inside

    def _begin(self) -> None:
        """What the next step waits for is not told yet."""
        if not self.is_over():
            self._waits = list(self._steps[self.sent].waits)

    def _is_out(self, step: HostStep, now_ns: int) -> None:
        """A frame of the host has been on its bus."""
        self.pairs.append((step.end_ns, now_ns))
        self._know(step.end_ns, now_ns)

    def _is_ready(self) -> bool:
        """Whether all that this step waits for has been told."""
        while self._waits and self._has_come(self._waits[0]):
            del self._waits[0]
        return not self._waits

    def _has_come(self, awaited: Told) -> bool:
        """Whether it has been told, behind what was waited for before; then that is behind us."""
        heard = self._told.get(awaited.subject, [])
        for place in range(self._seen.get(awaited.subject, 0), len(heard)):
            if heard[place].value == awaited.value:
                self._seen[awaited.subject] = place + 1
                self._know(awaited.time_ns, heard[place].time_ns)
                return True
        return False

    def _patient_until_ns(self) -> int:
        """When what this step waits for is given up: a homing may have taken minutes."""
        recorded_ns, live_ns = self._anchor
        pause_ns = round((self._waits[0].time_ns - recorded_ns) / self._speed)
        return max(self._waiting_since_ns, live_ns + pause_ns) + self._patience_ns

    def _give_up(self, now_ns: int) -> None:
        """What this step waits for has not come: without it, then."""
        awaited = self._waits.pop(0)
        heard = self._told.get(awaited.subject, [])
        if awaited.subject[2] == ANSWER:
            instead = "no answer"
            self._given_up.add(awaited.subject)
        elif heard:
            instead = f"last told: {heard[-1].text}"
        else:
            instead = "it has told nothing of it"
        self.missed.append(Missed(now_ns, awaited, self._steps[self.sent], instead))
        self._waiting_since_ns = now_ns
        self._know(awaited.time_ns, now_ns)

    def _forget_late(self, step: HostStep) -> None:
        """An answer that came after it had been given up is none to what is asked now."""
        can_id = int.from_bytes(step.frame[:4], "little")
        if step.bus in self._lines or can_id >> 7 != _SDO_REQUEST:
            return  # on lines several requests may be on their way to one unit
        subject = (step.bus, can_id & 0x7F, ANSWER)
        if subject in self._given_up and len(self._told.get(subject, [])) > self._seen.get(
            subject, 0
        ):
            self._seen[subject] = len(self._told[subject])
            self._given_up.discard(subject)

    def _know(self, recorded_ns: int, live_ns: int) -> None:
        """What was recorded then was so now: pauses are counted from here."""
        if recorded_ns >= self._anchor[0]:
            self._anchor = (recorded_ns, live_ns)

    def _due_ns(self) -> int:
        """When this step begins."""
        recorded_ns, live_ns = self._anchor
        return live_ns + round((self._steps[self.sent].start_ns - recorded_ns) / self._speed)
