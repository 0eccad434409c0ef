"""HTTP servers of the tests' own, in a thread beside the test."""

import threading

_LOOK_S = 0.02
"""How long a server that is to end waits at most until it does."""


def serve(server):
    """Has it answer until it is shut down."""
    threading.Thread(target=server.serve_forever, args=(_LOOK_S,), daemon=True).start()
