"""The built-in adaptations keep their promises, and claim all that they can."""

import re
from pathlib import Path

import pytest

import motorhil.harness.conformance.clauses
from motorhil.harness.conformance.bench import Ability
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.rig.config.conformance import Capability
from tests.support.kit_benches import KINDS, claims, opener

CLAUSES = all_clauses()
# The clauses that are not applicable, so that a claim lost by mistake is noticed.
_OF_CAN = ("BUS-01", "BUS-02", "BUS-03", "BUS-04", "BUS-05", "BUS-06", "TIME-05", "PROC-13")
_OF_CANOPEN = ("CLOCK-01", "CLOCK-02", "LOW-05", "LOW-07", "LOW-08", "LOW-09", "PAR-01", "SYNC-20")
_OF_CAN_DRIVE = tuple(f"API-{number:02}" for number in (1, 2, 3, 4, 5, 8))
_LED = ("LEAD-01", "LEAD-02", "LEAD-03", "LEAD-04")
_OF_CIA402 = ("LIM-09", "MEAS-06")  # objects of the drive; a counter that ends within its reach
_OF_ONE_KIND = ("OPT-07", "LOW-12", "LOW-13")  # damping; a report of cycles; registers by address
_POLLED = frozenset(
    {
        *("OPT-07", "SET-14", "TRAJ-15", "LOW-12", "TIME-06"),
        *("MEAS-02", "SET-04", "SET-07", "TRAJ-04", "TRAJ-06", "TRAJ-07", "TRAJ-09"),
        *("TRAJ-11", "TRAJ-12"),
        *("LIM-05", *_LED, "LEAD-05", "SYNC-06", "SYNC-11", "HOME-03", "LOW-03"),
        *("LOST-02", "LOST-03", "LOST-07", "LOST-08", "LOST-11", "FAULT-07", "TRAJ-14"),
        *("SET-10", "TRAJ-10", "LOW-06", "SYNC-19", *_OF_CAN, *_OF_CAN_DRIVE, *_OF_CANOPEN),
    }
)
_STREAMED = frozenset(  # functions of time for positions; no common trigger, no supply switch
    {
        *("SET-07", "TRAJ-07", "TRAJ-09", "TRAJ-10", "TRAJ-12", "TRAJ-14"),
        *("SET-13", "LOW-12", "LOW-13", "LOW-10"),
        *(*_LED, *_OF_CIA402, "SYNC-06", "SYNC-11", "LOW-04"),
        *("HEAR-05", "SHARE-02", "PROC-14", "LOST-08", "LOW-06", "PAR-02"),
        *_OF_CANOPEN,
    }
)
_SAMPLED = frozenset(  # by the host: positions by functions of time, ramps of velocity and current
    {
        *("MEAS-02", "MEAS-03", "SET-04", "SET-10", "HEAR-05", *_LED, *_OF_CIA402),
        *(*_OF_ONE_KIND, "SET-14", "LOW-10"),
        *(f"TRAJ-{number:02}" for number in (6, 7, 9, 10, 12, 14)),
        *("FAULT-07", "HOME-04"),
        *("HOME-01", "HOME-03", "LOW-03", "LOW-04", "SHARE-02", "PROC-14", "SYNC-06", "SYNC-11"),
        *("LOST-07", "LOST-08", "LOW-06", "PAR-02", "HOME-05", *_OF_CANOPEN),
    }
)
_OF_PROGRAMS = (
    *("PROC-08", "PROC-09", "PROC-10", "PROC-11", "PROC-12", "PROC-16", "PROC-17"),
    *("SYNC-21", "SYNC-22", "SYNC-23"),
)
_OF_RESTARTS = {"HOME-03", "LOW-03", "LOST-07"}
NOT_APPLICABLE = {
    "cia402": frozenset({"SET-07", "API-05", *_OF_ONE_KIND}),
    "ideal": frozenset(
        {
            *("STATE-02", "MEAS-02", "MEAS-03", "MEAS-05"),  # no load
            *("SET-04", "SET-07", "TRAJ-06"),  # likewise
            *("HEAR-01", "HEAR-02", "HEAR-03", "HEAR-04", "HOME-03", "LOW-03"),  # no bus
            *("HEAR-05", "SHARE-02", "PROC-14", "SYNC-05", "SYNC-06"),  # likewise
            *(f"LOST-{number:02}" for number in range(1, 15)),
            *(*_OF_ONE_KIND, "OPT-08", "SET-12", "LOW-10", "PROC-18", "TIME-06", "HOME-07"),
            "OTHER-02",
            *("FAULT-07", "HOME-04"),
            *("OTHER-01", "OVER-01", "SET-10", "LOW-06", *_OF_CAN, *_OF_CAN_DRIVE, *_OF_CANOPEN),
            *(*_OF_PROGRAMS, "PROC-15"),
            *("OPT-04", "OPT-05", "OPT-06", "FIT-01", "FIT-02", "PAR-02", "FAULT-09", *_OF_CIA402),
        }
    ),
    "dryve": _POLLED | {"MEAS-03", "PAR-02", "MEAS-06", "LOW-13", "HOME-07"},
    "dynamixel": frozenset(  # in position mode
        {
            *("MEAS-02", "MEAS-03", "SET-03", "SET-04", "SET-07", "SET-10", "SET-11", "START-04"),
            *("OPT-07", "SET-12", "SET-13", "SET-14", "TRAJ-15", "LOW-12", "TIME-06"),
            *(f"TRAJ-{number:02}" for number in (4, 5, 6, 7, 9, 10, 11, 12, 13, 14)),
            *("FAULT-07", "HOME-04"),
            *("LIM-05", "LIM-08", *_LED, "LEAD-05", "STOP-05", "STOP-09", "LOW-02", "SYNC-05"),
            *_OF_CIA402,
            *("SHARE-08", "HOME-01", "HOME-03", "LOST-08", "LOW-06", "SYNC-19"),
            *("LOST-11", "PAR-02", "HOME-05", "FIT-02", *_OF_CAN, *_OF_CAN_DRIVE, *_OF_CANOPEN),
        }
    ),
    "leadshine": _POLLED - _OF_RESTARTS | {"FIT-01", "FIT-02", "LIM-09"},
    "mit": _STREAMED | {"FAULT-07", "FIT-02"},
    "moteus": frozenset(
        {
            *("SET-04", "SET-07", "SET-10", "TRAJ-06", "SET-14"),  # no torque or current
            *(*_OF_ONE_KIND, "TRAJ-15", "LOW-10"),
            *("TRAJ-04", "TRAJ-07", "TRAJ-09", "TRAJ-10", "TRAJ-11", "TRAJ-12"),  # no functions
            *("TRAJ-14", "FAULT-07", "FIT-02"),
            *(*_LED, "LEAD-05", *_OF_CIA402, "LIM-05", "LOST-08", "SYNC-19"),  # likewise
            *("HEAR-05", "LOW-04", "SHARE-02", "PROC-14"),
            *("SYNC-06", "SYNC-11", "LOW-06", "PAR-02", *_OF_CANOPEN),
        }
    ),
    "oriental_az": _POLLED - _OF_RESTARTS | {"FIT-01", "FIT-02", *_OF_CIA402},
    "rmd": _SAMPLED - {"LOW-03", "LOST-07"} | {"FIT-01", "FIT-02", "OPT-04"},
    "robstride": _STREAMED | {"FIT-01", "FIT-02"},
    "software": frozenset(
        {
            *("HEAR-05", "LOW-04", "LOW-06", "LOW-08", "LOW-09", "MEAS-02", "OTHER-01", "PAR-01"),
            *("OPT-07", "SET-14", "LOW-13", "OTHER-02"),
            *("PROC-14", "SET-05", "SYNC-05", "SYNC-20", "SYNC-22", "SYNC-23"),  # on one node
            *("PROC-15", "PROC-16"),  # its program holds a motor at rest by commands
            *("FAULT-09", "MEAS-06", "API-05"),
        }
    ),
    "vesc": _SAMPLED - {"LOW-03", "LOST-07"} | {"FIT-02"},
}


_WHOLE = "cia402"
_STRIDE = 6


def is_daily(kind, clause):
    """Return whether `make test` tries this clause on this kind."""
    if kind == _WHOLE or clause in NOT_APPLICABLE[_WHOLE]:  # so that another kind tries it
        return True
    return (KINDS.index(kind) + list(CLAUSES).index(clause)) % _STRIDE == 0


def pair(kind, clause):
    """Return a parameter; `make nightly` tries what `make test` leaves out."""
    return pytest.param(kind, clause, marks=() if is_daily(kind, clause) else pytest.mark.nightly)


@pytest.mark.parametrize("kind", KINDS)
def test_no_claim_is_lost(kind):
    lost = {
        name
        for name, clause in CLAUSES.items()
        if any(claims(kind).why_not(capability) for capability in clause.needs)
    }
    assert lost <= NOT_APPLICABLE[kind]


def test_every_clause_that_applies_is_tried_daily():
    daily = {clause: [kind for kind in KINDS if is_daily(kind, clause)] for clause in CLAUSES}
    assert min(map(len, daily.values())) >= len(KINDS) // _STRIDE
    for clause, tried in daily.items():
        applies = [kind for kind in KINDS if clause not in NOT_APPLICABLE[kind]]
        assert not applies or set(applies) & set(tried), clause


@pytest.mark.parametrize(
    ("kind", "clause"), [pair(kind, clause) for kind in KINDS for clause in CLAUSES]
)
def test_built_in_adaptation_passes_clause(kind, clause):
    verdict = run_clause(CLAUSES[clause], opener(kind), claims(kind))
    wanted = Result.NOT_APPLICABLE if clause in NOT_APPLICABLE[kind] else Result.PASSED
    assert verdict.result is wanted, f"{verdict.seen} ({verdict.place})"


def test_every_capability_and_ability_is_used_by_a_clause():
    needed = {one for clause in CLAUSES.values() for one in (*clause.needs, *clause.bench)}
    folder = Path(motorhil.harness.conformance.clauses.__file__).parent
    named = {  # where a clause itself tests each mode
        match
        for file in folder.rglob("*.py")
        for match in re.findall(r"(?:Capability|Ability)\.([A-Z_]+)", file.read_text())
    }
    for one in (*Capability, *Ability):
        assert one in needed or one.name in named, one
