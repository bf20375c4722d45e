"""`motorhil list WHAT`: what is installed, or shipped, and where it is."""

import argparse
import json
from importlib.util import find_spec
from pathlib import Path

from harness.exit_status import PASSED
from harness.plugins import ADAPTATIONS, CONTROLLERS, installed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `list` can be told."""
    parser.add_argument("what", choices=("controllers", "adaptations", "examples"))
    parser.add_argument("--json", action="store_true", help="answer for a machine")


def run(options: argparse.Namespace) -> int:
    """The list has been printed, one line each."""
    listing = {
        "controllers": lambda: _plugins(CONTROLLERS),
        "adaptations": lambda: _plugins(ADAPTATIONS),
        "examples": _examples,
    }[options.what]()
    if options.json:
        print(json.dumps(listing))
        return PASSED
    for entry in listing:
        name, *facts = entry.values()
        print(f"{name:<16} " + "  ".join(facts))
    return PASSED


def _plugins(group: str) -> list[dict[str, str]]:
    listing = []
    for plugin in installed(group).values():
        entry = {"name": plugin.name, "builder": plugin.target, "package": plugin.package}
        eds = own_eds(plugin.target)
        if eds is not None:
            entry["eds"] = str(eds)
        listing.append(entry)
    return listing


def own_eds(target: str) -> Path | None:
    """The EDS file shipped beside a controller's package, in its folder `eds`; None: there is none.

    Found without loading the controller's module: `package/eds/*_NAME.eds` for
    `package.NAME.module:function`.
    """
    package, _, rest = target.partition(":")[0].partition(".")
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    name = rest.split(".")[0]
    for folder in spec.submodule_search_locations:
        for path in sorted((Path(folder) / "eds").glob(f"*_{name}.eds")):
            return path
    return None


def _examples() -> list[dict[str, str]]:
    from harness.scaffold import example_rigs, first_comment

    return [
        {"name": path.stem, "path": str(path), "about": first_comment(path)}
        for path in example_rigs()
    ]
