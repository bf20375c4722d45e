"""Size of each kind of drive, and the number of concepts that its author had to learn.

python -m tests.architecture.kinds [FOLDER ...]

prints a table of the kinds of motorhil with a folder on either side, or of one kind in the folders
given. Concepts are the distinct names that a kind imports from the interfaces for extensions, and
the methods of their classes that it overrides.
"""

import ast
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.architecture.structure import code_lines
from tests.support.checkout import CHECKOUT

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
    """Print the table; of the kinds in the folders given, or of motorhil's own."""
    given = [(Path(one).name, kind_in(Path(one), None, Path(one).name)) for one in arguments]
    print("\n".join(table(given or kinds().items())))


if __name__ == "__main__":
    main(sys.argv[1:])
