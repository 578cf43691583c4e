"""`python -m mag_tracking.cli`."""

import sys

from mag_tracking.cli import main

sys.exit(main())
