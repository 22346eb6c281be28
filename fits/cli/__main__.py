"""``python -m fits.cli``, the same as ``layerjax``."""

import sys

from fits.cli.parser import main

sys.exit(main())
