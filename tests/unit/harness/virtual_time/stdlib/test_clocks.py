import datetime
import sched
import sys
import threading
import time
from contextlib import nullcontext
from types import ModuleType

import pytest

from motorhil.harness.virtual_time.runtime import WallPace
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time

UP_S = 100_000.0  # uptime of a machine when the rig is switched on
US = 1e-6


@pytest.mark.parametrize(
    ("clock", "begins_s"),
    [
        ("time", 0.0),
        ("monotonic", UP_S),
        ("perf_counter", UP_S),
        ("process_time", 0.0),
        ("thread_time", 0.0),
    ],
)
def test_clock_shows_rig_time_and_advances_at_each_look(now_s, clock, begins_s):
    time.sleep(2.5)
    told = [getattr(time, clock)() for _ in range(3)]
    told_ns = getattr(time, f"{clock}_ns")()
    first_s = begins_s + 2.5 + told[0] - told[0].__class__(told[0])
    assert told == pytest.approx([first_s, first_s + US, first_s + 2 * US], abs=3 * US)
    assert told[0] < told[1] < told[2]
    assert told_ns == pytest.approx(told[2] * 1e9 + 1e3, abs=100)
    assert now_s() == 2.5  # a few looks let no time pass


@pytest.mark.parametrize("clock", ["time", "monotonic", "perf_counter"])
@pytest.mark.parametrize(
    "wait", [lambda s: time.sleep(s), lambda s: threading.Event().wait(s)], ids=["sleep", "event"]
)
def test_wait_is_never_shorter_than_asked_by_own_clock(now_s, clock, wait):
    read = getattr(time, clock)
    for looks in (1, 2, 50):
        for seconds in (1e-6, 0.01, 100.0):
            began = [read() for _ in range(looks)][-1]
            wait(seconds)
            assert read() - began >= seconds


def test_clock_gettime_shows_rig_time(now_s):
    time.sleep(1.0)
    for number, expected_s in (
        (time.CLOCK_REALTIME, 1.0),
        (time.CLOCK_MONOTONIC, UP_S + 1.0),
        (time.CLOCK_BOOTTIME, UP_S + 1.0),
        (time.CLOCK_THREAD_CPUTIME_ID, 1.0),
    ):
        assert time.clock_gettime(number) == pytest.approx(expected_s, abs=20 * US)
        assert time.clock_gettime_ns(number) == pytest.approx(expected_s * 1e9, abs=20_000)


def test_dates_are_those_of_the_rig(now_s):
    time.sleep(86_400.0)
    assert datetime.datetime.now(datetime.UTC).isoformat()[:19] == "1970-01-02T00:00:00"
    assert abs(datetime.datetime.now() - datetime.datetime.fromtimestamp(86_400)).seconds == 0  # noqa: DTZ005, DTZ006 -- both local
    assert datetime.date.today() == datetime.date.fromtimestamp(86_400)  # noqa: DTZ011, DTZ012 -- both local
    assert time.gmtime().tm_mday == 2
    assert time.strftime("%Y") == "1970"
    assert time.gmtime(0).tm_mday == 1
    assert time.strftime("%Y", time.gmtime(1e9)) == "2001"


def test_isinstance_of_dates_is_preserved(now_s):
    made = datetime.datetime(2001, 2, 3, tzinfo=datetime.UTC)
    assert type(made) is type(made + datetime.timedelta(1)) is datetime.datetime.original
    assert isinstance(made, datetime.datetime)
    assert isinstance(made, datetime.date)
    assert not isinstance(datetime.date(2001, 2, 3), datetime.datetime)
    assert issubclass(datetime.datetime, datetime.date)

    class Own(datetime.datetime):
        pass

    own = Own(2001, 2, 3, tzinfo=datetime.UTC)
    assert type(own) is Own
    assert isinstance(own, datetime.datetime)
    assert not isinstance(made, Own)


def test_clock_polling_makes_progress_and_others_run(now_s, capsys):
    said = []

    def other():
        while True:
            time.sleep(0.01)
            said.append(now_s())

    threading.Thread(target=other, daemon=True).start()
    start_s, looks = time.monotonic(), 0
    while time.monotonic() < start_s + 0.3:
        looks += 1
    assert now_s() == pytest.approx(0.3, abs=0.002)
    assert len(said) == 30
    assert looks < 100_000
    assert not capsys.readouterr().err
    while time.monotonic() < start_s + 1.5:
        pass
    told = capsys.readouterr().err
    assert told.startswith("main (")
    assert told.count("\n") == 1
    assert "test_clocks.py:" in told
    assert "add a time.sleep()" in told


def test_polling_of_events_and_locks_makes_progress(now_s):
    flag = threading.Event()
    threading.Timer(0.002, flag.set).start()
    while not flag.is_set():
        time.sleep(0)
    assert now_s() == pytest.approx(0.002, abs=0.001)
    flag.clear()
    threading.Timer(0.01, flag.set).start()
    while not flag.is_set():
        pass
    assert now_s() == pytest.approx(0.012, abs=0.002)
    lock = threading.Lock()
    lock.acquire()
    threading.Timer(0.01, lock.release).start()
    while not lock.acquire(blocking=False):
        pass
    assert now_s() == pytest.approx(0.022, abs=0.003)
    with pytest.raises(ValueError, match="non-negative"):
        time.sleep(-1)


def test_scheduler_uses_rig_time(now_s):
    ran = []
    plan = sched.scheduler()
    for delay_s in (3.0, 1.0):
        plan.enter(delay_s, 1, lambda: ran.append(round(now_s(), 4)))
    plan.run()
    assert ran == [1.0, 3.0]


def test_bound_names_are_replaced_except_in_own_packages(rig, monkeypatch):
    library, own = ModuleType("somebodys_library"), ModuleType("motorhil.motorapi.somewhere")
    for module in (library, own):
        exec("import time\nfrom time import monotonic\n", vars(module))
        exec("def both():\n    return monotonic(), time.monotonic()\n", vars(module))
        monkeypatch.setitem(sys.modules, module.__name__, module)
    wall = library.monotonic
    with in_virtual_time(rig):
        assert library.both() == pytest.approx((UP_S, UP_S), abs=20 * US)
        assert own.monotonic is wall
        assert abs(own.both()[1] - UP_S) > 1.0
        late = ModuleType("imported_meanwhile")
        exec("from time import monotonic", vars(late))
        monkeypatch.setitem(sys.modules, late.__name__, late)
        pace = WallPace()
        pace(0)
        pace(1)
        assert pace.late_ns_max < 10**9  # it uses the wall clock, while the rig's shows 28 h
    assert library.monotonic is late.monotonic is wall


def everything_bound():
    names = (
        "time",
        "threading",
        "_thread",
        "queue",
        "select",
        "selectors",
        "socket",
        "os",
        "sched",
    )
    modules = [sys.modules[name] for name in (*names, "datetime", "signal", "functools", "logging")]
    kinds = [threading.Thread, threading.Event, sys.modules["socket"].socket]
    kinds += [kind for kind in vars(sys.modules["selectors"]).values() if isinstance(kind, type)]
    found = {(place.__name__, k): v for place in modules + kinds for k, v in vars(place).items()}
    return found, sched.scheduler.__init__.__defaults__


def test_everything_is_restored_even_after_an_error(rig):
    import random

    chance = random.getstate()
    before, defaults = everything_bound()
    for error in (None, ZeroDivisionError, KeyboardInterrupt, SystemExit):
        with nullcontext() if error is None else pytest.raises(error), in_virtual_time(rig):
            meanwhile, _ = everything_bound()
            random.random()
            if error is not None:
                raise error
        changed = [key for key in before if meanwhile[key] is not before[key]]
        assert len(changed) > 40
        after, defaults_after = everything_bound()
        assert [key for key in before if after[key] is not before[key]] == []
        assert after.keys() == before.keys()
        assert defaults_after == defaults
        assert random.getstate() == chance
