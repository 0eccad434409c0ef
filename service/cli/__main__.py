"""`python -m service.cli`: the command line."""

import sys

from service.cli.main import main

sys.exit(main())
