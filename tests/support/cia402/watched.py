"""A drive under observation: after every action, the standard's rules are checked.

After each frame, each deadline and each tick the statusword is read and compared with `standard`.
Each fault and reset is compared with the EMCYs. The plant's motion is compared with the rules of
the state. Controlwords are counted on arrival (the writer of 6040h) and when sent, so that neither
a lost nor an additional one goes undetected.
"""

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from motorhil.emulators.cia402.drive import Cia402Drive
from tests.support.cia402.bench import MS, NODE, Bench, new_drive
from tests.support.cia402.standard import (
    AT_ONCE,
    FAULTY,
    POWERED,
    By,
    State,
    command_in,
    commands_of,
    path,
    state_of,
)

TARGET_REACHED = 0x0400
HALT = 0x0100
NEW_SET_POINT = 0x0010
HEARTBEAT_LOST = 0x8130
PP, PV, HM, CSP = 1, 3, 6, 8
RAMPS = (0x6083, 0x6084, 0x6085, 0x60C5, 0x60C6)
SETTLED = 3
"""Ticks until a regime's demand is its own: the previous loop has still moved the motor."""
ROUNDED = 2
"""Whole increments of one tick, against those of the previous tick."""

SWING, CREEP = 1.15, 8
"""In pv, demand is the motor's position, and a new loop oscillates: ratio, and increments."""
OVERSHOOT = 0.33
"""Braking on the current limit has no profile: demand is the motor's position.

The speed overshoots zero by less than a third, as in any step response of a PI loop.
"""
HARD = (3, 4, 7, 8)  # 605Ah; 3 and 4 of 605Dh and 605Eh

LOST_CONNECTION = {1: By.FAULT, 2: By.DISABLE_VOLTAGE, 3: By.QUICK_STOP}  # 6007h


class Watched(Bench):
    """A checked bench; `taken`: the count of each transition; `visited`: the states reached."""

    def __init__(self, strict: bool = True, **settings: object) -> None:
        """Create the drive; `strict`: check EMCYs and motion too.

        Those rules need the default COB-IDs and factors, and a host that declares its controlwords.
        """
        self.taken: Counter[int] = Counter([0])
        self.visited = {State.NOT_READY_TO_SWITCH_ON}
        self.emergencies: list[int] = []  # error codes of this step
        self.all_emergencies: Counter[int] = Counter()
        self.answers = 0  # of the SDO server
        self.aborts: Counter[int] = Counter()
        self.nmt_state = "initialising"
        self.inputs: dict[str, float] = {}  # as last set
        self._strict = strict
        self._arrived: list[int] = []
        self._expected: list[int] | None = None  # None: the sender does not know
        self._is_reset = False
        self._is_lost = False
        self._is_off = False  # safe torque off has arrived
        self._read = 0  # of `sent`
        self._events_read = 0
        self.state = State.NOT_READY_TO_SWITCH_ON
        self._word = 0
        drive = new_drive(**settings)
        self._od = drive.od
        self.controlword_now = drive.od.integer(0x6040, 0, 0)
        self._standing = command_in(self.controlword_now)  # the last command; it may take time
        self._listen_to_controlwords(drive)
        statusword, error_code = drive.od.get(0x6041), drive.od.get(0x603F)
        assert statusword is not None
        assert error_code is not None
        self._statusword, self._error_code = statusword, error_code
        plant = drive.settings.plant
        self._increments_rpm_s = plant.encoder_increments_rev / 60.0
        # motion
        self._off_ns = 0  # since when the motor has no power; -1: it has power
        self._speed_rad_s = 0.0
        self._truth: object = None
        self._sampled_ns = -1
        self._demand = 0.0
        self._ramp = float("inf")  # the slowest ramp ever set: a ramp in progress may be older
        self._steps: list[float] = []  # increments of each tick in this regime
        self._regime: tuple[Any, ...] = ()
        self._is_fresh = False  # the regime is younger than one tick
        self._asked = False
        self._is_inside = False
        self._is_standing = False
        self._brakes_hard = False  # permanent once requested: a stop may be in progress
        super().__init__(drive)

    def _listen_to_controlwords(self, drive: Cia402Drive) -> None:
        variable = drive.od.get(0x6040)
        assert variable is not None
        inner = variable.writer
        assert inner is not None
        arrived = self._arrived.append

        def write(word: int) -> int:
            code = inner(word)
            if code == 0:
                arrived(word)
            return code

        variable.writer = write

    # --- actions

    def speak(self, can_id: int, data: bytes, *controlwords: int) -> None:
        """Send a frame; `controlwords`: the words that must arrive by it."""
        self._expected = list(controlwords)
        self.send(can_id, data)
        self._expected = None

    def tell(self, frame: bytes) -> None:
        """Send any can_frame without an expectation of its effect."""
        if frame[:4] == b"\0\0\0\0" and frame[4] >= 2 and frame[9] in (0, self.drive._node.node_id):
            self._is_reset = frame[8] == 0x81
            self._is_lost = frame[8] in (0x02, 0x82)
        self.drive.receive(frame, self.now)
        self._drain()

    def forget(self) -> None:
        """Discard all frames and events so far."""
        self.sent.clear()
        self.events.clear()
        self._read = self._events_read = 0

    def rpdo(self, number: int, word: int, rest: bytes = b"") -> None:
        """Send RPDO 1 to 4, which our file maps with the controlword first."""
        words = (word,) if self.nmt_state == "operational" else ()
        self.speak(0x100 + 0x100 * number + NODE, word.to_bytes(2, "little") + rest, *words)

    def sdo(self, index: int, subindex: int, value: int, size: int) -> None:
        """Send an expedited download, whatever its result."""
        head = bytes((0x23 | (4 - size) << 2, index & 0xFF, index >> 8, subindex))
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        can_talk = self.nmt_state in ("pre-operational", "operational")
        words = (value,) if index == 0x6040 and can_talk else ()
        self.speak(0x600 + NODE, head + data, *words)

    def nmt(self, command: int, node: int = NODE) -> None:
        """Send the command and track the state that the standard defines."""
        talks = self.nmt_state != "initialising"
        self._is_reset = talks and command == 0x81
        self._is_lost = talks and command in (0x02, 0x82)
        if talks:
            states = {0x01: "operational", 0x02: "stopped", 0x80: "pre-operational"}
            self.nmt_state = states.get(command, "initialising")
        self.speak(0x000, bytes((command, node)))

    def stimulate(self, name: str, value: float) -> None:
        """Set a physical input; ignore a value that the drive rejects."""
        self.inputs[name] = value
        if name == "bus_off" and value:
            self._is_lost = True
        if name == "sto" and value:
            self._is_off = True
        with suppress(ValueError):
            self.drive.stimulate(name, value, self.now)
        self._drain()

    def wait(self, duration_ns: int) -> None:
        """Advance time tick by tick; in one step where nothing moves."""
        end = self.now + duration_ns
        while self.now < end:
            truth = self.drive.snapshot(self.now)
            due = self.drive.next_deadline_ns()
            tick = (self.now // MS + 1) * MS
            if truth is self._truth and truth["velocity_rad_s"] == 0.0:  # at rest
                tick = end if due is None else max(tick, due)
            self._truth = truth
            self.run_until(min(tick, end))
            self._observe()

    # --- checks

    def _drain(self) -> None:
        super()._drain()
        self._observe()

    def _observe(self) -> None:
        self._hear()
        self.drive.before_read(self.now)
        word = self._statusword.read()
        assert isinstance(word, int)
        self._judge_state(state_of(word))
        self._judge_power()
        if self._strict:
            self._judge_motion(word)
        self._word = word
        self._arrived.clear()
        self.emergencies.clear()
        self._is_reset = self._is_lost = self._is_off = False

    def _hear(self) -> None:
        for _, can_id, data in self.sent[self._read :]:
            if can_id == 0x080 + NODE:
                code = int.from_bytes(data[:2], "little")
                self.emergencies.append(code)
                self.all_emergencies[code] += 1
                self._is_lost = self._is_lost or code == HEARTBEAT_LOST
            elif can_id == 0x700 + NODE and data == b"\0":
                self.nmt_state = "pre-operational"
            elif can_id == 0x580 + NODE:
                self.answers += 1
                if data[0] == 0x80:
                    self.aborts[int.from_bytes(data[4:], "little")] += 1
        self._read = len(self.sent)
        for _, text in self.events[self._events_read :]:  # where an inhibit time delays EMCYs
            self._is_lost = self._is_lost or "lost" in text or "not guarded" in text
        self._events_read = len(self.events)

    def _judge_state(self, state: State) -> None:
        arrived, before = self._arrived, self.state
        if self._expected is not None:
            assert arrived == self._expected, (
                f"controlwords {arrived} arrived, expected {self._expected}"
            )
            self._expected = []
        commands = commands_of(self.controlword_now, arrived)
        standing = self._standing
        for word in arrived:
            self.controlword_now = word
            self._standing = command_in(word) or self._standing
        if before is state and not (self._is_reset or commands):
            return
        error_code = self._error_code.read()
        taken = path(before, state, self._causes(commands, standing, state), self._option(0x605A))
        is_barred = before is State.SWITCH_ON_DISABLED and self.inputs.get("sto", 0) == 1
        if len(commands) == 1 and (before, commands[0]) in AT_ONCE and not is_barred:
            assert state is not before, f"{commands[0].value} in {before.name}: nothing happened"
        can_tell = self.nmt_state in ("pre-operational", "operational")
        can_tell = can_tell and self._strict and not self.inputs.get("bus_off")
        if 13 in taken:
            assert error_code, "a fault without an error code (603Fh)"
            if can_tell:
                assert error_code in self.emergencies, f"no EMCY reports fault {error_code:04X}h"
        if 15 in taken and can_tell:
            assert 0x0000 in self.emergencies, "no EMCY reports the end of the fault"
        if state not in FAULTY:
            told = [code for code in self.emergencies if code and code >> 8 not in (0x81, 0x82)]
            assert not (told and self._strict) or 13 in taken, f"EMCY {told} without a fault"
            assert error_code == 0, f"error code {error_code:04X}h in {state.name}"
        if self._is_reset:
            self.controlword_now = self._od.integer(0x6040, 0, 0)
            self._standing = command_in(self.controlword_now)
        self.taken.update(taken)
        self.visited.add(state)
        self.state = state

    def _causes(self, commands: Iterable[By], standing: By | None, state: State) -> set[By]:
        causes = {By.ITSELF, *commands}
        if standing is not None:
            causes.add(standing)
        if self._is_reset:
            causes.add(By.RESET)
        if self._is_off:
            causes.add(By.DISABLE_VOLTAGE)
        if self._is_lost:
            causes.add(LOST_CONNECTION.get(self._option(0x6007), By.ITSELF))
        if state in FAULTY:
            causes.add(By.FAULT)
        return causes

    def _option(self, index: int) -> int:
        return self._od.integer(index, 0, 0)

    # --- motion

    def _judge_power(self) -> None:
        """Check that states without power have no current and no acceleration."""
        state, now = self.state, self.now
        if state in POWERED:
            self._off_ns = -1
            return
        truth = self.drive.snapshot(now)
        speed = abs(truth["velocity_rad_s"])
        if self._off_ns < 0:
            self._off_ns = now
        if now - self._off_ns <= MS:
            speed = float("inf")
        else:  # a command takes effect at a tick
            assert abs(truth["current_a"]) < 1e-6, f"{truth['current_a']} A in {state.name}"
            if not self.inputs.get("load_torque_n_m"):
                assert speed <= self._speed_rad_s + 1e-9, (
                    f"accelerates without power in {state.name}"
                )
        self._speed_rad_s = speed

    def _judge_motion(self, word: int) -> None:
        state, now = self.state, self.now
        truth = self.drive.snapshot(now)
        mode = int(truth["mode"])
        self._is_standing = truth["velocity_rad_s"] == 0.0
        self._note_asking(state, mode)
        demand = truth["demand_inc"]
        if now == self._sampled_ns + MS and self._regime and not self._is_fresh:
            self._judge_step(demand - self._demand, demand)
        if now % MS == 0 and now != self._sampled_ns:
            self._sampled_ns = now
            self._demand = demand
            self._is_fresh = False
        is_halted = bool(self.controlword_now & HALT)
        reached = bool(word & TARGET_REACHED)
        bits = self.controlword_now & 0x0370
        codes = (self._option(index) for index in (0x605A, 0x605D, 0x605E))
        self._brakes_hard = self._brakes_hard or any(code in HARD for code in codes)
        self._ramp = min(self._ramp, self._slowest_ramp_inc())
        limits = (self._fastest_inc(), self._ramp)
        regime = (state, mode, is_halted, self._asked, reached, bits, limits)
        if regime != self._regime:
            self._regime = regime
            self._steps.clear()
            self._is_fresh = True
        if reached and mode == PP and not is_halted and not self._arrived:
            self._asked = False

    def _note_asking(self, state: State, mode: int) -> None:
        """Note whether motion was requested since operation was enabled in this mode."""
        if state is not State.OPERATION_ENABLED:
            self._asked = self._is_inside = False
            return
        if not self._regime or self._regime[:2] != (state, mode):
            is_new = not self._regime or self._regime[0] is not state
            low, high = self._limits()
            stands = self._is_standing and low <= self._demand <= high
            self._is_inside = mode in (PP, CSP) and (stands if is_new else self._is_inside)
            self._asked = mode not in (0, PP, HM) or bool(self.controlword_now & NEW_SET_POINT)
        if any(word & NEW_SET_POINT for word in self._arrived):
            self._asked = True

    def _judge_step(self, step: float, demand: float) -> None:
        """Check the increments of one whole tick in one regime."""
        state, mode, is_halted, asked, reached, _, (fastest, ramp) = self._regime
        size = abs(step)
        where = f"{step:+g} inc in a tick, before {self._steps[-5:]}: {self._regime}"
        if state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE):
            brakes, stands = True, reached and state is State.QUICK_STOP_ACTIVE
        elif state is State.OPERATION_ENABLED:
            brakes = not asked or (is_halted and mode in (PP, PV))
            stands = reached and (mode == PP or (is_halted and mode == PV))
        else:
            return
        if stands:
            assert step == 0, f"moves after target reached: {where}"
        if len(self._steps) >= SETTLED:
            entry, least = max(self._steps[:SETTLED]), min(self._steps)
            if brakes and self._brakes_hard:
                overshoot = max(least, OVERSHOOT * entry) + ROUNDED
                assert size <= overshoot, f"accelerates instead of braking: {where}"
            elif brakes:
                assert size <= least + ROUNDED, f"accelerates instead of braking: {where}"
                slower = max(0.0, entry - ramp * (len(self._steps) - SETTLED))
                assert size <= slower + ROUNDED, f"brakes by less than a ramp: {where}"
                way = SETTLED * entry + (entry + 1) ** 2 / (2 * ramp) if ramp else float("inf")
                assert sum(self._steps) <= way + ROUNDED, (
                    f"farther than its braking distance: {where}"
                )
            pushed = mode == PV and self.inputs.get("load_torque_n_m")  # demand is actual
            if mode in (PP, PV) and not pushed:
                allowed = max(entry, fastest) * (SWING if mode == PV else 1.0)
                allowed += ROUNDED if mode == PP else CREEP
                assert size <= allowed, f"too fast: {where}"
        self._steps.append(size)
        if self._is_inside and not (is_halted and self._brakes_hard):  # no ramp then, as above
            low, high = self._limits()
            assert low - 1 <= demand <= high + 1, f"{demand} beyond 607Dh {low}..{high}: {where}"

    def _fastest_inc(self) -> float:
        """Return 607Fh and 6080h combined, for one tick."""
        fastest = float(self._od.integer(0x607F, 0, 0xFFFF_FFFF) or 0xFFFF_FFFF)
        rpm = self._od.integer(0x6080, 0, 0)
        return min(fastest, rpm * self._increments_rpm_s if rpm else fastest) / 1000.0

    def _slowest_ramp_inc(self) -> float:
        """Return the lowest of 6083h to 6085h, 60C5h and 60C6h that are set, per tick."""
        ramps = [self._od.integer(index, 0, 0) for index in RAMPS]
        return min((ramp for ramp in ramps if ramp > 0), default=0) / 1e6

    def _limits(self) -> tuple[float, float]:
        low, high = self._od.integer(0x607D, 1, 0), self._od.integer(0x607D, 2, 0)
        return (low, high) if low < high else (float("-inf"), float("inf"))
