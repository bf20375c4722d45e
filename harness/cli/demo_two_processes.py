"""`motorhil demo --two-processes`: two programs share the pan motor.

The rover is served on a hub in wall time, and recorded. Two programs join it, each in a process of
its own. `driving_program.py` drives a manoeuvre and looks along each leg before it;
`mast_program.py` takes panoramas. The mast's program is killed once the driving program has had the
pan motor, and waits for it again while the mast moves it. The driving program must finish all the
same. The record alone then shows who had the motor when, and why it changed owners.

Nothing is left behind in any case: programs are ended by their process ids, and socket and locks
are in a folder that is removed. If this process itself is killed, its programs end with the hub,
and the next run of the demo removes the folder.
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

from motorhil.emulators.gateways.hub import HubError, HubServer
from motorhil.emulators.gateways.loop import WallLoop
from motorhil.harness.cli.main import FAILED, PASSED
from motorhil.harness.cli.options import print_table
from motorhil.harness.cli.processes import STOPPING, Program, StopSignals
from motorhil.harness.examples.driving_program import LEGS
from motorhil.harness.examples.rover_kinematics import WHEELS
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.locking.lock_status import read_process
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import CAN_FRAME, LockAction
from motorhil.traces.semantics.ownership import Ended, OwnershipRecord, Tenure, read_ownership

if TYPE_CHECKING:
    from motorhil.emulators.simulation.ownership_notice import OwnershipNotice

SHARED: Final = "pan"
ERROR_MAX_RAD: Final = 0.002  # largest acceptable position error of a motor at the end
_HALT: Final = 0x01  # bit 8 of the controlword (CiA 402), in the first RPDO's second byte
MOVES_RAD_S: Final = 0.1  # a faster motor is in the middle of a move
LONGEST_NS: Final = 120_000_000_000
_FOLDER: Final = "motorhil-demo-"


def run(target: Path, seed: int | None) -> int:
    """Run the demo; return 0 if the driving program finished and the record shows why, else 1.

    Args:
        target: the record.
        seed: overrides the rig's own seed.

    Raises:
        RigError, TraceError: something cannot be used or written.
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
        print(f"again: {_repeat_command(target, seed)}", file=sys.stderr)
    return FAILED if wrong else PASSED


def _repeat_command(target: Path, seed: int | None) -> str:
    """Return the command that repeats this run."""
    seeded = [] if seed is None else ["--seed", str(seed)]
    return shlex.join(["motorhil", "demo", "--two-processes", *seeded, "-o", str(target)])


@contextmanager
def private_folder() -> Iterator[Path]:
    """Create a folder for socket and locks; first remove folders of demos that were killed."""
    base = Path(tempfile.gettempdir())
    for left in base.glob(f"{_FOLDER}*"):
        with suppress(ValueError, OSError):
            pid, born = (int(word) for word in left.name.removeprefix(_FOLDER).split("-")[:2])
            alive = read_process(pid)
            if (alive is None or alive[1] != born) and left.lstat().st_uid == os.geteuid():
                shutil.rmtree(left)
    process = read_process(os.getpid())
    born = 0 if process is None else process[1]
    try:
        made = tempfile.TemporaryDirectory(prefix=f"{_FOLDER}{os.getpid()}-{born}-")
    except OSError as error:
        reason = error.strerror or str(error)
        raise RigError(base, f"cannot create a folder: {reason}", "set TMPDIR") from None
    with made as folder:
        yield Path(folder)


def _serve(rig: Rig, loop: WallLoop, folder: Path) -> dict[str, str]:
    """Serve the rig's buses on a hub; return the environment for programs that join it."""
    hub = folder / "hub"
    locks = folder / "locks"
    locks.mkdir(mode=0o700)
    try:
        loop.add(HubServer(hub, rig.world))
    except HubError as error:
        reason = str(error).removeprefix(f"{hub}: ").partition(";")[0]
        raise RigError(hub, reason, "set TMPDIR to a folder with a shorter name") from None
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
    """The actions of the two programs, printed as they happen, and the kill of one of them."""

    def __init__(self, rig: Rig, driving: Program, mast: Program) -> None:
        self._rig = rig
        self._driving = driving
        self._mast = mast
        self._node_id = rig.description.motors[SHARED].node_id
        self._bus = rig.description.motors[SHARED].bus
        self._holder = 0  # pids of the owner and of the waiting program
        self._waiter = 0
        self._driving_tenures = 0  # how often the driving program had it
        self._killed = False
        self._ended: tuple[int | None, int | None] = None, None
        rig.world.tap_ownership(self._note_ownership)

    def _note_ownership(
        self, bus: str, time_ns: int, sender: str, notice: "OwnershipNotice"
    ) -> None:
        if (bus, notice.resource) != (self._bus, self._node_id):
            return
        pid = notice.pid
        match LockAction(notice.action):
            case LockAction.TAKEN | LockAction.BROKEN | LockAction.TAKEN_OVER:
                self._holder = pid
                self._waiter = 0 if self._waiter == pid else self._waiter
                self._driving_tenures += pid == self._driving.pid
            case LockAction.RELEASED | LockAction.LOST:
                self._holder = 0 if self._holder == pid else self._holder
            case LockAction.WAITING:
                self._waiter = pid
            case LockAction.REFUSED:
                self._waiter = 0 if self._waiter == pid else self._waiter

    def is_over(self) -> bool:
        """Process new output, kill the mast's program when due; return True at the end."""
        ended = [program.status for program in (self._driving, self._mast)]
        for program in (self._driving, self._mast):  # also of an ended one
            for line in program.lines():
                self._print_line(program.name, line)
        if self._is_the_moment():
            self._mast.kill()
            self._killed = True
            self._print_line("demo", f"kills {self._mast.file}, which moves {SHARED}")
        driving, mast = ended
        is_late = self._rig.world.queue.now_ns > LONGEST_NS
        if is_late or driving is not None or (mast is not None and not self._killed):
            self._ended = driving, mast
            return True
        return False

    def _is_the_moment(self) -> bool:
        """Return True when the driving program waits again while the mast moves the motor."""
        return (
            not self._killed
            and self._driving_tenures > 0
            and (self._holder, self._waiter) == (self._mast.pid, self._driving.pid)
            and abs(self._rig.controllers[SHARED].snapshot()["velocity_rad_s"]) > MOVES_RAD_S
        )

    def _print_line(self, source: str, text: str) -> None:
        now_ns = self._rig.world.queue.now_ns
        print(f"{now_ns / 1e9:7.3f} s  {source:<8}{text}", file=sys.stderr, flush=True)
        if self._rig.recording is not None:
            self._rig.recording.event(now_ns, "info", source, text)

    def wrong(self) -> Iterator[str]:
        """Yield what did not go as it should."""
        driving, mast = self._ended
        if driving:
            yield f"{self._driving.file} failed with status {driving}"
        if mast is not None and not self._killed:
            yield f"{self._mast.file} ended by itself, with status {mast}"
        elif driving is None:
            yield f"{self._driving.file} did not finish within {LONGEST_NS / 1e9:.0f} s"
        elif not self._killed:
            yield f"{self._mast.file} could not be killed in time: the two programs did not meet"


def _motors(rig: Rig) -> tuple[list[tuple[str, ...]], list[str]]:
    """Return a row per motor of target and true position, and messages about large errors."""
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
            off.append(f"{motor}: the position error is {error_rad * 1e3:.1f} mrad")
    return rows, off


def _print_owners(
    description: RigDescription, target: Path, driving: Program, mast: Program
) -> list[str]:
    """Print the owners of the shared motor from the record alone; return what it does not prove."""
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
    wrong = [*record.contradictions, *_foreign(record, sent, commands)]
    died = [place for place, one in enumerate(tenures) if one.ended is Ended.DIED]
    if len(died) != 1 or tenures[died[0]].pid != mast.pid:
        wrong.append(f"the record does not show that {mast.file} died with {SHARED}")
    elif any(one.pid != driving.pid for one in tenures[died[0] + 1 :]):
        wrong.append(f"the record shows another owner than {driving.file} afterwards")
    return wrong


def _foreign(
    record: OwnershipRecord,
    sent: Iterable[tuple[int, str, bool]],
    commands: "Counter[tuple[Tenure | None, bool]]",
) -> Iterator[str]:
    """Yield a message about commands of others than the owner, with the first suspect."""
    count = sum(count for (_, is_owners), count in commands.items() if not is_owners)
    for time_ns, sender, _ in sent if count else ():
        owner = record.owner_at(SHARED, time_ns)
        if owner is None or owner.sender != sender:
            yield (
                f"{count} commands do not belong to the owner of {SHARED} at their time; at "
                f"{time_ns / 1e9:.6f} s {sender} sends one, and the owner is "
                f"{'nobody' if owner is None else owner}"
            )
            return


def commands_by_tenure(
    record: OwnershipRecord, sent: Iterable[tuple[int, str, bool]]
) -> Counter[tuple[Tenure | None, bool]]:
    """Count commands (time, sender, is a halt) of the shared motor by (tenure, sent by its owner).

    A motor that moves for a program that died is halted by any program that remains, before the
    motor has a new owner. Such a halt is nobody's command, and does not count.

    The CAN controller of a program still transmits what the program sent just before it died. Until
    its successor commands for the first time, such frames count for the dead program, as does the
    motion that it started.
    """
    tenures = record.tenures.get(SHARED, ())
    heirs = {after: dead for dead, after in pairwise(tenures) if dead.ended is Ended.DIED}
    commands: Counter[tuple[Tenure | None, bool]] = Counter()
    for time_ns, sender, is_halt in sent:
        owner = record.owner_at(SHARED, time_ns)
        if is_halt and owner is not None and owner.ended is Ended.DIED and owner.sender != sender:
            continue
        dead = None if owner is None else heirs.get(owner)
        if dead is not None and dead.sender == sender and not commands[owner, True]:
            owner = dead
        commands[owner, owner is not None and owner.sender == sender] += 1
    return commands


def _received_by(trace: Trace, bus: str, node_id: int) -> Iterator[tuple[int, str, bool]]:
    """Yield (time [ns], sender, is a halt) of each RPDO of a node (CiA 301: 200h to 500h + ID)."""
    for _, time_ns, message in trace.messages([f"/can/{bus}"]):
        frame = decode(CAN_FRAME, message)
        can_id = -1 if frame.get("error") else frame.get("id", 0)  # a class
        if can_id in [0x200 + node_id, 0x300 + node_id, 0x400 + node_id, 0x500 + node_id]:
            data = frame.get("data")
            word = data if isinstance(data, bytes) and can_id == 0x200 + node_id else b""
            halts = bool(word[1:2]) and bool(word[1] & _HALT)
            yield time_ns, str(frame.get("sender", "")), halts
