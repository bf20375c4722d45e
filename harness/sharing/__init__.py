"""Suites that judge how motors are shared, to be run on an adaptation of your own.

**Owners in one process**, in virtual time: nothing sleeps, the same choices make the same run, and
Hypothesis shrinks what fails (`pip install 'motorhil[test]'`). Of every motor three owners::

    from harness.sharing.machine import group_machine, ownership_machine
    from harness.sharing.stage import Course, shared_rig

    course = Course(distance=0.05, duration_s=0.3, window=0.004, tolerance_s=0.06)
    TestOwners = ownership_machine(shared_rig("my_rig.toml"), course).TestCase
    TestGroups = group_machine(shared_rig("my_rig.toml"), course).TestCase

run by pytest or by unittest; without either, `TestOwners().runTest()`. They start, reserve, lease,
take over, stop, kill and wait at instants of Hypothesis' choice. How often each thing happened is
in `reach` of the machine's class, and in `pytest --hypothesis-show-statistics`: look there first,
for what never happened was not tested.

**Relative moves whose replies are lost**: `harness.sharing.at_most_once`.

**Real processes**, killed by SIGKILL and paused by SIGSTOP, on a hub (`motorhil serve RIG --socket
PATH -o run.mcap`) or on SocketCAN; no pytest, no Hypothesis::

    from harness.sharing.evidence import read_evidence
    from harness.sharing.processes import Plan, run

    facts = {"channel": "PATH", "model": "my_model.toml", "node_ids": [1], "lease_s": 0.2}
    plan = Plan("harness.sharing.drivers:work_motor", seconds=10.0, kill_period_s=1.0, facts=facts)
    outcome = run(plan)                    # {"make": "my_module:motors"}: for motors of your own
    print(outcome.table())                 # how often what was reached
    outcome.require_sound()                # the history: linearizable, in order, tokens grow
    read_evidence("run.mcap", {"left": ("can0", 1)}).require_sound()   # the bus says so too

All of them raise `harness.sharing.history.SharingViolated`, an AssertionError, which names the uses
or frames that do not fit. `history` and `linearizability` are the judge, and serve for histories of
whatever origin.
"""
