"""`python -m services` is `penumbra`."""

import sys

from services.cli import main

sys.exit(main())
