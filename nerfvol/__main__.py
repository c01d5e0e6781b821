"""``python -m nerfvol``: the command, where its script is not on the PATH."""

import sys

from nerfvol.cli.main import main

sys.exit(main())
