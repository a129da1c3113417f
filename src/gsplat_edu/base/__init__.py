"""The lowest layer: constants, errors, files, text, checks, threads and memory."""
