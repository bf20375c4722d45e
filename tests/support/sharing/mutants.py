"""Planted defects of motor sharing, which the shipped suites must detect.

Defects for one process are context managers. Defects for several processes are functions that a
worker of `motorhil.harness.sharing_tests.processes` calls in its own process before it begins
(`Plan.plant`).
"""

import os
from collections import deque
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from motorhil.motorapi import execution
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.cia402.motion import DriveMotions
from motorhil.motorapi.locking.lock_file import LockFile, first_token
from motorhil.motorapi.locking.process_lock import LockHandle
from motorhil.motorapi.ownership.ownership import Ownership, WaitQueue

RAMPS = (0x6081, 0x6083, 0x6084)


# ---- in one process


@contextmanager
def a_lock_without_fifo():
    """Serve the last request first."""

    class Pile(deque):
        append = deque.appendleft

    make = WaitQueue.__init__

    def made(row, *args):
        make(row, *args)
        row._places = Pile()

    with patch.object(WaitQueue, "__init__", made):
        yield


@contextmanager
def no_fencing():
    """Let an owner that has lost the motor continue to command it."""
    again = Ownership._again

    def as_if(ownership, owner, afresh):
        for claim in ownership._lost:
            if claim.owner is owner and not afresh:
                claim.reasons += 1
                return claim
        return again(ownership, owner, afresh)

    with (
        patch.object(Ownership, "_again", as_if),
        patch.object(Ownership, "require", lambda *_: None),
    ):
        yield


@contextmanager
def a_group_that_starts_before_all_are_armed():
    """Fire each motor as soon as it is armed."""

    class Fired:
        def fire(self):
            pass

    def hasty(started, seen):
        for one in started:
            one.motor.hooks.arm(one.motion, together=False).fire()
        return [Fired()]

    with patch.object(execution, "_arm", hasty):
        yield


@contextmanager
def a_start_that_pushes_settings_after_starting():
    """Send velocity and ramps of a motion only after its start."""
    late = []
    arm, confirm, push = DriveMotions.arm, DriveMotions.confirm, ObjectAccess.push

    def pushing(objects, index, value, *args, **kwargs):
        if late is not None and index in RAMPS and pushing.arming:
            late.append((objects, index, value))
        else:
            push(objects, index, value, *args, **kwargs)

    def arming(motions, motion, *, together):
        pushing.arming = True
        try:
            return arm(motions, motion, together=together)
        finally:
            pushing.arming = False

    def confirming(motions, motion):
        confirm(motions, motion)
        while late:
            push(*late.pop(0))

    pushing.arming = False
    with (
        patch.object(DriveMotions, "arm", arming),
        patch.object(DriveMotions, "confirm", confirming),
        patch.object(ObjectAccess, "push", pushing),
    ):
        yield


# ---- in several processes


def whoever_is_quickest(folder):
    """Plant a lock without FIFO order."""
    LockFile.is_first = lambda file, place: True


def no_fence(folder):
    """Let an owner that has lost the lock still write."""
    LockHandle._enter = lambda hold, asker: None


def no_token(folder):
    """Keep the token constant."""
    LockFile.token = property(lambda file: 1, lambda file, token: None)


def no_exclusion(folder):
    """Plant a lock without mutual exclusion."""
    LockFile.take = lambda file, place: True
    LockFile.tell_holder = lambda file, record, lease=b"": os.pwrite(file.fd, record, 400)


def stays_after_death(folder):
    """Plant a lock that is the existence of a file, a common mistake."""
    flag, mine = Path(folder) / "flag", set()
    let_go = LockFile.let_go

    def take_flag(file):
        try:
            os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return False
        mine.add(file.name)
        file.token = first_token()
        return True

    def drop_flag(file):
        let_go(file)
        if file.name in mine:
            mine.remove(file.name)
            flag.unlink()

    LockFile.take_at_once = take_flag
    LockFile.take = lambda file, place: take_flag(file)
    LockFile.let_go = drop_flag
