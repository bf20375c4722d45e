"""The page with all names that third parties may import.

    python -m motorhil.harness.api_names > docs/reference/api-names.md

Each name has the first line of its docstring; that of a value is the string behind its assignment.
"""

import ast
import enum
import inspect
import sys
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, Final

MODULES: Final = ("motorhil.motorapi.api", "motorhil.emulators.api", "motorhil.traces.api")
_HEAD: Final = """\
# Names for extensions

Made by `make clauses` from the modules themselves. An extension may import these names, and no
others. Its adaptation imports them from `motorhil.motorapi.api`, its emulated drive from
`motorhil.emulators.api`, and its decoder from `motorhil.traces.api`.
"""


def page() -> str:
    """Return the page: a table for each module."""
    lines = [_HEAD]
    for name in MODULES:
        module = import_module(name)
        rows = [_row(one, getattr(module, one), module) for one in sorted(module.__all__)]
        lines += [f"## {name}", "", "| name | kind | meaning |", "| --- | --- | --- |", *rows, ""]
    return "\n".join(lines)


def _row(name: str, value: Any, module: ModuleType) -> str:
    line = _text_of(name, module).partition("\n")[0].replace("|", "\\|")
    return f"| `{name}` | {_kind(value)} | {line} |"


def _kind(value: Any) -> str:
    if isinstance(value, ModuleType):
        return "module"
    if not inspect.isclass(value):
        return "function" if inspect.isroutine(value) else "value"
    if issubclass(value, enum.Enum):
        return "enumeration"
    return "error" if issubclass(value, Exception) else "class"


def _text_of(name: str, module: ModuleType) -> str:
    """Return the text on a name from the sources, which compiled modules have beside them."""
    path = Path(str(module.__file__))
    body = ast.parse(path.with_name(f"{path.name.partition('.')[0]}.py").read_text("utf-8")).body
    for statement, following in pairwise([*body, ast.Pass()]):
        match statement, following:
            case (ast.FunctionDef(name=own) | ast.ClassDef(name=own)) as found, _ if own == name:
                return ast.get_docstring(found) or ""
            case (
                ast.Assign(targets=[ast.Name(own)]) | ast.AnnAssign(target=ast.Name(own)),
                ast.Expr(ast.Constant(str(text))),
            ) if own == name:
                return inspect.cleandoc(text)
            case ast.ImportFrom(module=str(origin), names=names), _:
                for one in names:
                    if name == (one.asname or one.name):
                        return _text_from(one.name, import_module(origin))
    return ""


def _text_from(name: str, module: ModuleType) -> str:
    value = getattr(module, name)
    return inspect.getdoc(value) or "" if isinstance(value, ModuleType) else _text_of(name, module)


if __name__ == "__main__":
    sys.stdout.write(page())
