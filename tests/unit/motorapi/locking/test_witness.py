"""The witness of a held lock; tests/system/wall/sharing/test_witness.py uses several processes."""

import os

import pytest

from motorhil.motorapi.locking import witness as witness_module
from motorhil.motorapi.locking.witness import Witness


@pytest.fixture
def witness(tmp_path):
    """Make witnesses, of a file in the folder; close all of them afterwards."""
    made = []

    def make(inode, name="pan", folder=tmp_path):
        made.append(Witness(f"{folder}/{name}", inode))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_two_files_of_a_name_exclude_each_other(witness):
    first, second = witness(100), witness(101)
    assert first.set()
    assert not second.set()
    assert [rival.pid for rival in second.rivals()] == [os.getpid()]
    first.drop()
    assert list(second.rivals()) == []
    assert second.set()
    assert not first.set()
    second.close()
    assert first.set()


def test_witnesses_of_one_file_do_not_exclude_each_other(witness):
    loser, owner, stranger = witness(100), witness(100), witness(101)
    assert loser.set()
    assert owner.set()
    loser.drop()
    assert not stranger.set()
    owner.drop()
    assert stranger.set()


def test_holders_that_have_lost_their_lock_do_not_exclude(witness):
    losers = [witness(inode) for inode in (99, 101)]
    for loser in losers:
        assert loser.set(lambda rival: False)
    owner = witness(100)
    seen = []
    assert owner.set(lambda rival: seen.append(rival.byte))
    assert len(set(seen)) == 2
    losers[0].drop()
    assert not losers[0].set(lambda rival: rival.byte not in seen)


def test_neighbouring_inodes_all_exclude_each_other(witness):
    for inode in range(1000, 1050):
        one, other = witness(inode), witness(inode + 1)
        assert one.set()
        assert not other.set()
        one.drop()


def test_other_names_and_folders_are_independent(witness, tmp_path):
    (tmp_path / "b").mkdir()
    assert witness(100).set()
    assert witness(101, name="tilt").set()
    assert witness(102, folder=tmp_path / "b").set()


def test_name_of_any_length_has_a_witness(witness):
    long = "x" * 5000
    assert witness(100, name=long).set()
    assert not witness(101, name=long).set()
    assert witness(101, name=long + "y").set()


def test_links_to_the_folder_lead_to_the_same_witness(witness, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    assert witness(100, folder=tmp_path / "real").set()
    assert not witness(101, folder=tmp_path / "link").set()


def test_system_without_the_place_has_no_exclusion(witness, monkeypatch):
    monkeypatch.setattr(witness_module, "PLACE", "/nonexistent")
    one, other = witness(100), witness(101)
    assert one.set()
    assert other.set()
    assert list(other.rivals()) == []
    other.drop()
