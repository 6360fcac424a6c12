"""``python -m torchtrack`` is ``torchtrack``, where the environment's scripts are not on the path."""

import sys

from torchtrack.cli.main import main

sys.exit(main())
