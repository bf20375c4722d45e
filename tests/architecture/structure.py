"""Structure of the sources: sizes of folders and functions, and import cycles.

python -m tests.architecture.structure

reports, without failing, modules above 800 code lines and modules with one importer, in their own
folder.
"""

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Mapping
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


def main() -> None:
    """Print the report."""
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


if __name__ == "__main__":
    main()
