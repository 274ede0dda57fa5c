"""`python -m services` is `penumbra`."""

import sys

from services.command.cli import main

sys.exit(main())
