"""Test suites for the sharing of motors, usable with any adaptation.

**Owners in one process**, in virtual time: nothing sleeps, the same choices give the same run, and
Hypothesis shrinks a failure (`pip install 'motorhil[test]'`). Each motor has three owners::

    from motorhil.harness.sharing_tests.state_machine import group_machine, ownership_machine
    from motorhil.harness.sharing_tests.state_machine import Course, shared_rig

    course = Course(distance=0.05, duration_s=0.3, window=0.004, tolerance_s=0.06)
    TestOwners = ownership_machine(shared_rig("my_rig.toml"), course).TestCase
    TestGroups = group_machine(shared_rig("my_rig.toml"), course).TestCase

Run them with pytest or unittest; without either, call `TestOwners().runTest()`. Owners start,
reserve, lease, take over, stop, kill and wait at times chosen by Hypothesis. The number of each
event is in `reach` of the machine's class, and in `pytest --hypothesis-show-statistics`. Look there
first, since an event that never happened was not tested.

**Relative moves with lost replies**: `motorhil.harness.sharing_tests.relative_moves`.

**Real processes**, killed by SIGKILL and paused by SIGSTOP, on a hub (`motorhil serve RIG --socket
PATH -o run.mcap`) or on SocketCAN; without pytest and Hypothesis::

    from motorhil.harness.sharing_tests.bus_evidence import read_evidence
    from motorhil.harness.sharing_tests.processes import Plan, run

    facts = {"channel": "PATH", "model": "my_model.toml", "node_ids": [1], "lease_s": 0.2}
    work = "motorhil.harness.sharing_tests.workers:work_motor"
    plan = Plan(work, seconds=10.0, kill_period_s=1.0, facts=facts)
    outcome = run(plan)                    # {"make": "my_module:motors"}: for your own motors
    print(outcome.table())                 # number of each event
    outcome.require_sound()                # the history: linearizable, in order, tokens grow
    read_evidence("run.mcap", {"left": ("can0", 1)}).require_sound()   # the bus agrees

All of them raise `SharingViolated`, an AssertionError that names the uses or frames in conflict.
The modules `history` and `linearizability` judge histories of any origin.
"""
