"""`python -m services` is `penumbra`."""

import sys

from penumbra.services.command import main

sys.exit(main())
