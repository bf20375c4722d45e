"""An episode, played in time: what happens in each bit comes at the end of that bit."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, final

from emulators.media.can_episode import (
    Disturbance,
    Episode,
    Event,
    Outcome,
    Station,
    run_episode,
)
from emulators.media.fault_rule import FaultRule
from emulators.media.noise import NoiseSource

NEVER_NS: Final = -1
_MARGIN_BITS: Final = 512


@final
class Playback:
    """A stretch of time on one wire, from a start of frame until all agree again.

    It may be computed anew while it is played, because something has changed: what is past stays.

    Attributes (read only):
        start_ns: its start of frame [ns].
        stations: as they were then.
        over_ns: when the next frame may start [ns].
        end: the episode itself.
    """

    def __init__(
        self,
        start_ns: int,
        rates_ns: tuple[int, int],
        stations: Sequence[Station],
        disturbances: Sequence[Disturbance],
        noises: Sequence[NoiseSource],
    ) -> None:
        self.start_ns = start_ns
        self.stations = list(stations)
        self._bit_ns, self._data_bit_ns = rates_ns
        self._disturbances = list(disturbances)
        self._noises = noises
        self._played = 0
        self._compute()

    def strike(self, disturbance: Disturbance) -> None:
        """This happens as well, from a bit on that is not past."""
        self._disturbances.append(disturbance)
        self._compute()

    def end_lasting(self, now_ns: int) -> None:
        """What was to strike it for ever ends now."""
        end = self.bit_at(now_ns)
        self._disturbances = [
            replace(one, bits=max(end - one.first, 0)) if one.bits is None else one
            for one in self._disturbances
        ]
        self._compute()

    def leave(self, port: int, now_ns: int) -> None:
        """The node is not there any more."""
        bit = self.bit_at(now_ns)
        self.stations = [
            replace(station, leaves_at=bit)
            if station.port == port and station.leaves_at is None
            else station
            for station in self.stations
        ]
        self._compute()

    def next_ns(self) -> int:
        """When something happens, or it is over."""
        events = self.end.events
        if self._played < len(events):
            return self._at(events[self._played].bit)
        return self.over_ns

    def take(self, now_ns: int) -> Event | None:
        """The next event that is due."""
        events = self.end.events
        if self._played == len(events) or self._at(events[self._played].bit) > now_ns:
            return None
        self._played += 1
        return events[self._played - 1]

    def off_ns(self, outcome: Outcome) -> int:
        """When this node has become bus-off; its start of frame if it has not."""
        return self.start_ns if outcome.off_at is None else self._at(outcome.off_at)

    def outcome(self, port: int) -> Outcome | None:
        """The node as it was left; None: it was no station."""
        for outcome in self.end.outcomes:
            if outcome.port == port:
                return outcome
        return None

    def bit_at(self, now_ns: int) -> int:
        """The first bit that begins now or later."""
        bit = (now_ns - self.start_ns + self._bit_ns - 1) // self._bit_ns
        while self._at(bit - 1) < now_ns:
            bit += 1
        return bit

    def inverted(self) -> list[tuple[int, int, FaultRule]]:
        """(time [ns], bit, rule) of each bit that noise has inverted, in order."""
        hits = [
            (bit, number, source.rule)
            for number, source in enumerate(self._noises)
            for bit in source.within(self.end.bits)
        ]
        hits.sort(key=lambda hit: hit[:2])
        return [(self._at(bit), bit, rule) for bit, _, rule in hits]

    def pass_noise_by(self) -> None:
        """Its bits are gone by, for all that inverts bits."""
        for source in self._noises:
            source.pass_by(self.end.bits)

    def _compute(self) -> None:
        """The episode, with as much noise as it is long."""
        bits = _MARGIN_BITS
        self.end = self._run(bits)
        while self._noises and self.end.bits > bits:
            bits = self.end.bits + _MARGIN_BITS
            self.end = self._run(bits)
        self.over_ns = self._at(self.end.bits - 1)

    def _run(self, bits: int) -> Episode:
        ratio = max(1, round(self._bit_ns / self._data_bit_ns))
        return run_episode(self.stations, self._with_noise(bits), 0, ratio)

    def _with_noise(self, bits: int) -> list[Disturbance]:
        disturbances = list(self._disturbances)
        for source in self._noises:
            disturbances += [Disturbance(bit, ports=source.ports) for bit in source.within(bits)]
        return disturbances

    def _at(self, bit: int) -> int:
        return self.start_ns + self.end.end_ns(bit, self._bit_ns, self._data_bit_ns)
