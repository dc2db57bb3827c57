"""`python -m qrl`."""

import sys

from qrl.cli.main import main

sys.exit(main())
