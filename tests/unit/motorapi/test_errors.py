import pickle

import pytest

from motorhil import motorapi
from motorhil.motorapi import errors

TOLD = [
    (
        errors.LimitError,
        {
            "motor": "left",
            "quantity": "velocity",
            "value": 7.0,
            "low": -6.0,
            "high": 6.0,
            "unit": "rad/s",
        },
    ),
    (
        errors.StateError,
        {"motor": "left", "operation": "start", "state": "it moves", "remedy": "stop() first"},
    ),
    (errors.UnsupportedError, {"motor": "left", "feature": "torque", "supported": "position"}),
    (
        errors.FileError,
        {
            "path": "m.toml",
            "line": 3,
            "key": "velocity",
            "problem": "unknown",
            "remedy": "leave it",
        },
    ),
    (
        errors.MotorBusyError,
        {"motor": "left", "holder": "start() of other", "since_ns": 1_500_000_000},
    ),
    (errors.MotionInterrupted, {"motor": "left", "by": "stop() of other", "at_ns": 2_000_000_000}),
    (errors.DeviceFault, {"motor": "left", "code": 0x7500, "text": "communication", "since_ns": 5}),
    (errors.LinkError, {"link": "can0", "reason": "bus off", "since_ns": 9}),
    (
        errors.DeadlineExceeded,
        {"awaited": "end of motion of left", "timeout_s": 2.0, "last_heard": "nothing"},
    ),
    (errors.PluginError, {"plugin": "MyMotor", "where": "_arm", "problem": "KeyError('x')"}),
    (errors.DomainError, {"argument": 7.5, "low": 0.0, "high": 5.0, "function": "<Profile>"}),
    (
        errors.MotorBusyError,
        {
            "motor": "left",
            "holder": "pid 7 (drive.py)",
            "since_ns": 1,
            "purpose": "driving",
            "process": (7, "drive.py"),
            "since": "noon",
        },
    ),
]
EXAMPLES = [kind(**facts) for kind, facts in TOLD]


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda error: type(error).__name__)
def test_every_error_is_in_the_tree_and_pickles(error):
    assert isinstance(error, errors.MotorError)
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert copy.__dict__ == error.__dict__ != {}


@pytest.mark.parametrize(("kind", "facts"), TOLD, ids=lambda one: getattr(one, "__name__", ""))
def test_error_attributes_hold_the_arguments(kind, facts):
    error = kind(**facts)
    assert {name: getattr(error, name) for name in facts} == facts


def test_usage_errors_are_a_separate_branch():
    usage = {
        errors.LimitError,
        errors.DomainError,
        errors.StateError,
        errors.UnsupportedError,
        errors.FileError,
    }
    for error in EXAMPLES:
        assert isinstance(error, errors.UsageError) == (type(error) in usage)


def test_messages_hold_value_limit_unit_and_motor():
    assert str(EXAMPLES[0]) == "left: velocity 7 rad/s, allowed is -6 to 6 rad/s"
    one_sided = errors.LimitError(
        motor="x", quantity="duration", value=1.0, low=2.0, high=None, unit="s", reason="for 3 rad"
    )
    assert str(one_sided) == "x: duration 1 s, allowed is at least 2 s (for 3 rad)"
    close = errors.LimitError(
        motor="x", quantity="position", value=5.3100001, low=None, high=5.31, unit="rad"
    )
    assert str(close) == "x: position 5.3100001 rad, allowed is at most 5.31 rad"
    assert "m.toml:3: velocity: unknown; leave it" in str(EXAMPLES[3])
    assert "7500h" in str(EXAMPLES[6])
    assert "reset_fault()" in str(EXAMPLES[6])


def test_module_docstring_lists_every_error():
    shown = errors.__doc__ or ""
    for name, thing in vars(errors).items():
        if isinstance(thing, type) and issubclass(thing, errors.MotorError):
            assert name in shown
            assert name in motorapi.__all__
