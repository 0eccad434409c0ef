"""The tests of a deployment start the same services as those of the server."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "service" / "server"))
