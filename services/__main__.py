"""`python -m services` is `penumbra`."""

import sys

from penumbra.services.command.cli import main

sys.exit(main())
