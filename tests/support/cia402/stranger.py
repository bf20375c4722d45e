"""A random user who may do all that a host or the environment can do: one table of actions.

Hypothesis draws from it (test_fsa_machine), and so does a seeded walk, which is as fast as the
drive itself. The emulator's new modes and physical inputs enter the table automatically.
"""

from collections.abc import Sequence
from random import Random
from typing import Final

from motorhil.emulators.cia402.drive import STIMULI
from motorhil.emulators.cia402.settings import EMULATED_MODES
from tests.support.cia402.bench import MS
from tests.support.cia402.standard import TABLE, State
from tests.support.cia402.watched import Watched

LIGHT: Final = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}
OBJECTS: Final = {
    "1016h:1": 127 << 16 | 50,  # a heartbeat to lose
    "1029h:1": 1,
    "1800h:3": 0,
    "6066h": 3,
}
LIMITS: Final = {"607Dh:1": -1_000, "607Dh:2": 1_000}
# The controlword that triggers each transition from its start state; then those that lead there.
WORDS: Final = {2: 0x06, 3: 0x07, 4: 0x0F, 5: 0x07, 6: 0x06, 7: 0x00, 8: 0x06, 9: 0x00, 10: 0x02,
                11: 0x02, 12: 0x00, 15: 0x80, 16: 0x0F}  # fmt: skip
FORWARD: Final = {
    State.SWITCH_ON_DISABLED: 0x06,
    State.READY_TO_SWITCH_ON: 0x07,
    State.SWITCHED_ON: 0x0F,
    State.QUICK_STOP_ACTIVE: 0x00,
    State.FAULT: 0x80,
}
VALUES: Final = {
    "load_torque_n_m": (0.0, 0.0, 5.0, 40.0),
    "fault": (0x2310, 0x8611, 0xFF01),
    "power": (0, 1, 1, 1),
    "device_temperature_c": (25.0, 80.0, 95.0),
    "supply_v": (),  # the supply of this plant is fixed
}
"""Possible values of physical inputs; inputs not named here are off or on."""
PHYSICS: Final = tuple(
    (name, value)
    for name in STIMULI
    if not name.startswith("digital_input_")  # they have a meaning to the host only
    for value in VALUES.get(name, (0, 1))
)
NORMAL: Final = {"power": 1, "encoder": 1, "device_temperature_c": 25.0}
"""Normal values of inputs, where they are not 0."""

PHYSICS: Final = tuple((name, value) for name in STIMULI for value in VALUES.get(name, (0, 1)))

STARTS: Final = ("moving", "enabled", "moving", "told to start", "switched off")
MODES: Final = tuple(EMULATED_MODES.values())
ANY_WORD: Final = tuple(0x9E37 * number & 0xFFFF for number in range(64))
USUAL: Final = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x5F, 0x010F, 0x80, 0x8F)
DISTANCES: Final = tuple(range(-20_000, 20_001, 1_250))
SPEEDS: Final = tuple(range(-60_000, 60_001, 7_500))
TORQUES: Final = tuple(range(-1_200, 1_201, 100))

# The actions and their values: one value of each kind is chosen.
DEEDS: Final[tuple[tuple[str, tuple[Sequence[object], ...]], ...]] = (
    ("word", (("RPDO", "SDO"), USUAL)),
    ("word", (("RPDO", "SDO"), USUAL + ANY_WORD)),
    ("again", ()),
    ("go for", (tuple(TABLE), (2, 6))),
    ("go for", (tuple(TABLE), (2, 6))),
    ("mode", (("RPDO", "SDO"), (0, 7, *MODES))),
    ("position", (DISTANCES, (0x0F, 0x1F, 0x3F, 0x5F))),
    ("velocity", (SPEEDS,)),
    ("ramp", ((0x607F,), (1_000, 30_000))),
    ("torque", (TORQUES,)),
    ("halt", ((5, 21, 60),)),
    ("dare", ((1, 3),)),
    ("option", ((0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6007), tuple(range(-1, 9)))),
    ("ramp", ((0x6081, 0x6083, 0x6084, 0x6085, 0x607F), (1_000, 30_000, 500_000))),
    ("nmt", ((0x01, 0x01, 0x01, 0x02, 0x80, 0x81, 0x82),)),
    ("sync", ()),
    ("heartbeat", ()),
    ("stale reset", ()),
    ("physics", (PHYSICS,)),
    ("wait", ((0.3, 1, 5, 21, 77),)),
    ("wait", ((0.3, 1, 5, 21, 77),)),
)
Deed = tuple[str, tuple[object, ...]]


class Stranger:
    """A sequence of random actions on a drive; `drive` checks everything itself."""

    def __init__(self, start: str, limited: bool, mode: int) -> None:
        """Start at any depth of the table; runs from the first state would rarely reach the end."""
        self.drive = drive = Watched(
            objects={**OBJECTS, **(LIMITS if limited else {})},
            timing={"boot_up_s": 0.01},
            plant=LIGHT,
        )
        if start == "switched off":
            return
        drive.wait(10 * MS)
        drive.nmt(0x01)
        if start in ("enabled", "moving"):
            drive.sdo(0x6060, 0, mode, 1)
            self.reach((State.OPERATION_ENABLED,))
        if start == "moving":
            drive.sdo(0x6071, 0, 400, 2)
            drive.rpdo(4, 0x0F, (30_000).to_bytes(4, "little"))
            drive.rpdo(3, 0x1F, (9_000).to_bytes(4, "little"))
            drive.wait(30 * MS)

    def reach(self, states: tuple[State, ...]) -> None:
        """Go towards one of these states, with the words that lead there."""
        drive = self.drive
        if drive.nmt_state not in ("initialising", "operational"):
            drive.nmt(0x01)
        for name, value in drive.inputs.items():
            if name != "fault" and value != NORMAL.get(name, 0):
                drive.stimulate(name, NORMAL.get(name, 0))
        for _ in range(6):
            if drive.state in states:
                return
            drive.rpdo(1, 0x00 if drive.state is State.FAULT else drive.controlword_now & 0x7F)
            drive.rpdo(1, FORWARD.get(drive.state, 0x02))
            drive.wait(21 * MS)

    def go_for(self, number: int, option: int) -> None:
        """Reach a transition's start state, then send the transition's own word."""
        drive = self.drive
        if number in (11, 12, 16):
            drive.sdo(0x605A, 0, option, 2)
        starts = TABLE[number][0]
        if starts == (State.QUICK_STOP_ACTIVE,):
            self.reach((State.OPERATION_ENABLED,))
            drive.rpdo(1, 0x02)
        elif len(starts) == 1:
            self.reach(starts)
        if drive.state in starts and number in WORDS:
            drive.rpdo(1, WORDS[number])
            drive.wait(5 * MS)

    def dare(self, mode: int) -> None:
        """Enable with a target that was not started (pp), or above a speed limit (pv)."""
        drive = self.drive
        drive.sdo(0x6060, 0, mode, 1)
        drive.sdo(0x607F, 0, 1_000 if mode == 3 else 30_000, 4)
        self.reach((State.OPERATION_ENABLED,))
        drive.wait(21 * MS)
        drive.rpdo(1, 0x0F)
        drive.rpdo(3 if mode == 1 else 4, 0x0F, (40_000).to_bytes(4, "little"))
        drive.wait(21 * MS)

    def does(self, deed: Deed) -> None:
        """Do one of DEEDS, with one value of each kind."""
        what, values = deed
        numbers = [value for value in values if isinstance(value, (int, float))]
        drive, word = self.drive, self.drive.controlword_now
        if what in ("word", "mode"):
            self._write(what, values[0] == "SDO", int(numbers[0]))
        elif what == "again":
            drive.rpdo(1, word)
        elif what == "go for":
            self.go_for(int(numbers[0]), int(numbers[1]))
        elif what == "position":
            place = int(numbers[0]).to_bytes(4, "little", signed=True)
            drive.rpdo(3, word & ~0x10, place)
            drive.wait(12 * MS)
            drive.rpdo(3, int(numbers[1]), place)
        elif what == "velocity":
            drive.rpdo(4, word, int(numbers[0]).to_bytes(4, "little", signed=True))
        elif what == "torque":
            drive.sdo(0x6071, 0, int(numbers[0]), 2)
        elif what == "dare":
            self.dare(int(numbers[0]))
        elif what == "halt":
            drive.rpdo(1, word | 0x0100)
            drive.wait(int(numbers[0]) * MS)
        elif what == "option":
            drive.sdo(int(numbers[0]), 0, int(numbers[1]), 2)
        elif what == "ramp":
            drive.sdo(int(numbers[0]), 0, int(numbers[1]), 4)
        elif what == "nmt":
            drive.nmt(int(numbers[0]))
        elif what == "sync":
            drive.speak(0x080, b"")
        elif what == "heartbeat":  # once received, lost 50 ms later
            drive.speak(0x77F, b"\x05")
        elif what == "stale reset":
            drive.rpdo(1, 0x80)
            drive.stimulate("fault", 0x2310)
        elif what == "physics":
            (pair,) = values
            assert isinstance(pair, tuple)
            drive.stimulate(*pair)
        else:
            drive.wait(round(numbers[0] * MS))

    def _write(self, what: str, by_sdo: bool, value: int) -> None:
        drive = self.drive
        if by_sdo:
            index, size = (0x6040, 2) if what == "word" else (0x6060, 1)
            drive.sdo(index, 0, value, size)
        elif what == "word":
            drive.rpdo(1, value)
        else:
            drive.rpdo(2, drive.controlword_now, value.to_bytes(1, "little"))


def walk(seed: int, deeds: int = 40) -> Watched:
    """Return a drive after this many random actions; the same actions for the same seed."""
    dice = Random(f"stranger {seed}")
    stranger = Stranger(dice.choice(STARTS), dice.random() < 0.5, dice.choice(MODES))
    for _ in range(deeds):
        what, kinds = dice.choice(DEEDS)
        stranger.does((what, tuple(dice.choice(kind) for kind in kinds)))
    return stranger.drive


def walks(count: int) -> list[Watched]:
    """Walk with this many seeds; a failure names its seed."""
    runs: list[Watched] = []
    for seed in range(count):
        try:
            runs.append(walk(seed))
        except Exception as error:
            error.add_note(f"repeat with: tests.support.cia402.stranger.walk({seed})")
            raise
    return runs
