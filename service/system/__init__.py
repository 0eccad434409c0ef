"""Files, paths, processes and limits of the machine."""
