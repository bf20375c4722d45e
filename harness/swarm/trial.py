"""Trial: one world, run in this process, judged."""

import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.oracles.base import Verdict, Violation
from motorhil.harness.oracles.facts import Facts, subjects_in
from motorhil.harness.oracles.judge import IDS, judge
from motorhil.harness.oracles.limits import VelocityLimit
from motorhil.harness.rig.config.rig_file import read_rig
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.recording import files_of
from motorhil.harness.rig.rig import Rig, installed_plugins
from motorhil.harness.rig.script import is_own_file, read_script, run_script
from motorhil.harness.swarm import properties
from motorhil.harness.swarm.plan import FUNCTION, Plan
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.worlds.disturbance import World, fragment
from motorhil.harness.swarm.worlds.fairness import fair, fair_in
from motorhil.harness.swarm.worlds.observer import Observer, acts_of
from motorhil.harness.swarm.worlds.profile import Profile, Profiler
from motorhil.traces.digest import digest
from motorhil.traces.mcap.records import Attachment

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import RigDescription

_TEXT_MAX: Final = 300


@final
@dataclass(frozen=True, slots=True)
class Failure:
    """Something that a run did wrong.

    Attributes:
        time_ns: when [ns].
        oracle: who saw it.
        rule: what was broken, without numbers and names.
        role: the kind of the motor or controller concerned, or "".
        text: the failure in a sentence.
    """

    time_ns: int
    oracle: str
    rule: str
    role: str
    text: str


def tried(plan: Plan, seed: int, world: World, record: Path | None = None) -> Row:
    """Run the world and return its row; pairs are not yet compared with earlier worlds.

    Args:
        plan: the campaign.
        seed: the world's seed, and the rig's.
        world: its disturbances.
        record: where the record stays; None: it is removed.
    """
    return _Trial(plan, seed, world, record).run()


def tried_in(plan: Plan, seed: int, file: Path, record: Path | None = None) -> Row:
    """Run the world of a fragment, as `tried` does; allowed errors may end the program."""
    return _Trial(plan, seed, (), record, file).run()


def profiled(plan: Plan, seed: int) -> tuple[Row, Profile | None]:
    """Run the undisturbed world; return its row, and what it looks like unless it failed."""
    trial = _Trial(plan, seed, (), None)
    row = trial.run(profiles=True)
    return row, trial.profile


@final
class _Trial:
    """One run."""

    def __init__(
        self, plan: Plan, seed: int, world: World, record: Path | None, file: Path | None = None
    ) -> None:
        self.profile: Profile | None = None
        self._plan = plan
        self._seed = seed
        self._world = world
        self._file = file
        self._record = record
        self._failures: list[Failure] = []
        self._ended_by = ""

    def run(self, profiles: bool = False) -> Row:
        """Run it, and judge it."""
        passing = Path(tempfile.mkdtemp(prefix="motorhil-swarm-"))
        try:
            record = self._record or passing / "run.mcap"
            try:
                rig = self._opened(record, passing)
            except RigError as error:
                return Row(self._seed, Result.CANCELLED, text=str(error)[:_TEXT_MAX])
            return self._judged(rig, record, profiles)
        finally:
            shutil.rmtree(passing, ignore_errors=True)

    def _opened(self, record: Path, passing: Path) -> Rig:
        world = self._file
        if self._world:
            world = passing / f"world-{self._seed}.toml"
            world.write_text(fragment(self._world))
        description = read_rig(Path(self._plan.rig), installed_plugins(), world)
        return Rig(description, seed=abs(self._seed), record=record, doubts=False)

    def _judged(self, rig: Rig, record: Path, profiles: bool) -> Row:
        properties.forget()
        observer = Observer(rig)
        profiler = Profiler(rig) if profiles else None
        end_ns = self._plan.end_ns(rig.description.world.swarm)
        is_late = self._run(rig, end_ns)
        if profiler is not None:
            self.profile = profiler.profile()
        ended_ns = rig.runtime.now_ns()
        self._judge(rig.description, record)
        row = Row(
            self._seed,
            Result.PASSED,
            end_ns=ended_ns,
            digest=digest(record)[:16],
            fired=len(observer.events),
            ended_by=self._ended_by,
            new=tuple(observer.pairs),
            met=tuple(properties.met().items()),
            acts=acts_of(self._world, [observer]),
            world=self._world,
        )
        if is_late:
            text = f"still runs after {end_ns / 1e9:g} s; expected an end; see end_s of [swarm]"
            self._failures.append(Failure(end_ns, "end", "still runs", "", text))
        if not self._failures:
            return row
        first = min(self._failures, key=lambda one: one.time_ns)
        if self._seed == CANARY:
            first = replace(first, text=", ".join(sorted({one.oracle for one in self._failures})))
        return replace(
            row,
            result=Result.TIMEOUT if is_late and first.oracle == "end" else Result.FAILED,
            oracle=first.oracle,
            signature=_signature(first, observer),
            text=first.text[:_TEXT_MAX],
            at_ns=first.time_ns,
        )

    # --- the run ---------------------------------------------------------------------------------

    def _run(self, rig: Rig, end_ns: int) -> bool:
        """Run the program; return True if it had to be ended."""
        alarm = rig.runtime.queue.alarm(lambda now_ns: _interrupt(rig))
        alarm.set(end_ns)
        try:
            with rig:
                self._run_program(rig)
                if self._seed == CANARY:
                    self._plant(rig)
        except KeyboardInterrupt:
            return rig.runtime.now_ns() >= end_ns
        except Exception as error:  # of the rig's end, such as that of a party without a join
            self._raised(error, rig)
        return False

    def _run_program(self, rig: Rig) -> None:
        program = self._plan.program
        if program.kind == FUNCTION:
            try:
                _function(program.name)(rig)
            except Exception as error:
                self._raised(error, rig)
            return
        status = run_script(
            rig, read_script(program.name), program.words, lambda error, _: self._raised(error, rig)
        )
        if status and not self._failures and not self._ended_by:
            text = f"exit status {status}; expected 0"
            self._failures.append(Failure(rig.runtime.now_ns(), "exit", text, "", text))

    def _plant(self, rig: Rig) -> None:
        """Break a promise of the program."""
        try:
            properties.always(False, "the canary is found")
        except properties.PropertyViolated as error:
            self._raised(error, rig)

    def _raised(self, error: BaseException, rig: Rig) -> None:
        """Take an exception that ended the program, or one of its threads."""
        kinds = [kind.__name__ for kind in type(error).__mro__]
        name = type(error).__name__
        allowed = rig.description.world.swarm.allowed_errors
        if (self._world or self._file) and any(one in kinds for one in allowed):
            self._ended_by = self._ended_by or name
            return
        place = _place(error)
        message = str(error).partition("\n")[0]
        oracle, rule = "exception", f"{name} at {place}"
        if isinstance(error, properties.PropertyViolated):
            oracle, rule = "always", message
        elif isinstance(error, AssertionError):
            oracle, rule = "assert", f"assert at {place}"
        text = f"{name}: {message} ({place})"
        self._failures.append(Failure(rig.runtime.now_ns(), oracle, rule, "", text))

    # --- judgement -------------------------------------------------------------------------------

    def _judge(self, description: "RigDescription", record: Path) -> None:
        asked = self._plan.oracles or description.world.swarm.oracles
        only = asked or (fair(self._world) if self._file is None else fair_in(self._file))
        facts = Facts()
        if self._seed == CANARY:
            facts, only = _at_rest(description), (*only, VelocityLimit.id)
        for finding in judge(record, facts, only=only):
            first = finding.first
            if finding.verdict is Verdict.BROKEN and first is not None:
                rule = _without_names(first.text, description)
                role = _role(first, description)
                failure = Failure(first.time_ns, finding.oracle, rule, role, str(first))
                self._failures.append(failure)


def _interrupt(rig: Rig) -> None:
    rig.runtime.interrupt()


def _at_rest(description: "RigDescription") -> Facts:
    """Return limits that any motion breaks: the canary's second defect."""
    files = [Attachment(name, kind, 0, data) for name, kind, data in files_of(description)]
    return Facts(
        {
            name: replace(one, limits={f"velocity_max_{one.unit or 'rad'}_s": 0.0})
            for name, one in subjects_in(files).items()
        }
    )


def _function(target: str) -> Callable[[Rig], object]:
    module, _, name = target.partition(":")
    sys.path.insert(0, "")
    function: Callable[[Rig], object] = getattr(import_module(module), name)
    return function


def _place(error: BaseException) -> str:
    """Return file and line of the innermost frame that is the application's."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not is_own_file(frame.filename)]
    if not own:
        return "?"
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}"


def _without_names(text: str, description: "RigDescription") -> str:
    words = []
    names = {*description.motors, *description.controllers, *description.buses}
    for word in text.split(" "):
        bare = word.strip(",.;:()")
        words.append("#" if bare in names or any(c.isdigit() for c in bare) else word)
    return " ".join(words)


def _role(violation: Violation, description: "RigDescription") -> str:
    """Return the adaptation of the motor concerned, or the kind of the controller."""
    motor = description.motors.get(violation.motor)
    if motor is not None:
        return motor.adaptation
    place = (violation.bus, violation.node)
    for one in description.controllers.values():
        if (one.bus, one.node_id) == place:
            return one.kind
    return ""


def _signature(failure: Failure, observer: Observer) -> str:
    event = observer.before(failure.time_ns)
    state = "-" if event is None else event.state
    last = "undisturbed" if event is None else event.what
    return " | ".join((failure.oracle, failure.rule, failure.role or "-", state, last))


def oracles_known(names: Sequence[str]) -> list[str]:
    """Return those names that are no oracle's."""
    return [name for name in names if name not in IDS]
