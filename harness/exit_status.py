"""Exit statuses of `motorhil`, the same for every verb."""

from typing import Final

PASSED: Final = 0
FAILED: Final = 1  # the thing under test failed
WRONG_USAGE: Final = 2
NOT_JUDGED: Final = 3  # there was nothing to test: neither passed nor failed
INTERRUPTED: Final = 130
