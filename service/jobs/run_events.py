"""`--events FILE`: what a run does, for programs. One JSON object a line, added to the file as it happens.

    {"event": "stages", "names": [...]}                                  all stages in order, before the first
    {"event": "stage", "name", "index", "total", "reused": bool|null}    one begins
    {"event": "progress", "stage", "what", "done", "total"}              at most a few a second
    {"event": "record", "name", "seconds", "peak_memory_mb", "reused"}   how each went, at the end
    {"event": "end", "code", "message", "where", "problem", "mend"}      the last; what is not known is empty

Every line has `time`, seconds since 1970.
"""

VIEWER = "viewer"
"""Name of the stage that comes last where it is asked for: the result is whole before it."""
