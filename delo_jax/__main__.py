"""`python -m delo_jax` is the command `delo`."""

import sys

from delo_jax.cli import main

sys.exit(main())
