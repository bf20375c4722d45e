"""Worker process: runs worlds of one plan, each in a forked child.

Requests and answers are lines of JSON. The first request is the plan; the answer is "ready", or the
reason why this worker refuses. A request for a chunk is answered by its rows and "done". A child
that hangs or dies costs its own world only, and leaves nothing behind in the next one.

    python -m motorhil.harness.swarm.worker
"""

import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import describe
from motorhil.harness.swarm.lanes import Lane
from motorhil.harness.swarm.plan import Plan, build, contents_of, plan_from
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from
from motorhil.harness.swarm.trial import tried
from motorhil.harness.swarm.worlds.disturbance import World, from_table

_BYTES: Final = 1 << 16
_TRIES: Final = 2
"""A world that something outside killed runs once more."""
_OUTSIDE: Final = (signal.SIGKILL, signal.SIGTERM)


def main() -> int:
    """Serve requests from standard input until it ends."""
    answers = os.fdopen(os.dup(1), "w")
    _silence()
    plan: Plan | None = None
    for line in sys.stdin:
        request: dict[str, Any] = json.loads(line)
        if "plan" in request:
            plan = plan_from(request["plan"])
            answer: Iterable[str] = [json.dumps({"ready": True, "refused": refusal(plan)})]
        elif plan is None:
            answer = [json.dumps({"refused": "no plan was given"})]
        else:
            answer = _rows(plan, request)
        for text in answer:
            answers.write(text + "\n")
            answers.flush()
    return 0


def refusal(plan: Plan) -> str:
    """Return why this installation cannot run the plan, or ""."""
    if build() != plan.build:
        return f"motorhil here is {build()}; the campaign's is {plan.build}; install the same"
    try:
        contents = contents_of(Path(plan.rig), plan.program)
    except RigError as error:
        return str(error)
    if contents != plan.contents:
        return f"{plan.rig} or the program differs from the campaign's; copy the same files"
    return ""


def _rows(plan: Plan, request: dict[str, Any]) -> Iterable[str]:
    if "try" in request:
        world = tuple(from_table(one) for one in request["world"])
        record = request.get("record")
        path = None if record is None else Path(record)
        yield run_forked(plan, request["try"], world, path).as_line()
    else:
        corpus = [tuple(from_table(one) for one in world) for world in request["corpus"]]
        lane = Lane(request["seen"], corpus)
        for seed in request["seeds"]:
            yield _next(plan, lane, seed, request["guided"]).as_line()
    yield json.dumps({"done": True})


def _next(plan: Plan, lane: Lane, seed: int, guided: bool) -> Row:
    """Run the next world of a lane; the row has only what is new in it."""
    assert plan.profile is not None
    table = describe(Path(plan.rig)).world.swarm
    world = lane.world(abs(seed), plan.profile, table, guided)
    row = run_forked(plan, seed, world)
    new = tuple(pair for pair in row.new if pair not in lane.seen)
    row = replace(row, new=new if seed != CANARY else ())
    lane.learn(row)
    return row if row.new or row.is_bad else replace(row, world=())


def run_forked(plan: Plan, seed: int, world: World, record: Path | None = None) -> Row:
    """Run a world in a child process; return its row whatever becomes of the child."""
    row = Row(seed, Result.KILLED)
    for _ in range(_TRIES):
        row = _in_child(plan, seed, world, record)
        if row.result is not Result.KILLED:
            break
    return row


def _in_child(plan: Plan, seed: int, world: World, record: Path | None) -> Row:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        _run_and_exit(lambda: tried(plan, seed, world, record), writing)
    os.close(writing)
    text, is_late = _read(reading, plan.wall_s)
    os.close(reading)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # and what it has started
    _, status = os.waitpid(child, 0)
    if is_late:
        what = f"takes more than {plan.wall_s:g} s of wall time; expected an end; see --timeout"
        return Row(seed, Result.TIMEOUT, "end", "end | hangs | - | - | -", what, world=world)
    try:
        return row_from(text)
    except ValueError:
        return _died(seed, world, status)


def _died(seed: int, world: World, status: int) -> Row:
    """Return the row of a child that ended without one."""
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if number in _OUTSIDE:
        return Row(seed, Result.KILLED, text=f"killed by {signal.Signals(number).name}")
    if number:
        what = f"crashed by {signal.Signals(number).name}"
    else:
        what = f"left its process with status {os.waitstatus_to_exitcode(status)}"
    signature = f"exit | {what} | - | - | -"
    return Row(seed, Result.FAILED, "exit", signature, f"the program {what}", world=world)


def _run_and_exit(run: Callable[[], Row], writing: int) -> None:
    """Run in the child, and send the row; never returns."""
    status = 1
    try:
        os.setpgid(0, 0)
        line = run().as_line().encode()
        while line:
            line = line[os.write(writing, line) :]
        status = 0
    except BaseException as error:
        row = Row(0, Result.CANCELLED, text=f"{type(error).__name__}: {error}")
        os.write(writing, row.as_line().encode())
    finally:
        os._exit(status)


def _read(reading: int, wall_s: float) -> tuple[bytes, bool]:
    """Return what the child sent, and whether it took too long."""
    parts: list[bytes] = []
    end = time.monotonic() + wall_s
    while True:
        ready, _, _ = select.select([reading], [], [], max(0.0, end - time.monotonic()))
        if not ready:
            return b"", True
        part = os.read(reading, _BYTES)
        if not part:
            return b"".join(parts), False
        parts.append(part)


def _silence() -> None:
    """Drop what programs print: their rows tell what matters."""
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    os.close(nothing)


if __name__ == "__main__":
    sys.exit(main())
