"""The only code that opens a file: recordings in, results out."""
