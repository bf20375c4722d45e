import json

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.harness.cli.main import main


def test_every_quirk_is_printed_with_source(capsys):
    assert main(["list", "quirks"]) == 0
    out = capsys.readouterr().out
    for quirk in CATALOGUE:
        assert f"{quirk.name}" in out
        assert f"    {quirk.what}\n    seen: {quirk.seen}\n" in out
    assert "slow_sdo (mean_s = 0.02, spread_s = 0.01)\n" in out


def test_quirks_are_printed_as_json(capsys):
    assert main(["list", "quirks", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert list(rows) == [quirk.name for quirk in CATALOGUE]
    assert rows["late_boot_up"]["parameters"] == {"by_s": 5.0}
