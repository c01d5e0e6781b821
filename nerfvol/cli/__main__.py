"""``python -m nerfvol.cli`` is ``nerfvol``."""

import sys

from nerfvol.cli.main import main

sys.exit(main())
