from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.simulation.event_queue import EventQueue


def test_events_of_one_time_run_in_the_order_of_asking():
    queue = EventQueue()
    log = []
    alarms = [queue.alarm(lambda now, n=n: log.append((now, n))) for n in range(4)]
    for n in (2, 0, 3, 1):
        alarms[n].set(10)
    queue.run_until(10)
    assert log == [(10, 2), (10, 0), (10, 3), (10, 1)]


def test_resetting_same_time_keeps_turn():
    queue = EventQueue()
    log = []
    first = queue.alarm(lambda now: log.append("first"))
    second = queue.alarm(lambda now: log.append("second"))
    first.set(10)
    second.set(10)
    first.set(10)
    queue.run_until(10)
    assert log == ["first", "second"]
    first.set(20)
    second.set(20)
    first.set(19)
    first.set(20)
    queue.run_until(20)
    assert log == ["first", "second", "second", "first"]


def test_alarm_behind_an_earlier_one_keeps_turn():
    queue = EventQueue()
    log = []
    alarms = [queue.alarm(lambda now, name=name: log.append(name)) for name in "abc"]
    alarms[0].set(10)
    alarms[1].set(10)
    alarms[2].set(5)  # before the one that was next
    queue.run_until(10)
    assert log == ["c", "a", "b"]


def test_time_in_past_means_now():
    queue = EventQueue()
    times = []
    queue.run_until(100)
    queue.alarm(times.append).set(5)
    assert queue.next_time_ns() == 100
    queue.run_until(100)
    assert times == [100]


@given(st.lists(st.tuples(st.integers(0, 3), st.none() | st.integers(0, 20)), max_size=40))
def test_only_last_setting_of_alarm_runs(settings):
    """Compare with the simplest model: a dict of the last setting of each alarm."""
    queue = EventQueue()
    log = []
    alarms = [queue.alarm(lambda now, n=n: log.append((now, n))) for n in range(4)]
    model = {}
    for turn, (n, time_ns) in enumerate(settings):
        alarms[n].set(time_ns)
        if time_ns is None:
            model.pop(n, None)
        elif model.get(n, (None,))[0] != time_ns:
            model[n] = (time_ns, turn)
    expected = [(time, n) for (time, _), n in sorted((key, n) for n, key in model.items())]
    while queue.run_next():
        pass
    assert log == expected
    assert queue.next_time_ns() is None


STEPS = st.lists(
    st.tuples(st.integers(0, 3), st.none() | st.integers(0, 6)) | st.just("run") | st.just("look"),
    max_size=60,
)


@given(STEPS)
def test_setting_between_events_keeps_order(steps):
    """Compare with the same model, with time passing in between and alarms in the past."""
    queue = EventQueue()
    log, expected = [], []
    alarms = [queue.alarm(lambda now, n=n: log.append((now, n))) for n in range(4)]
    model = {}
    for turn, step in enumerate([*steps, *["run"] * 5]):
        nearest = min(model.items(), key=lambda item: item[1], default=None)
        if step == "look":
            assert queue.next_time_ns() == (nearest and nearest[1][0])
        elif step == "run":
            assert queue.run_next() is (nearest is not None)
            if nearest is not None:
                expected.append((nearest[1][0], nearest[0]))
                del model[nearest[0]]
        else:
            n, time_ns = step
            alarms[n].set(time_ns)
            if time_ns is None:
                model.pop(n, None)
            elif model.get(n, (None,))[0] != max(time_ns, queue.now_ns):
                model[n] = (max(time_ns, queue.now_ns), turn)
    assert log == expected
