"""`python -m qrl`."""

import sys

from qrl.cli import main

sys.exit(main())
