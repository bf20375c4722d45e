"""Fixtures that read EDS texts and expect refusals."""

from pathlib import Path

import pytest

from motorhil.emulators.canopen.files.eds import EdsError, read_eds


@pytest.fixture
def read(tmp_path: Path):
    def reader(text: str | bytes, node_id: int = 5):
        path = tmp_path / "drive.eds"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_eds(path, node_id)

    return reader


@pytest.fixture
def refused(read):
    def reader(text: str | bytes) -> tuple[int, str]:
        with pytest.raises(EdsError) as caught:
            read(text)
        error = caught.value
        message = str(error)
        assert "\n" not in message
        assert message.startswith(f"{error.path}:{error.line}: " if error.line else str(error.path))
        assert error.remedy
        assert message.endswith(error.remedy)
        return error.line, error.text

    return reader
