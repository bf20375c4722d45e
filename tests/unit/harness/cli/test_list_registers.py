import json

from motorhil.harness.cli.main import main


def test_register_map_is_printed_by_address(capsys):
    assert main(["list", "registers", "leadshine_pr"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == [
        *("address", "name", "type", "unit", "access", "default", "behaviour")
    ]
    assert any(line.startswith("6002h    trigger ") for line in lines)
    addresses = [line.split()[0] for line in lines[1:]]
    assert addresses == sorted(addresses)


def test_register_map_is_printed_as_json(capsys):
    assert main(["list", "registers", "oriental_az", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["trigger"]["address"] == 0x66
    assert (rows["current"]["low"], rows["current"]["high"]) == (None, 1000)


def test_controller_without_registers_is_reported(capsys):
    for words in (["registers", "cia402"], ["registers", "nobody"], ["registers"]):
        assert main(["list", *words]) == 2
        assert "leadshine_pr, oriental_az" in capsys.readouterr().err
    assert main(["list", "motors", "leadshine_pr"]) == 2
