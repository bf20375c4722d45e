"""Changed sources in this process: imported afresh, or put in place of one function.

No file is written. A process must load one change only, and end with it: fork it.
"""

import ast
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import _lru_cache_wrapper
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, FunctionType, ModuleType
from typing import Final

from tests.conformance.mutants.by_rule import benches
from tests.conformance.mutants.by_rule.rules import edits
from tests.conformance.mutants.by_rule.sources import Mutant, files, module_of, parsed, statements

HITS = "__hits__"
"""The name of the array of executed statements in each instrumented module."""

Change = Callable[[str], ast.Module]

_FORGOTTEN: Final[list[ModuleType]] = []
"""Modules that were imported again. Their temporary files are also those of the parent process."""


def mutated(mutant: Mutant) -> ast.Module:
    """Return the syntax tree of the mutant's source, changed.

    Raises:
        LookupError: the source has changed since, and no longer has this mutant.
    """
    tree = parsed(mutant.file)
    edit = next((one for n, one in enumerate(edits(tree)) if n == mutant.number), None)
    if edit is None or edit.scope != mutant.scope:
        raise LookupError(f"{mutant.function}: {mutant.change}: not in the source any more")
    edit.apply()
    return ast.fix_missing_locations(tree)


def load(mutant: Mutant, *, afresh: bool) -> None:
    """Load a mutant: replace its function in this process, or import everything again."""
    tree = mutated(mutant)
    if afresh or not _replaced(mutant, tree):
        import_afresh({mutant.file: lambda _: tree})


def _replaced(mutant: Mutant, tree: ast.Module) -> bool:
    """Replace the code of the mutant's function, wherever it is; return whether that was done."""
    module = sys.modules.get(module_of(mutant.file))
    if module is None or not mutant.is_in_function:
        return False
    file = str(module.__file__)
    wanted = {
        (one.co_qualname, one.co_firstlineno): one
        for one in _codes(compile(tree, file, "exec"))
        if _is_within(one.co_qualname, mutant.scope)
    }
    gc.unfreeze()  # frozen objects would not be found
    found = [
        one
        for one in gc.get_objects()
        if type(one) is FunctionType and _is_of(one.__code__, file, mutant.scope)
    ]
    pairs = [
        (one, wanted.get((one.__code__.co_qualname, one.__code__.co_firstlineno))) for one in found
    ]
    if not pairs or any(
        code is None or len(code.co_freevars) != len(one.__code__.co_freevars)
        for one, code in pairs
    ):
        return False
    for one, code in pairs:
        one.__code__ = code
    return True


def _is_of(code: CodeType, file: str, scope: str) -> bool:
    return _is_within(code.co_qualname, scope) and code.co_filename == file


def _is_within(name: str, scope: str) -> bool:
    """Return whether this is the scope, or a function that it has made, maybe long before."""
    return name == scope or name.startswith(f"{scope}.<locals>.")


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _codes(one)


def forget_results() -> None:
    """Clear the caches of functions that mutants may change."""
    modules = set(map(module_of, files()))
    for one in gc.get_objects():
        if type(one) is _lru_cache_wrapper and one.__module__ in modules:
            one.cache_clear()


class _Loader(SourceFileLoader):
    """Loads a module from a syntax tree."""

    def __init__(self, name: str, path: str, tree: ast.Module, hits: int) -> None:
        super().__init__(name, path)
        self._tree = tree
        self._hits = hits

    def get_code(self, fullname: str) -> CodeType:
        """Return the code of the tree."""
        return compile(self._tree, self.path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its array of executed statements, and execute it."""
        vars(module)[HITS] = bytearray(self._hits)
        super().exec_module(module)


class _Finder(MetaPathFinder):
    """Finds the changed modules before all others."""

    def __init__(self, changes: dict[str, Change]) -> None:
        self._changes = {module_of(file): (file, change) for file, change in changes.items()}

    def find_spec(self, fullname, path=None, target=None) -> ModuleSpec | None:
        """Return the spec of a changed module, or None."""
        if fullname not in self._changes:
            return None
        file, change = self._changes[fullname]
        spec = PathFinder.find_spec(fullname, path, target)
        assert spec is not None, fullname
        assert spec.origin is not None, fullname
        tree = change(file)
        spec.loader = _Loader(fullname, spec.origin, tree, len(statements(tree)))
        return spec


def import_afresh(changes: dict[str, Change]) -> None:
    """Forget the packages of this project, and import these sources changed from now on."""
    own = ("motorhil", "motorhil_odrive")
    names = [name for name in sys.modules if name.partition(".")[0] in own]
    names += [name for name in sys.modules if name.startswith(("tests.support", "tests.conf"))]
    for name in names:
        if not name.startswith("tests.conformance.mutants"):
            _FORGOTTEN.append(sys.modules.pop(name))
    benches.forget()
    sys.meta_path.insert(0, _Finder(changes))


def import_instrumented() -> None:
    """Import all sources of mutants so that they note which statements are executed."""
    import_afresh(dict.fromkeys(files(), instrumented))


def import_all() -> None:
    """Import all sources that can be imported, as benches import some only when they are opened."""
    for file in files():
        with suppress(ImportError):
            import_module(module_of(file))


def instrumented(file: str) -> ast.Module:
    """Return the syntax tree of a source whose functions note each statement they begin."""
    tree = parsed(file)
    numbers = statements(tree)
    _instrument(tree, numbers, in_function=False)
    return ast.fix_missing_locations(tree)


def _instrument(node: ast.AST, numbers: dict[ast.stmt, int], *, in_function: bool) -> None:
    for name, value in ast.iter_fields(node):
        if not isinstance(value, list) or not value:
            continue
        for child in value:
            if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
                inside = in_function or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
                _instrument(child, numbers, in_function=inside)
        if in_function and isinstance(value[0], ast.stmt):
            noted = []
            for child in value:
                is_text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
                if not is_text:  # a docstring stays the first statement
                    noted.append(_note(numbers[child], child))
                noted.append(child)
            setattr(node, name, noted)


def _note(number: int, at: ast.stmt) -> ast.stmt:
    array = ast.Name(HITS, ast.Load())
    target = ast.Subscript(array, ast.Constant(number), ast.Store())
    return ast.copy_location(ast.Assign([target], ast.Constant(1)), at)


def hits(*, clear: bool) -> dict[str, int]:
    """Return the executed statements of each source, as the bits of an integer."""
    found = {}
    for file in files():
        array = vars(sys.modules.get(module_of(file), object)).get(HITS)
        if array:
            bits = int("".join("01"[one] for one in reversed(array)), 2)
            if bits:
                found[file] = bits
            if clear:
                array[:] = bytes(len(array))
    return found
