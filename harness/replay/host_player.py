"""Player of a recorded host: which frames it sends, and when.

The player is sans-I/O, and sends a step once everything that the recorded host had waited for has
arrived again. Then the recorded pause is kept after the last of these observations, or after the
host's last frame. An observation that does not arrive within the patience after its time is missed.
The player notes it and continues, as a human operator would.

The host's own heartbeat waits for nothing, and continues while there are steps to send.
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
    """An observation that did not arrive: when it was given up, and the last one heard instead."""

    time_ns: int
    awaited: Told
    step: HostStep
    instead: str


@final
class _Heartbeat:
    """Frames of one identifier that are sent by time alone."""

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
        """Return the next frame and schedule its successor, at the end with the last period."""
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
    """Player of one host on all its buses.

    Args:
        steps: the steps of the recording.
        listener: the listener to the live buses.
        begin_ns: the start time of the recording [ns].
        lines: those of the buses that are Modbus lines.
        speed: factor by which pauses are shorter than recorded.
        patience_ns: extra time for each awaited observation, beyond its recorded time [ns].

    Attributes:
        sent: number of frames sent, without heartbeats.
        unsent: number of recorded host frames that cannot be sent (CAN FD, malformed).
        missed: the observations that did not arrive.
        pairs: (recorded time, live time) of frames that were on their bus [ns].
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
        self._anchor = (begin_ns, 0)  # the last known pair of recorded and live time
        self._lines = frozenset(lines)
        self._waiting_since_ns = 0
        self._given_up: set[Subject] = set()  # subjects whose answers may still arrive late
        self._in_flight: list[HostStep] = []
        self._waits: list[Told] = []
        self._begin()

    def start(self, now_ns: int) -> None:
        """Start the playback at `now_ns`."""
        begin_ns = self._anchor[0]
        self._anchor = (begin_ns, now_ns)
        self._waiting_since_ns = now_ns
        for one in self._heartbeats:
            one.start(begin_ns, now_ns)

    def is_over(self) -> bool:
        """Return True once all steps are sent."""
        return self.sent == len(self._steps)

    def heard(self, bus: str, frame: bytes, now_ns: int, transmitted: bool) -> None:
        """Handle a complete frame on a live bus; `transmitted` marks one of the host's own."""
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
        """Handle a complete answer of a unit on a live line."""
        subject = (line, unit, ANSWER)
        self._told.setdefault(subject, []).append(Told(now_ns, subject, True, "its answer"))

    def next_deadline_ns(self) -> int | None:
        """Return when `take` is due if nothing is heard before [ns]."""
        if self.is_over():
            return None
        due_ns = self._due_ns() if self._is_ready() else self._patient_until_ns()
        return min([due_ns, *(one.due_ns for one in self._heartbeats)])

    def take(self, now_ns: int) -> list[tuple[str, bytes]]:
        """Return (bus, frame) of each frame to send by now."""
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
            if step.bus in self._lines:  # a line does not report the end of transmission
                self._is_out(step, now_ns + step.end_ns - step.start_ns)
            else:
                self._in_flight.append(step)
            self.sent += 1
            self._waiting_since_ns = now_ns
            self._begin()
        return out

    # ------------------------------------------------------------------------------ inside

    def _begin(self) -> None:
        """Set up the observations that the next step waits for."""
        if not self.is_over():
            self._waits = list(self._steps[self.sent].waits)

    def _is_out(self, step: HostStep, now_ns: int) -> None:
        """Note that a frame of the host has been on its bus."""
        self.pairs.append((step.end_ns, now_ns))
        self._know(step.end_ns, now_ns)

    def _is_ready(self) -> bool:
        """Return True if everything that this step waits for has arrived."""
        while self._waits and self._has_come(self._waits[0]):
            del self._waits[0]
        return not self._waits

    def _has_come(self, awaited: Told) -> bool:
        """Return True if the observation came after those awaited before, and pass over it."""
        heard = self._told.get(awaited.subject, [])
        for place in range(self._seen.get(awaited.subject, 0), len(heard)):
            if heard[place].value == awaited.value:
                self._seen[awaited.subject] = place + 1
                self._know(awaited.time_ns, heard[place].time_ns)
                return True
        return False

    def _patient_until_ns(self) -> int:
        """Return when this step stops waiting [ns]; its recorded wait may be minutes (homing)."""
        recorded_ns, live_ns = self._anchor
        pause_ns = round((self._waits[0].time_ns - recorded_ns) / self._speed)
        return max(self._waiting_since_ns, live_ns + pause_ns) + self._patience_ns

    def _give_up(self, now_ns: int) -> None:
        """Give up the observation that this step waits for."""
        awaited = self._waits.pop(0)
        heard = self._told.get(awaited.subject, [])
        if awaited.subject[2] == ANSWER:
            instead = "no answer"
            self._given_up.add(awaited.subject)
        elif heard:
            instead = f"last told: {heard[-1].text}"
        else:
            instead = "no report received"
        self.missed.append(Missed(now_ns, awaited, self._steps[self.sent], instead))
        self._waiting_since_ns = now_ns
        self._know(awaited.time_ns, now_ns)

    def _forget_late(self, step: HostStep) -> None:
        """Discard an answer that arrived after it was given up, before the next request."""
        can_id = int.from_bytes(step.frame[:4], "little")
        if step.bus in self._lines or can_id >> 7 != _SDO_REQUEST:
            return  # lines may have several requests to one unit in progress
        subject = (step.bus, can_id & 0x7F, ANSWER)
        if subject in self._given_up and len(self._told.get(subject, [])) > self._seen.get(
            subject, 0
        ):
            self._seen[subject] = len(self._told[subject])
            self._given_up.discard(subject)

    def _know(self, recorded_ns: int, live_ns: int) -> None:
        """Set the pair of recorded and live time from which pauses are counted."""
        if recorded_ns >= self._anchor[0]:
            self._anchor = (recorded_ns, live_ns)

    def _due_ns(self) -> int:
        """Return when this step is due, in live time [ns]."""
        recorded_ns, live_ns = self._anchor
        return live_ns + round((self._steps[self.sent].start_ns - recorded_ns) / self._speed)
