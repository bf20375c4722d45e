"""Issue 9, item 5: `make demo` without a working compiler."""

import pytest

from tests.support.building import clone, demo, make

pytestmark = [
    pytest.mark.compiled,
    pytest.mark.pure("the demo of the sources is compared"),
]


def test_demo_without_a_compiler_is_pure_and_says_so(tmp_path):
    printed = demo(clone(tmp_path, "motorhil"), CC="/no/such/cc")
    assert "seconds per second, pure Python cores" in printed
    assert "pure Python cores: no C compiler here (/no/such/cc)" in printed


def test_uncompilable_module_is_named_and_the_demo_is_pure(tmp_path):
    """Check it with a new module: the hot folders include it."""
    folder = clone(tmp_path)
    bad = folder / "motorhil" / "emulators" / "plant" / "new.py"
    bad.parent.mkdir(parents=True)
    for place in (bad.parent, *list(bad.parents)[1:3]):
        (place / "__init__.py").touch()
    bad.write_text("class Outer:\n    class Inner:\n        pass\n")
    printed = demo(folder)
    assert "emulators/plant/new.py:2: error: " in printed
    assert "Traceback" not in printed
    assert printed.count("seconds per second, pure Python cores") == 1
    again = demo(folder)
    assert "could not be built" in again
    assert "new.py" not in again  # the build is not tried again


def test_dry_run_marks_nothing_as_built(tmp_path):
    """Make executes each line that names MAKE, even then."""
    folder = clone(tmp_path, "motorhil")
    (folder / ".venv-compiled").mkdir()
    status, printed = make("--dry-run", "compiled", folder=folder)
    assert status == 0, printed
    assert list((folder / ".venv-compiled").iterdir()) == []
