"""The table of kinds counts what an author had to learn."""

import ast

import pytest

from tests.architecture.kinds import kind_in, kinds, main, overridden

HOST = '''"""A drive."""

from motorhil.motorapi.api import CanHardware, CanMotor, text
from motorhil.motorapi.errors import MotorError
from motorhil_mine.frames import FRAME


class Hardware(CanHardware):
    """Hardware."""

    def _begin(self):
        """Begin."""

    def own(self):
        """Do what no base does."""


class Special(Hardware):
    """Hardware of a kind."""

    def _knows(self):
        return True


class Motor(CanMotor):
    """A motor."""

    def _latest(self):
        return None

    def __repr__(self):
        return ""
'''
EMULATED = '''"""A drive."""

from motorhil.emulators.api import MotorDrive, text


class Drive(MotorDrive):
    """A drive."""

    def boot(self, now_ns): ...
'''


@pytest.fixture
def kind(tmp_path):
    for name, text in (("host", HOST), ("emulated", EMULATED)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "drive.py").write_text(text)
    return kind_in(tmp_path / "host", tmp_path / "emulated", "mine")


def test_concepts_are_names_and_overridden_methods(kind):
    assert sorted(kind.names) == ["CanHardware", "CanMotor", "MotorDrive", "text"]
    assert sorted(kind.hooks) == ["_begin", "_knows", "_latest", "boot"]
    assert kind.internal == {"motorhil.motorapi.errors"}


def test_row_has_files_lines_and_concepts(kind):
    host = len([one for one in HOST.splitlines() if one and '"""' not in one])
    assert kind.row() == (2, host, 3, host + 3, 1, 4, 4)


def test_method_of_a_class_of_its_own_is_no_hook():
    text = "class One:\n    def boot(self): ...\nclass Two(One):\n    def boot(self): ...\n"
    assert overridden([ast.parse(text)]) == frozenset()


def test_kinds_that_speak_can_or_serial_import_the_interfaces_only():
    internal = {name: kind.internal for name, kind in kinds().items() if kind.internal}
    assert set(internal) == {"dryve"}  # a CiA 402 drive behind a gateway
    assert all(".canopen." in one or ".cia402." in one for one in internal["dryve"])


def test_table_of_a_folder_has_one_row(kind, tmp_path, capsys):
    main([str(tmp_path / "host")])
    head, row = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ["kind", "files", "host"]
    assert row.split()[:2] == ["host", "1"]
