"""`motorhil demo --two-processes`: two programs share the pan motor, and one of them is killed.

The rover is served on a hub, in wall time, and recorded. Two programs join it, each in a process of
its own: `driving_program.py` drives a manoeuvre and looks along each leg before it, and
`mast_program.py` takes panoramas. When the driving program has had the pan motor once, and waits
for it again while the mast moves it, the mast's program is killed. The driving program is to finish
all the same; who had the motor when, and why it changed hands, is then read from the record alone.

Whatever happens, nothing is left behind: the programs are ended by their ids, the socket and the
locks are in a folder that is removed. Should this process itself be killed, its programs end when
the hub is gone, and the folder is removed when the demo is run next.
"""

import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from emulators.hub import HubError, HubServer
from emulators.serve import WallLoop
from harness.examples.driving_program import LEGS
from harness.examples.rover_kinematics import WHEELS
from harness.exit_status import FAILED, PASSED
from harness.ownership_record import Ended, OwnershipRecord, Tenure, read_ownership
from harness.rig import Rig
from harness.rig_file import RigDescription
from harness.scaffold import EXAMPLES
from harness.settings import RigError
from harness.text_table import print_table
from harness.wall_programs import STOPPING, Program, StopSignals
from motorapi.lock_directory import VARIABLE
from motorapi.lock_view import read_process
from traces.protobuf import decode
from traces.reader import Trace, read_trace
from traces.schema import CAN_FRAME, LockAction

if TYPE_CHECKING:
    from emulators.hub_protocol import OwnershipNotice

SHARED: Final = "pan"
ERROR_MAX_RAD: Final = 0.002  # a motor that ends further off has not done its job
MOVES_RAD_S: Final = 0.1  # a motor that is faster is in the middle of a move
LONGEST_NS: Final = 120_000_000_000
_FOLDER: Final = "motorhil-demo-"


def run(target: Path, seed: int | None) -> int:
    """Exit status: 0 the driving program has finished and the record shows why, else 1.

    Args:
        target: the record.
        seed: instead of the rig's own.

    Raises:
        RigError, TraceError: something cannot be used, or written.
        KeyboardInterrupt: Ctrl-C; everything has ended.
    """
    with ExitStack() as cleanup:
        folder = cleanup.enter_context(private_folder())
        rig = cleanup.enter_context(Rig.open(EXAMPLES / "rover.toml", seed=seed, record=target))
        loop = WallLoop(rig.world.queue)
        cleanup.callback(loop.close)
        signals = cleanup.enter_context(StopSignals(loop, (*STOPPING, signal.SIGHUP)))
        environment = _serve(rig, loop, folder)
        driving, mast = (
            cleanup.enter_context(Program(EXAMPLES / f"{name}_program.py", environment, loop))
            for name in ("driving", "mast")
        )
        story = _Story(rig, driving, mast)
        loop.start()
        loop.run(lambda: signals.number is not None or story.is_over())
        if signals.number == signal.SIGINT:
            raise KeyboardInterrupt
        if signals.number is not None:
            return 128 + signals.number
        rows, off = _motors(rig)
        took_s = rig.world.queue.now_ns / 1e9
    wrong = list(story.wrong())
    if not wrong:
        print()
        print_table(("motor", "target rad", "reached rad", "error mrad"), rows)
        wrong = [*off, *_print_owners(rig.description, target, driving, mast)]
    print(f"\n{took_s:.1f} s in two processes; record {target}")
    for reason in wrong:
        print(f"motorhil demo: {reason}", file=sys.stderr)
    if wrong:
        print(f"again: {_again(target, seed)}", file=sys.stderr)
    return FAILED if wrong else PASSED


def _again(target: Path, seed: int | None) -> str:
    """The command that does the same once more."""
    seeded = [] if seed is None else ["--seed", str(seed)]
    return shlex.join(["motorhil", "demo", "--two-processes", *seeded, "-o", str(target)])


@contextmanager
def private_folder() -> Iterator[Path]:
    """A folder for the socket and the locks; those of demos that were killed are removed first."""
    base = Path(tempfile.gettempdir())
    for left in base.glob(f"{_FOLDER}*"):
        with suppress(ValueError, OSError):
            pid, born = (int(word) for word in left.name.removeprefix(_FOLDER).split("-")[:2])
            alive = read_process(pid)
            if (alive is None or alive[1] != born) and left.lstat().st_uid == os.geteuid():
                shutil.rmtree(left)
    here = read_process(os.getpid())
    born = 0 if here is None else here[1]
    try:
        made = tempfile.TemporaryDirectory(prefix=f"{_FOLDER}{os.getpid()}-{born}-")
    except OSError as error:
        reason = error.strerror or str(error)
        raise RigError(base, f"no folder can be made: {reason}", "set TMPDIR") from None
    with made as folder:
        yield Path(folder)


def _serve(rig: Rig, loop: WallLoop, folder: Path) -> dict[str, str]:
    """The rig's buses are on a hub; the environment of programs that are to join it."""
    hub = folder / "hub"
    locks = folder / "locks"
    locks.mkdir(mode=0o700)
    try:
        loop.add(HubServer(hub, rig.world))
    except HubError as error:
        reason = str(error).removeprefix(f"{hub}: ").partition(";")[0]
        raise RigError(hub, reason, "set TMPDIR to another folder, of a short name") from None
    first, *others = rig.world.bus_names()
    channels = {first: str(hub), **{bus: f"{hub}#{bus}" for bus in others}}
    named = {f"MOTORHIL_CHANNEL_{bus.upper()}": channel for bus, channel in channels.items()}
    return {
        **os.environ,
        **named,
        VARIABLE: str(locks),
        "CAN_INTERFACE": "emulated",
        "CAN_CHANNEL": channels[first],
    }


@final
class _Story:
    """What the two programs do, told as it happens; and the killing of one of them."""

    def __init__(self, rig: Rig, driving: Program, mast: Program) -> None:
        self._rig = rig
        self._driving = driving
        self._mast = mast
        self._node_id = rig.description.motors[SHARED].node_id
        self._bus = rig.description.motors[SHARED].bus
        self._holder = 0  # pids of who has the motor, and who waits for it
        self._waiter = 0
        self._looks = 0  # how often the driving program had it
        self._killed = False
        self._ended: tuple[int | None, int | None] = None, None
        rig.world.tap_ownership(self._heard)

    def _heard(self, bus: str, time_ns: int, sender: str, notice: "OwnershipNotice") -> None:
        if (bus, notice.resource) != (self._bus, self._node_id):
            return
        pid = notice.pid
        match LockAction(notice.action):
            case LockAction.TAKEN | LockAction.BROKEN | LockAction.TAKEN_OVER:
                self._holder = pid
                self._waiter = 0 if self._waiter == pid else self._waiter
                self._looks += pid == self._driving.pid
            case LockAction.RELEASED | LockAction.LOST:
                self._holder = 0 if self._holder == pid else self._holder
            case LockAction.WAITING:
                self._waiter = pid
            case LockAction.REFUSED:
                self._waiter = 0 if self._waiter == pid else self._waiter

    def is_over(self) -> bool:
        """Whether there is no more to come; what there was is told, and done."""
        ended = [program.status for program in (self._driving, self._mast)]
        for program in (self._driving, self._mast):  # all that one printed before it ended
            for line in program.lines():
                self._tell(program.name, line)
        if self._is_the_moment():
            self._mast.kill()
            self._killed = True
            self._tell("demo", f"kills {self._mast.file}, which moves {SHARED}")
        driving, mast = ended
        is_late = self._rig.world.queue.now_ns > LONGEST_NS
        if is_late or driving is not None or (mast is not None and not self._killed):
            self._ended = driving, mast
            return True
        return False

    def _is_the_moment(self) -> bool:
        """The driving program has had the motor once, and waits while the mast moves it."""
        return (
            not self._killed
            and self._looks > 0
            and (self._holder, self._waiter) == (self._mast.pid, self._driving.pid)
            and abs(self._rig.controllers[SHARED].snapshot()["velocity_rad_s"]) > MOVES_RAD_S
        )

    def _tell(self, who: str, text: str) -> None:
        now_ns = self._rig.world.queue.now_ns
        print(f"{now_ns / 1e9:7.3f} s  {who:<8}{text}", file=sys.stderr, flush=True)
        if self._rig.recording is not None:
            self._rig.recording.event(now_ns, "info", who, text)

    def wrong(self) -> Iterator[str]:
        """What did not go as it should."""
        driving, mast = self._ended
        if driving:
            yield f"{self._driving.file} failed with status {driving}"
        if mast is not None and not self._killed:
            yield f"{self._mast.file} ended by itself, with status {mast}"
        elif driving is None:
            yield f"{self._driving.file} was not done after {LONGEST_NS / 1e9:.0f} s"
        elif not self._killed:
            yield f"there was no moment to kill {self._mast.file}: the two did not meet"


def _motors(rig: Rig) -> tuple[list[tuple[str, ...]], list[str]]:
    """A row a motor of where it should be and is, by the plants' truth; and what is off."""
    legs = {name: [leg.wheel(name) for leg in LEGS] for name in WHEELS}
    targets = {f"drive_{name}": sum(roll for _, roll in legs[name]) for name in WHEELS}
    targets |= {f"steer_{name}": legs[name][-1][0] for name in WHEELS}
    targets[SHARED] = LEGS[-1].way_ahead_rad()
    rows: list[tuple[str, ...]] = []
    off: list[str] = []
    for motor, target_rad in targets.items():
        reached_rad = rig.controllers[motor].snapshot()["position_rad"]
        error_rad = reached_rad - target_rad
        rows.append((motor, f"{target_rad:.4f}", f"{reached_rad:.4f}", f"{error_rad * 1e3:+.3f}"))
        if abs(error_rad) > ERROR_MAX_RAD:
            off.append(f"{motor} is off by {error_rad * 1e3:.1f} mrad")
    return rows, off


def _print_owners(
    description: RigDescription, target: Path, driving: Program, mast: Program
) -> list[str]:
    """Who had the shared motor when is printed, by the record alone; what it does not prove."""
    motor = description.motors[SHARED]
    assert motor.bus is not None
    assert motor.node_id is not None
    with read_trace(target) as trace:
        record = read_ownership(trace)
        sent = list(_received_by(trace, motor.bus, motor.node_id))
    tenures = record.tenures.get(SHARED, ())
    commands = commands_by_tenure(record, sent)
    rows = [
        (
            f"{tenure.from_ns / 1e9:.3f}",
            "" if tenure.to_ns is None else f"{tenure.to_ns / 1e9:.3f}",
            *(tenure.program, f"{tenure.pid}", tenure.purpose or tenure.owner),
            f"{commands[tenure, True]}",
            tenure.ended.value,
        )
        for tenure in tenures
    ]
    print(f"\nwho had {SHARED}, and its commands (RPDOs) on the bus, by the record alone:")
    head = ("from s", "to s", "program", "pid", "what for", "commands", "and then it")
    print_table(head, rows, words=(2, 4, 6))
    others = sum(count for (_, is_owners), count in commands.items() if not is_owners)
    wrong = list(record.contradictions)
    if others:
        wrong.append(f"{others} commands are not of whoever had {SHARED} then")
    died = [place for place, one in enumerate(tenures) if one.ended is Ended.DIED]
    if len(died) != 1 or tenures[died[0]].pid != mast.pid:
        wrong.append(f"the record does not show that {mast.file} died with {SHARED}")
    elif any(one.pid != driving.pid for one in tenures[died[0] + 1 :]):
        wrong.append(f"the record shows somebody else than {driving.file} with it afterwards")
    return wrong


def commands_by_tenure(
    record: OwnershipRecord, sent: Iterable[tuple[int, str]]
) -> Counter[tuple[Tenure | None, bool]]:
    """How many commands (when, sender) the shared motor got in each tenure, and if its owner's.

    What a program sends in the instant of its death, its CAN controller still brings to the bus:
    until its heir commands for the first time, it is the dead one's, as is what it began.
    """
    tenures = record.tenures.get(SHARED, ())
    heirs = {after: dead for dead, after in pairwise(tenures) if dead.ended is Ended.DIED}
    commands: Counter[tuple[Tenure | None, bool]] = Counter()
    for time_ns, sender in sent:
        owner = record.owner_at(SHARED, time_ns)
        dead = None if owner is None else heirs.get(owner)
        if dead is not None and dead.sender == sender and not commands[owner, True]:
            owner = dead
        commands[owner, owner is not None and owner.sender == sender] += 1
    return commands


def _received_by(trace: Trace, bus: str, node_id: int) -> Iterator[tuple[int, str]]:
    """(when, who sent it) of each RPDO of a node (CiA 301: 200h, 300h, 400h, 500h + node-ID)."""
    for _, time_ns, data in trace.messages([f"/can/{bus}"]):
        frame = decode(CAN_FRAME, data)
        can_id = -1 if frame.get("error") else frame.get("id", 0)  # a class is no identifier
        if can_id in [0x200 + node_id, 0x300 + node_id, 0x400 + node_id, 0x500 + node_id]:
            yield time_ns, str(frame.get("sender", ""))
