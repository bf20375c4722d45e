"""Real processes that share motors, some of them killed or paused at random.

    outcome = run(Plan(work="my_module:work", seconds=10.0, kill_period_s=0.05))
    print(outcome.table())
    outcome.require_sound()
    outcome.save(Path("history"))  # python -m motorhil.harness.sharing_tests.processes history

`run` starts an *arena* as a separate process. The arena forks the workers before it has held any
lock, kills and pauses them according to the plan, and starts replacements. A worker is a function
`work(desk: Desk)` named as "module:function", which runs until `desk.is_over` and notes all its
uses in `desk.history`. Every use is in a file before it can have an effect. The actions of a killed
worker are therefore known, except for the result of its last use. Available workers are
`motorhil.harness.sharing_tests.workers:work_lock`, which takes a bare lock, and those of
`motorhil.harness.sharing_tests.workers`, which work motors on a hub or on SocketCAN.

The following must hold. The history is that of motors with one owner at a time, first come, first
served. No use is overtaken, and every token grows. Work continues after every death.
"""

import json
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Final, final

from motorhil.harness.sharing_tests.history import (
    Action,
    Answer,
    SharingViolated,
    Use,
    ended_by_death,
    from_lines,
    from_notes,
    overtaken,
    to_line,
    tokens_that_did_not_grow,
    worst_gap_s,
)
from motorhil.harness.sharing_tests.linearizability import require_linearizable

GRACE_S: Final = 2.0
"""The time that workers have to end when told to [s]."""
_ARENA: Final = "motorhil.harness.sharing_tests.arena"
_ENDED_LATE_S: Final = 30.0


@final
@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a run.

    Attributes:
        work: the worker, "module:function".
        facts: parameters of the worker.
        plant: "module:function" that plants a defect in every worker before it begins, for tests.
        kill_inside, pause_inside: choose workers that have the motor, by their own account.
    """

    work: str = "motorhil.harness.sharing_tests.workers:work_lock"
    seconds: float = 1.0
    workers: int = 5
    kill_period_s: float = 0.0
    kill_inside: bool = False
    pause_period_s: float = 0.0
    pause_s: float = 0.02
    pause_inside: bool = False
    seed: int = 1
    plant: str = ""
    facts: dict[str, object] = field(default_factory=dict)


@final
@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a run: the uses of all workers, the counts of events, begin and end."""

    uses: tuple[Use, ...]
    counts: dict[str, int]
    begun_ns: int
    ended_ns: int
    last_kill_ns: int
    complaints: tuple[str, ...]

    @property
    def worst_gap_s(self) -> float:
        """The longest time without a grant of the motor [s]."""
        return worst_gap_s(self.uses, self.begun_ns, self.ended_ns)

    @property
    def waits_s(self) -> list[float]:
        """The waiting times of all grants [s], the shortest first."""
        return sorted(
            (use.returned_ns - use.called_ns) / 1e9
            for use in self.uses
            if use.action is Action.TAKE and use.answer is Answer.DONE
        )

    @property
    def taken_after_last_kill(self) -> int:
        """The number of grants after the last kill."""
        return sum(
            use.returned_ns > self.last_kill_ns
            for use in self.uses
            if use.action is Action.TAKE and use.answer is Answer.DONE
        )

    def reached(self) -> "Counter[str]":
        """Return the number of events of each kind."""
        reached = Counter(self.counts)
        for use in self.uses:
            forced = " from a living owner" if use.forced and use.token else ""
            reached[f"{use.action.value}: {use.answer.value}{forced}"] += 1
        return reached

    def table(self) -> str:
        """Return the counts and the waiting times as text."""
        waits_s = self.waits_s or [0.0]
        lines = [f"{count:8d}  {name}" for name, count in sorted(self.reached().items())]
        lines.append(f"{self.worst_gap_s * 1e3:8.1f}  ms without a grant, at most")
        lines.append(f"{waits_s[-1] * 1e3:8.1f}  ms of waiting, at most")
        lines.append(
            f"{waits_s[len(waits_s) * 99 // 100] * 1e3:8.1f}  ms of waiting, 99th percentile"
        )
        return "\n".join(lines)

    def require_sound(self) -> None:
        """Raise SharingViolated if a rule of sharing is violated."""
        if self.complaints:
            raise SharingViolated("\n".join(self.complaints))
        for earlier, later in tokens_that_did_not_grow(self.uses):
            raise SharingViolated(f"the token did not grow from\n    {earlier}\nto\n    {later}")
        for first, second in overtaken(self.uses):
            raise SharingViolated(f"this use was overtaken:\n    {first}\nby\n    {second}")
        require_linearizable(self.uses)

    def save(self, path: Path) -> None:
        """Write the outcome to a file, to judge it again."""
        rest = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "uses"}
        lines = [json.dumps(rest), *(to_line(use) for use in self.uses)]
        path.write_text("\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: Path) -> "Outcome":
        """Return the outcome written by `save`."""
        first, *lines = path.read_text().splitlines()
        rest = json.loads(first)
        complaints = tuple(rest.pop("complaints"))
        return cls(tuple(from_lines(lines)), complaints=complaints, **rest)


def run(plan: Plan) -> Outcome:
    """Carry out the plan, and return the outcome after all its processes have ended.

    Raises:
        SharingViolated: the arena itself failed.
    """
    with tempfile.TemporaryDirectory(prefix="motorhil-") as folder:
        command = [sys.executable, "-m", _ARENA, folder, json.dumps(asdict(plan))]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=plan.seconds + GRACE_S + _ENDED_LATE_S,
            check=False,
        )
        if done.returncode:
            raise SharingViolated(f"the arena failed ({done.returncode}): {done.stderr}")
        result = json.loads(done.stdout)
        uses = from_notes(Path(folder, "notes").read_text())
    # Other lines are messages for the user: "it moves for a process that died: it is halted".
    complaints = tuple(line for line in done.stderr.splitlines() if line.startswith("worker "))
    return Outcome(ended_by_death(uses), complaints=complaints, **result)


def main() -> int:
    """Judge the saved outcome named by the command line; return 1 if a rule is violated."""
    outcome = Outcome.load(Path(sys.argv[1]))
    print(outcome.table())
    try:
        outcome.require_sound()
    except SharingViolated as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
