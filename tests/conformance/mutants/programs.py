"""Mistakes with motors that programs share by a lock."""

from contextlib import contextmanager

from motorhil.motorapi.ownership.claim import AcquirePolicy, Claim, OwnershipKeepAlive
from motorhil.motorapi.ownership.fencing import BoundFence
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.ownership.queue import FifoQueue
from tests.conformance.mutants import mutant, replaced


@mutant("ideal", "PROC-01")
def released_at_the_first_reason():
    """A motor is free for other programs when the first of several reasons has ended."""

    def wrong(give):
        def given(ownership, claim):
            claim.reasons = min(claim.reasons, 1)
            give(ownership, claim)

        return given

    with replaced(Ownership, "give", wrong):
        yield


@mutant("ideal", "PROC-02")
def a_loss_that_ends_no_motion():
    """After a takeover by another program, the motion of the former owner goes on."""
    with replaced(Ownership, "note_loss", lambda _: lambda ownership, claim: None):
        yield


@mutant("ideal", "PROC-03")
def an_inner_lease_that_stays():
    """The lease of an inner reservation replaces that of the outer one for good."""

    def wrong(set_lease):
        def once(claim, lease_s):
            if claim.lease_s is None or lease_s < claim.lease_s:
                set_lease(claim, lease_s)

        return once

    with replaced(Claim, "set_lease", wrong):
        yield


@mutant("ideal", "PROC-04")
def a_stream_that_outlives_its_ownership():
    """Frames of a stream pass under a later ownership of the same program, too."""

    def wrong(_):
        def send(bound, frame):
            bound._fence.send(frame)

        return send

    with replaced(BoundFence, "send", wrong):
        yield


@mutant("ideal", "PROC-05")
def a_motion_that_is_not_looked_at():
    """A motor that is kept for a motion stays so when the motion has ended."""
    with replaced(OwnershipKeepAlive, "look", lambda _: lambda keeper: None):
        yield


@mutant("ideal", "PROC-06")
def turns_within_one_program():
    """A turn that is taken at once does not ask other programs."""

    def wrong(_):
        @contextmanager
        def at_once(queue, runtime, who):
            yield not queue._queue

        return at_once

    with replaced(FifoQueue, "at_once", wrong):
        yield


@mutant("ideal", "PROC-07")
def a_wait_without_an_end():
    """A request that waits ends its wait twice as late as it was told to."""

    def wrong(until):
        def patient(policy, runtime, done, timeout_s, *further, **named):
            return until(policy, runtime, done, 2.0 * timeout_s, *further, **named)

        return patient

    with replaced(AcquirePolicy, "until", wrong):
        yield
