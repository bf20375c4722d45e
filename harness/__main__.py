"""`python -m harness` is `motorhil`."""

import sys

from harness.cli import main

sys.exit(main())
