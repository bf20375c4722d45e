"""Structure of the sources: sizes of folders, functions and kinds of drives, and import cycles.

python -m tests.architecture.structure [FOLDER ...]

reports, without failing, modules above 800 code lines, modules with one importer, in their own
folder, and the size of each kind of drive; or, of a kind in the folders given, its size only.
Concepts are what an author of a kind had to learn: the distinct names that it imports from the
interfaces for extensions, and the methods of their classes that it overrides.
"""

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.support.checkout import CHECKOUT, PACKAGES, sources

MODULES_IN_A_FOLDER = 15
ONE_A_SUBJECT = (  # a verb, or a subject of measurement
    *("harness/cli", "tests/unit/harness/cli", "tests/benchmarks"),
)
CODE_LINES = 800
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}

HOST, EMULATED = CHECKOUT / "motorapi" / "adaptations", CHECKOUT / "emulators"
ODRIVE = CHECKOUT / "tests" / "conformance" / "outsider" / "src" / "motorhil_odrive"
OWN = ("mit", "moteus", "vesc", "rmd", "dryve", "dynamixel")
APIS = ("motorhil.motorapi.api", "motorhil.emulators.api")
BASES = (  # where the classes of the interfaces are
    *sorted((CHECKOUT / "motorapi" / "api").glob("*.py")),
    *(CHECKOUT / "motorapi" / name for name in ("hooks.py", "motor.py")),
    *(EMULATED / name for name in ("controller.py", "motor_drive.py")),
)
HEADS = ("kind", "files", "host", "emulated", "both", "internal imports", "names", "hooks")


def module_name(path: Path) -> str:
    """Return the dotted name under which a source file is imported."""
    parts = ["motorhil", *path.relative_to(CHECKOUT).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def wide_folders(files: Iterable[str]) -> list[str]:
    """Return the folders with too many modules, with their number."""
    modules = [Path(file) for file in files]
    counts = Counter(path.parent.as_posix() for path in modules if path.name != "__init__.py")
    return [
        f"{folder}: {count} modules; at most {MODULES_IN_A_FOLDER}"
        for folder, count in sorted(counts.items())
        if count > MODULES_IN_A_FOLDER and folder not in ONE_A_SUBJECT
    ]


def imported(text: str, known: Iterable[str]) -> set[str]:
    """Return the known modules that a module imports anywhere, also for types only."""
    modules = set(known)
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in modules else node.module)
    return found & modules


def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module imports."""
    texts = {module_name(path): path.read_text() for path in sources()}
    return {name: imported(text, texts) - {name} for name, text in texts.items()}


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import one another, in a circle (Tarjan's algorithm)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in sorted(graph.get(name, ())):
            if other not in number:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    sys.setrecursionlimit(max(sys.getrecursionlimit(), 5_000))
    for name in sorted(graph):
        if name not in number:
            visit(name)
    return sorted(found)


def code_lines(text: str) -> int:
    """Return the number of lines that are neither blank, comment nor docstring."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and ast.get_docstring(node) is not None:
                lines.difference_update(range(first.lineno, (first.end_lineno or 0) + 1))
    return len(lines)


def single_importers(graph: Mapping[str, set[str]]) -> list[str]:
    """Return the modules that only one module imports, of the same folder."""
    importers: dict[str, list[str]] = {name: [] for name in graph}
    for name, others in graph.items():
        for other in others:
            importers[other].append(name)
    return [
        f"{name} <- {of[0]}"
        for name, of in sorted(importers.items())
        if len(of) == 1 and of[0].rpartition(".")[0] == name.rpartition(".")[0]
    ]


@dataclass(frozen=True)
class Kind:
    """One kind of drive.

    Attributes:
        host, emulated: its modules on either side.
        internal: the modules of motorhil that it imports, besides the interfaces.
        names: imported from the interfaces.
        hooks: methods of their classes that it overrides.
    """

    host: tuple[Path, ...]
    emulated: tuple[Path, ...]
    internal: frozenset[str]
    names: frozenset[str]
    hooks: frozenset[str]

    def row(self) -> tuple[int, ...]:
        """Return the figures of a row of the table."""
        host, emulated = (
            sum(code_lines(path.read_text()) for path in paths)
            for paths in (self.host, self.emulated)
        )
        counts = len(self.internal), len(self.names), len(self.hooks)
        return len((*self.host, *self.emulated)), host, emulated, host + emulated, *counts


Classes = dict[str, tuple[list[str], set[str]]]
"""The names of the bases and of the own methods of each class, by its name."""


def classes(trees: Iterable[ast.Module]) -> Classes:
    """Return the classes of these modules."""
    found = {}
    for node in (one for tree in trees for one in ast.walk(tree) if isinstance(one, ast.ClassDef)):
        bases = (base.value if isinstance(base, ast.Subscript) else base for base in node.bases)
        own = {one.name for one in node.body if isinstance(one, ast.FunctionDef)}
        named = [base.id for base in bases if isinstance(base, ast.Name)]
        found[node.name] = named, {name for name in own if not name.startswith("__")}
    return found


def methods_of(name: str, known: Classes) -> set[str]:
    """Return the methods of a class and of its bases."""
    bases, own = known.get(name, ([], set()))
    return own.union(*(methods_of(base, known) for base in bases))


def inherited(name: str, own: Classes, api: Classes) -> set[str]:
    """Return the methods of the interfaces that a class of a kind gets from its bases."""
    found = (
        inherited(base, own, api) if base in own else methods_of(base, api) for base in own[name][0]
    )
    return set[str]().union(*found)


def imports(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (module, name) of each import from motorhil."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("motorhil."):
            for alias in node.names:
                yield str(node.module), alias.name


def overridden(trees: Iterable[ast.Module]) -> frozenset[str]:
    """Return the methods of the interfaces that classes of these modules override."""
    api, own = classes(ast.parse(path.read_text()) for path in BASES), classes(trees)
    found = (methods & inherited(name, own, api) for name, (_, methods) in own.items())
    return frozenset[str]().union(*found)


def kind_in(host: Path, emulated: Path | None, package: str) -> Kind:
    """Return the kind in these folders; imports of its own modules begin with `package`."""
    sides = [sorted(folder.rglob("*.py")) if folder else [] for folder in (host, emulated)]
    trees = [ast.parse(path.read_text()) for path in (*sides[0], *sides[1])]
    found = [one for tree in trees for one in imports(tree)]
    internal = {
        module
        for module, _ in found
        if module not in APIS and f".{package}" not in f".{module.removeprefix('motorhil.')}"
    }
    names = frozenset(name for module, name in found if module in APIS)
    host_files, emulated_files = map(tuple, sides)
    return Kind(host_files, emulated_files, frozenset(internal), names, overridden(trees))


def kinds() -> dict[str, Kind]:
    """Return the kinds of motorhil with a folder on either side, and the ODrive package."""
    found = {name: kind_in(HOST / name, EMULATED / name, name) for name in OWN}
    return found | {"odrive": kind_in(ODRIVE / "host", ODRIVE / "emulated", "odrive")}


def table(rows: Iterable[tuple[str, Kind]]) -> Iterator[str]:
    """Yield the lines of the table."""
    yield " ".join(f"{head:>{max(8, len(head))}}" for head in HEADS)
    for name, kind in rows:
        cells = zip((name, *map(str, kind.row())), HEADS, strict=True)
        yield " ".join(f"{cell:>{max(8, len(head))}}" for cell, head in cells)


def main(arguments: list[str]) -> None:
    """Print the report; of the kinds in the folders given, or of motorhil."""
    given = [(Path(one).name, kind_in(Path(one), None, Path(one).name)) for one in arguments]
    if given:
        print("\n".join(table(given)))
        return
    lengths = {path: code_lines(path.read_text()) for path in sources()}
    long = {path: lines for path, lines in lengths.items() if lines > CODE_LINES}
    single = single_importers(import_graph())
    count = sum(1 for path in lengths if path.name != "__init__.py")
    print(f"{count} modules, {sum(lengths.values())} code lines in {', '.join(PACKAGES)}")
    print(f"{len(long)} modules above {CODE_LINES} code lines")
    for path, lines in sorted(long.items()):
        print(f"  {path.relative_to(CHECKOUT)}: {lines}")
    print(f"{len(single)} modules with one importer, in their own folder")
    for line in single:
        print(f"  {line}")
    print("\n".join(table(kinds().items())))


if __name__ == "__main__":
    main(sys.argv[1:])
