"""Mutants made by rule: each rule on a small source, loading, and a slice with known verdicts."""

import ast
import os
import subprocess
import sys
import textwrap

import pytest

from tests.conformance.mutants.by_rule.classified import read
from tests.conformance.mutants.by_rule.execution import Execution, Run, before_benches
from tests.conformance.mutants.by_rule.loading import instrumented, mutated
from tests.conformance.mutants.by_rule.rules import edits
from tests.conformance.mutants.by_rule.sources import Mutant, files, functions, mutants_in, sample
from tests.support.checkout import CHECKOUT


def edits_of(text):
    return list(edits(ast.parse(textwrap.dedent(text))))


def changes_of(text, rule):
    """Return the changes that a rule makes in a function with this body."""
    body = textwrap.indent(textwrap.dedent(text), "    ")
    return [one.change() for one in edits_of(f"def f():\n{body}") if one.rule == rule]


@pytest.mark.parametrize(
    ("rule", "text", "wanted"),
    [
        ("operator", "x = a + b", ["a + b -> a - b"]),
        ("operator", "x -= a * b", ["x -= a * b -> x += a * b", "a * b -> a / b"]),
        ("operator", "x = a / b", ["a / b -> a * b"]),
        ("operator", "x = a and b", ["a and b -> a or b"]),
        ("operator", "x = a or b", ["a or b -> a and b"]),
        ("operator", "x = not a", ["x = not a -> x = a"]),
        ("operator", "x = 'text' + a", []),
        ("comparison", "x = a < b <= c", ["a < b <= c -> a <= b <= c", "a < b <= c -> a < b < c"]),
        ("comparison", "x = a > b", ["a > b -> a >= b"]),
        ("comparison", "x = a == b", ["a == b -> a != b"]),
        ("comparison", "x = a is not None", ["a is not None -> a is None"]),
        ("comparison", "x = a in b", ["a in b -> a not in b"]),
        ("constant", "x = 0", ["x = 0 -> x = 1"]),
        ("constant", "x = a - 1", ["a - 1 -> a - 0"]),
        ("constant", "x = -a", ["x = -a -> x = a"]),
        ("constant", "x = 8", ["x = 8 -> x = 7", "x = 8 -> x = 9", "x = 8 -> x = 16"]),
        ("constant", "x = 2.0", ["x = 2.0 -> x = 4.0", "x = 2.0 -> x = -2.0"]),
        ("constant", "x = True", ["x = True -> x = False"]),
        ("constant", "x: Array[3] = f'{a:08X}'", []),
        ("constant", "g = lambda b=0: b", ["b=0 -> b=1"]),
        ("dropped call", "a.send(1)", ["a.send(1) -> ..."]),
        ("dropped call", "x = a.send(1)", []),
        ("dropped raise", "raise Fault(a)", ["raise Fault(a) -> ..."]),
        ("dropped return", "if a:\n    return 5\nreturn 6", ["return 5 -> ..."]),
        ("swapped arguments", "x = f(a, b.c)", ["f(a, b.c) -> f(b.c, a)"]),
        ("swapped arguments", "x = f(1, 2)", ["f(1, 2) -> f(2, 1)"]),
        ("swapped arguments", "x = f(a, 1)", []),
        ("negated condition", "if a < b:\n    c()", ["if a < b -> if not a < b"]),
        ("negated condition", "while a:\n    c()", ["while a -> while not a"]),
        ("negated condition", "x = b if a else c", ["b if a else c -> b if not a else c"]),
    ],
)
def test_rule_makes_its_changes_and_no_others(rule, text, wanted):
    assert changes_of(text, rule) == wanted


def test_missing_await_is_a_change():
    (edit,) = (one for one in edits_of("async def f():\n    x = await a") if "await" in one.rule)
    assert edit.change() == "x = await a -> x = a"


def test_unit_factor_is_taken_for_another_one():
    assert "a * 1000000000.0 -> a * 1000000.0" in changes_of("x = a * 1e9", "constant")


def test_long_change_shows_the_difference():
    names = ", ".join(f"argument_{number}" for number in range(20))
    (change,) = changes_of(f"x = f({names}, 0)", "constant")
    shared = "...ument_17, argument_18, argument_19, "
    assert change == f"{shared}0) -> {shared}1)"


def test_change_outside_a_function_is_in_its_class():
    assert {
        one.scope for one in edits_of("A = 1\nclass B:\n    C = 1\n    def d(s): return 1")
    } == {*("<module>", "B", "B.d")}


def test_sample_has_different_functions_and_depends_on_its_seed():
    first = sample(1, 50)
    assert len({one.function for one in first}) == 50
    assert first == sample(1, 50)
    assert first != sample(2, 50)


def test_every_sampled_mutant_differs_from_its_source_and_compiles():
    for one in sample(3, 40):
        tree = mutated(one)
        assert ast.dump(tree) != ast.dump(ast.parse((CHECKOUT / one.file).read_text()))
        compile(tree, one.file, "exec")


def test_every_instrumented_source_compiles():
    for file in files():
        compile(instrumented(file), file, "exec")


def test_mutant_of_a_changed_source_is_refused():
    (one, *_) = mutants_in(*functions()[0])
    with pytest.raises(LookupError, match="not in the source any more"):
        mutated(type(one)(**{**{k: getattr(one, k) for k in one.__slots__}, "number": 10**6}))


def run_of(bench):
    return Run(bench, "STOP-03", 1.0, "passed", {"a.py": 0b01})


def mutant_in(statement, change="1 -> 2"):
    return Mutant("a.py", "f", change, "constant", 1, 0, statement, True)


def test_plan_takes_clauses_of_both_kits_with_one_id():
    execution = Execution([run_of(one) for one in ("drive: a", "drive: b", "cia402")], {}, [])
    for number in range(10):
        plan = execution.plan(mutant_in(0, f"1 -> {number}"), 2.0)
        assert sorted(one.bench[:5] for one in plan) == ["cia40", "drive"]


def test_plan_of_early_statement_takes_users_of_the_module():
    execution = Execution([run_of("cia402")], {"a.py": 0b10}, [])
    assert execution.plan(mutant_in(1), 10.0) == execution.runs
    assert not execution.plan(mutant_in(2), 10.0)


def test_classified_survivors_are_readable():
    for reason in read().values():
        assert reason.reason, reason


@pytest.mark.pure("a compiled function cannot be replaced; the pure cores have the same text")
@pytest.mark.parametrize("stride", [12, pytest.param(1, marks=pytest.mark.nightly)])
def test_mutants_have_their_known_verdicts(stride):
    words = ("-m", "tests.conformance.mutants.by_rule", "--known", str(stride))
    result = subprocess.run(
        [sys.executable, *words],
        cwd=CHECKOUT,
        env={**os.environ, "MOTORHIL_PURE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"


FORKED = """
from tests.conformance.mutants.by_rule.children import answers, limit

def busy(tell):
    limit(0.05, 10.0)
    tell(1)
    while True:
        pass

def waiting(tell):
    limit(10.0, 0.05)
    import time
    while True:
        time.sleep(1.0)

def failing(tell):
    raise ValueError("no")

print(list(answers(busy)), list(answers(waiting)), [one["raised"] for one in answers(failing)])
"""


def test_child_that_hangs_or_fails_is_told():
    result = subprocess.run(
        [sys.executable, "-c", FORKED], cwd=CHECKOUT, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[1, None] [None] ['ValueError: no']"


AFRESH = """
import gc
from pathlib import Path
from tests.conformance.drives.rigs import _eds
from tests.conformance.mutants.by_rule.children import answers
from tests.conformance.mutants.by_rule.loading import import_afresh

path = Path(_eds("more"))
del _eds

def afresh(tell):
    import_afresh({})
    import tests.conformance.drives.rigs
    gc.unfreeze()
    gc.collect()

print(list(answers(afresh)), path.exists())
"""


def test_child_that_imports_afresh_leaves_files_of_its_parent():
    result = subprocess.run(
        [sys.executable, "-c", AFRESH], cwd=CHECKOUT, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[] True"


def test_early_statements_are_known_without_measuring():
    found = before_benches("ideal")
    assert found["motorapi/model.py"]
    assert found["motorapi/adaptations/cia402/bringup.py"]  # imported with its bench, else
    assert all(file.startswith(("motorapi/", "emulators/")) for file in found)
