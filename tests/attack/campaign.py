"""A campaign: attempts of one attack, one after another, from one seed, until time or number is up.

An attempt is determined by the seed and its own number; it raises an exception if it finds a
defect. A finding is printed with the command that repeats this one attempt.
"""

import hashlib
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, final

FINDINGS_SHOWN: Final = 5
_NUMBER: Final = re.compile(r"-?\d[\d.]*")
_PROGRESS_S: Final = 2.0


@final
@dataclass(frozen=True)
class Done:
    """The result of an attempt without a finding.

    Attributes:
        count: how many units of the attack it had: frames, runs, files, kills.
        heard: bytes for the digest of the campaign.
        reached: events, to see that the attack reached what it should.
    """

    count: int
    heard: bytes = b""
    reached: Counter[str] = field(default_factory=Counter)


Attempt = Callable[[int], Done]


@final
@dataclass(frozen=True)
class Attack:
    """An attack by its name in the command line.

    Attributes:
        name: its name.
        unit: what is counted.
        begin: return the attempts of a seed.
        options: further options in the command that repeats an attempt.
    """

    name: str
    unit: str
    begin: Callable[[int], Attempt]
    options: str = ""


@final
@dataclass
class Campaign:
    """The results of the attempts of an attack.

    Attributes:
        count: number of units.
        attempts: number of attempts.
        findings: by description without its numbers, the number of the first attempt with it.
    """

    attack: Attack
    seed: int
    count: int = 0
    attempts: int = 0
    findings: dict[str, int] = field(default_factory=dict)
    reached: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        """Begin the digest."""
        self._digest = hashlib.sha256()

    def run(self, seconds: float, count: int | None = None, first: int = 0) -> None:
        """Make attempts until the number of units or, without one, the time is reached."""
        begun_s = shown_s = time.monotonic()
        attempt = self.attack.begin(self.seed)
        number = first
        while self.count < count if count is not None else self.seconds < seconds:
            self._try(attempt, number)
            number += 1
            now_s = time.monotonic()
            self.seconds = now_s - begun_s
            if sys.stderr.isatty() and now_s - shown_s > _PROGRESS_S:
                shown_s = now_s
                print(f"\r{self.attack.name}: {self.count} {self.attack.unit}, "
                      f"{len(self.findings)} findings", end="", file=sys.stderr)  # fmt: skip

    def _try(self, attempt: Attempt, number: int) -> None:
        self.attempts += 1
        try:
            done = attempt(number)
        except Exception as error:
            self.count += 1
            what = f"{type(error).__name__}: {error}".splitlines()[0]
            kind = _NUMBER.sub("N", what)
            if kind not in self.findings and len(self.findings) < FINDINGS_SHOWN:
                traceback.print_exception(error, limit=-20)  # the last ones: a recursion has many
                print(f"FAILED: {self.attack.name}: seed {self.seed}, attempt {number}: {what}")
                print(f"again: {self.again(number)}", flush=True)
            self.findings.setdefault(kind, number)
            self._digest.update(what.encode())
            return
        self.count += done.count
        self.reached.update(done.reached)
        self._digest.update(done.heard)

    def again(self, number: int) -> str:
        """Return the command that repeats one attempt."""
        return (
            f"python -m tests.attack {self.attack.name} {self.attack.options}--seed {self.seed} "
            f"--first {number} --count 1"
        )

    def digest(self) -> str:
        """Return the digest of all that was heard; equal for equal seed, number and answers."""
        return self._digest.hexdigest()[:16]

    def summary(self) -> str:
        """Return a line with counts, rate and digest; then a line for each finding and event."""
        rate = self.count / self.seconds if self.seconds else 0.0
        lines = [
            f"{self.attack.name}: seed {self.seed}: {self.count} {self.attack.unit} in "
            f"{self.attempts} attempts, {rate:.1f} {self.attack.unit}/s, "
            f"{len(self.findings)} findings, digest {self.digest()}"
        ]
        lines += [f"{count:>10}  {what}" for what, count in sorted(self.reached.items())]
        lines += [f"   attempt {number}: {what}" for what, number in self.findings.items()]
        return "\n".join(lines)
