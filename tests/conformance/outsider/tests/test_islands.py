"""The drive's side and the host's side share no code."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "motorhil_odrive"


def imports(folder):
    for path in sorted((PACKAGE / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                yield path.name, node.module
            elif isinstance(node, ast.Import):
                yield from ((path.name, alias.name) for alias in node.names)


@pytest.mark.parametrize(
    ("side", "allowed"),
    [
        ("emulated", ("motorhil.emulators.api", "motorhil_odrive.emulated")),
        ("host", ("motorhil.motorapi.api", "can", "motorhil_odrive.host")),
    ],
)
def test_each_side_imports_only_its_own_api(side, allowed):
    ours = ("motorhil", "motorhil_odrive", "can")
    found = list(imports(side))
    assert len(found) > 20
    for path, module in found:
        if module.split(".")[0] in ours:
            assert module.startswith(allowed), f"{side}/{path} imports {module}"


def test_emulated_side_imports_no_clock_or_random():
    banned = {"time", "socket", "select", "threading", "asyncio", "random", "os"}
    assert not banned & {module.split(".")[0] for _, module in imports("emulated")}
