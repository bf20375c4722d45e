"""Fixture: a folder for the locks of one test."""

import pytest


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "locks"
    path.mkdir(mode=0o700)
    return path
