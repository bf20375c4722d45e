"""The verb `list quirks`: known deviations of drives, with sources."""

import json

from emulators.cia402.quirk_catalogue import CATALOGUE
from harness.exit_status import PASSED


def list_quirks(*, as_json: bool) -> int:
    """Print the catalogue; return 0."""
    if as_json:
        rows = [
            {
                "name": quirk.name,
                "what": quirk.what,
                "seen": quirk.seen,
                "parameters": dict(quirk.parameters),
            }
            for quirk in CATALOGUE
        ]
        print(json.dumps(rows))
        return PASSED
    for quirk in CATALOGUE:
        given = ", ".join(f"{key} = {value:g}" for key, value in quirk.parameters.items())
        print(quirk.name + (f" ({given})" if given else ""))
        print(f"    {quirk.what}")
        print(f"    seen: {quirk.seen}")
    return PASSED
