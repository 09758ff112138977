"""`python -m ucs`."""
from __future__ import annotations

import sys

from ucs.main import main

sys.exit(main())
