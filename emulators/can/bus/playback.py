"""Playback of an episode in time.

An episode lasts from a disturbed start of frame until all nodes agree again. It is computed some
bits ahead. When these are played, the computed length is doubled. The total cost is therefore
proportional to the length of the episode, and an endless one costs no more than the time that it
has lasted.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, final

from motorhil.emulators.can.bitlevel.episode import (
    ALL_BITS,
    Disturbance,
    Episode,
    Event,
    Outcome,
    Station,
    run_episode,
)
from motorhil.emulators.can.fault_rules import FaultRule, NoiseSource

_MARGIN_BITS: Final = 512


@final
class Playback:
    """A stretch of time on one wire, from a start of frame until all nodes agree again.

    After a change it is computed again while it is played; the past stays as it was.

    Attributes (read only):
        start_ns: its start of frame [ns].
        stations: as they were then.
        over_ns: when the next frame may start [ns], or the end of the computed part if it is not
            over.
        end: the episode, as far as it is computed.
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
        self.stations: list[Station] = list(stations)
        self._bit_ns, self._data_bit_ns = rates_ns
        self._disturbances = list(disturbances)
        self._noises = noises
        self._quiet_from = [ALL_BITS] * len(noises)  # bit from which on each is inactive
        self._played = 0
        self._until_bit = _MARGIN_BITS
        self.end: Episode
        self.over_ns: int
        self._compute()

    def go_on(self) -> bool:
        """Compute the next part after all is played; return False if the episode is over."""
        if self.end.is_over:
            return False
        self._until_bit = max(2 * self._until_bit, self.end.bits + _MARGIN_BITS)
        self._compute()
        return True

    def strike(self, disturbance: Disturbance) -> None:
        """Add a disturbance that begins now or later."""
        self._disturbances.append(disturbance)
        self._compute()

    def end_lasting(self, now_ns: int) -> None:
        """End all disturbances without an end at `now_ns`."""
        end = self.bit_at(now_ns)
        self._disturbances = [
            replace(one, bits=max(end - one.first, 0)) if one.bits is None else one
            for one in self._disturbances
        ]
        self._compute()

    def spare(self, noises: Sequence[NoiseSource], now_ns: int) -> None:
        """Stop the inversion of bits by all noise sources except these."""
        gone = [number for number, source in enumerate(self._noises) if source not in noises]
        if gone:
            bit = self.bit_at(now_ns)
            for number in gone:
                self._quiet_from[number] = min(bit, self._quiet_from[number])
            self._compute()

    def leave(self, port: int, now_ns: int) -> None:
        """Remove a node from now on."""
        bit = self.bit_at(now_ns)
        self.stations = [
            replace(station, leaves_at=bit)
            if station.port == port and station.leaves_at is None
            else station
            for station in self.stations
        ]
        self._compute()

    def next_ns(self) -> int:
        """Return the time of the next event, or of the end [ns]."""
        events = self.end.events
        if self._played < len(events):
            return self._at(events[self._played].bit)
        return self.over_ns

    def take(self, now_ns: int) -> Event | None:
        """Return the next event that is due, or None."""
        events = self.end.events
        if self._played == len(events) or self._at(events[self._played].bit) > now_ns:
            return None
        self._played += 1
        return events[self._played - 1]

    def off_ns(self, outcome: Outcome) -> int:
        """Return when this node became bus-off [ns]; its start of frame if it did not."""
        return self.start_ns if outcome.off_at is None else self._at(outcome.off_at)

    def outcome(self, port: int) -> Outcome | None:
        """Return the final state of the node, or None if it was not a station."""
        for outcome in self.end.outcomes:
            if outcome.port == port:
                return outcome
        return None

    def bit_at(self, now_ns: int) -> int:
        """Return the first bit that begins at `now_ns` or later."""
        bit = (now_ns - self.start_ns + self._bit_ns - 1) // self._bit_ns
        while self._at(bit - 1) < now_ns:
            bit += 1
        return bit

    def inverted(self) -> list[tuple[int, int, FaultRule]]:
        """Return (time [ns], bit, rule) of each bit that noise has inverted, in order."""
        hits = [
            (bit, number, source.rule)
            for number, source in enumerate(self._noises)
            for bit in source.within(min(self.end.bits, self._quiet_from[number]))
        ]
        hits.sort(key=lambda hit: hit[:2])
        return [(self._at(bit), bit, rule) for bit, _, rule in hits]

    def pass_noise_by(self) -> None:
        """Advance all noise sources by the bits of the episode."""
        for source in self._noises:
            source.pass_by(self.end.bits)

    def _compute(self) -> None:
        """Compute the episode so far, with enough noise for its length."""
        self.end = self._run()
        while self._noises and self.end.bits > self._until_bit:
            self._until_bit = self.end.bits + _MARGIN_BITS
            self.end = self._run()
        self.over_ns = self._at(self.end.bits - 1)

    def _run(self) -> Episode:
        ratio = max(1, round(self._bit_ns / self._data_bit_ns))
        until_bit = self._until_bit
        return run_episode(self.stations, self._with_noise(until_bit), 0, ratio, until_bit)

    def _with_noise(self, bits: int) -> list[Disturbance]:
        disturbances = list(self._disturbances)
        for source, quiet_from in zip(self._noises, self._quiet_from, strict=True):
            struck = source.within(min(bits, quiet_from))
            disturbances += [Disturbance(bit, ports=source.ports) for bit in struck]
        return disturbances

    def _at(self, bit: int) -> int:
        return self.start_ns + self.end.end_ns(bit, self._bit_ns, self._data_bit_ns)
