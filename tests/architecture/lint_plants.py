"""import-linter on copied sources, with and without planted imports.

python -m tests.architecture.lint_plants COPY < PLANTS

It runs in a process of its own, because import-linter finds packages as Python does, and the tests
have imported them. PLANTS is JSON, a list of [contract, module file, line]. The answer is a list of
[kept, output].
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

from importlinter.cli import lint_imports


def lint(contract: str) -> tuple[bool, str]:
    """Return whether the contract is kept ("": all contracts), and import-linter's output."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        limit = (contract,) if contract else ()
        status = lint_imports(limit_to_contracts=limit, cache_dir="cache", no_logo=True)
    return status == 0, out.getvalue()


def main() -> None:
    """Print the answers on stdout."""
    plants = json.load(sys.stdin)
    os.chdir(sys.argv[1])
    answers = []
    for contract, file, line in plants:
        path = Path(file)
        before = path.read_text() if path.exists() else None
        path.write_text((before or "") + f"\n{line}\n")
        try:
            answers.append(lint(contract))
        finally:
            if before is None:
                path.unlink()
            else:
                path.write_text(before)
    json.dump(answers, sys.stdout)


if __name__ == "__main__":
    main()
